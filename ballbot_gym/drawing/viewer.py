"""A server on this machine whose page in the browser shows drawings live. It needs no display, because the browser draws.

`ballbot play` adds its controls to the page. An environment with render_mode="human" shows itself here. The page is served
over HTTP. A WebSocket carries moments to it, and the requests of its readers back, as JSON.

Any page that is open in a browser can connect to a server on the same machine, and can give this machine a name that it owns.
So `Host` and `Origin` of every request are checked, and no other page may frame this one.
"""

import asyncio
import contextlib
import json
import logging
import re
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

from ballbot_gym.drawing import Drawing, need_viewer
from ballbot_gym.drawing.page import look, moment, page_html
from ballbot_gym.robot import default_params

PORT = 8080
_NEXT_PORTS = 100  # that are tried where one is taken
_LOCAL = r"(localhost|127\.0\.0\.1|\[::1\])(:\d+)?"  # names that no website can have; tunnels have other ports
_MOST_CLIENTS = 32
_LONGEST = 4096  # bytes of a message from a page; a longer one ends its connection, and the page connects again
_PER_SECOND, _AT_ONCE = 25.0, 50  # messages of a client that are read; others are ignored

_LOGGER = logging.getLogger(__name__)
_LOGGER.addHandler(logging.NullHandler())
_LOGGER.propagate = False  # clients that leave in the middle would write tracebacks onto the user's terminal


class Viewer:
    """A server whose page shows the last drawing. Every browser that opens `address` sees the same.

    It listens on this machine alone. Clients that are slow get fewer moments, the newest ones.
    """

    def __init__(self, port: int = PORT, page: str | None = None):
        """Starts the server in a thread.

        Args:
            port: where to listen, or the next free one if it is taken; 0 is any free one.
            page: HTML; default, the page that shows drawings alone.

        Raises:
            ImportError: the library is missing.
            ValueError: no such port.
            OSError: neither the port nor one of the next hundred is free.
        """
        need_viewer()
        if not 0 <= port < 2**16:
            raise ValueError(f"port must be 0 to {2**16 - 1}, not {port}")
        data = f"const DATA = {json.dumps(look(default_params()))};"
        self._page = (page_html(data, live=True) if page is None else page).encode()
        self.on_ask: Callable[[str, Any], object] = lambda name, value: None
        """Is called in the server's thread with the name and the value of each request of a page."""
        self._socket = _listening(port)
        self.port: int = self._socket.getsockname()[1]
        self._next = 0.0
        self._last: dict[str, str] = {}  # the newest message of each kind
        self._clients: dict[Any, asyncio.Event] = {}  # by connection, set where there is something new
        self._loop = asyncio.new_event_loop()
        self._stopped = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """What to open in a browser."""
        return f"http://localhost:{self.port}"

    @property
    def is_watched(self) -> bool:
        """Whether a page is connected."""
        return bool(self._clients)

    def draw(self, drawing: Drawing) -> None:
        """Shows a moment."""
        self.send("moment", moment(drawing))

    def show(self, drawing: Drawing, seconds: float) -> None:
        """Shows a moment, `seconds` after the last one."""
        now = time.perf_counter()
        self._next = max(self._next + seconds, now)
        time.sleep(self._next - now)
        self.draw(drawing)

    def send(self, kind: str, content: Any) -> None:
        """Sends content of a kind that stream.js shows to all pages, and to pages that connect later.

        It replaces the content of that kind that was sent before. The same content is not sent twice.
        """
        text = json.dumps({kind: content}, separators=(",", ":"))
        if self._last.get(kind) != text and not self._loop.is_closed():
            self._last[kind] = text
            self._loop.call_soon_threadsafe(self._notify)

    def close(self) -> None:
        """Stops the server; may be called again."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._stopped.set)
            self._thread.join()
            self._loop.close()

    # --- in the server's thread ---

    def _run(self) -> None:
        self._loop.run_until_complete(self._serve())

    async def _serve(self) -> None:
        from websockets.asyncio.server import serve

        settings: dict[str, Any] = {"compression": None, "max_size": _LONGEST, "max_queue": 8, "logger": _LOGGER}
        async with serve(self._attend, sock=self._socket, process_request=self._answer, **settings):
            await self._stopped.wait()
            for connection in self._clients:  # a client that is stuck would be waited for
                connection.transport.abort()

    def _notify(self) -> None:
        for news in self._clients.values():
            news.set()

    def _answer(self, connection: Any, request: Any) -> Any:
        """The answer to an HTTP request; None lets a page connect its WebSocket."""
        response = None
        if refusal := _refusal(request.headers):
            response = connection.respond(403, refusal)
        elif request.path == "/stream":
            full = len(self._clients) >= _MOST_CLIENTS
            return connection.respond(503, f"no more than {_MOST_CLIENTS} pages at once") if full else None
        elif request.path.partition("?")[0] != "/":
            response = connection.respond(404, "there is nothing but the page /")
        else:
            response = connection.respond(200, "")
            response.body = self._page
            del response.headers["Content-Type"], response.headers["Content-Length"]
            response.headers["Content-Type"] = "text/html; charset=utf-8"
            response.headers["Content-Length"] = str(len(self._page))
        response.headers["Content-Security-Policy"] = "frame-ancestors 'self'"
        return response

    async def _attend(self, connection: Any) -> None:
        """Serves one page until it leaves."""
        self._clients[connection] = news = asyncio.Event()
        sender = asyncio.create_task(self._send_news(connection, news))
        left, last = float(_AT_ONCE), time.monotonic()
        try:
            async for message in connection:
                now = time.monotonic()
                left, last = min(_AT_ONCE, left + _PER_SECOND * (now - last)), now
                if left >= 1:
                    left -= 1
                    self._take(message)
        finally:
            del self._clients[connection]
            sender.cancel()

    async def _send_news(self, connection: Any, news: asyncio.Event) -> None:
        """Sends the newest message of each kind, one after the other. A slow page misses the messages between."""
        from websockets.exceptions import ConnectionClosed

        sent: dict[str, str] = {}
        with contextlib.suppress(ConnectionClosed):
            while True:
                for kind, text in list(self._last.items()):
                    if sent.get(kind) is not text:
                        sent[kind] = text
                        await connection.send(text)
                await news.wait()
                news.clear()

    def _take(self, message: str | bytes) -> None:
        """Passes on the request of a page. A message that is not a pair of a name and a value is ignored."""
        with contextlib.suppress(ValueError, TypeError, RecursionError):
            name, value = json.loads(message)
            if isinstance(name, str):
                self.on_ask(name, value)


def _listening(port: int) -> socket.socket:
    """A socket that listens on this machine alone, on a port or one of the next."""
    for tried in range(port, min(port + _NEXT_PORTS, 2**16) if port else 1):
        opened = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            opened.bind(("127.0.0.1", tried))
            opened.listen()
        except OSError:
            opened.close()
        else:
            return opened
    raise OSError(f"no port from {port} on is free; give another --port")


def _refusal(headers: Any) -> str:
    """Why a request with these headers is not answered; "" where it is."""
    hosts = headers.get_all("Host")
    if len(hosts) != 1 or not re.fullmatch(_LOCAL, hosts[0]):
        return "open the address that was printed: the page has no other name"
    if any(origin != f"http://{hosts[0]}" for origin in headers.get_all("Origin")):
        return "another page may not connect"
    return ""
