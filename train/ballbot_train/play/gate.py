"""A gate before the page for everybody who is not on this machine: nobody passes without the token.

viser has no passwords. So its server listens on this machine only, and the gate passes on the connections that bring the
token, as `?token=…` in the first address and as a cookie from then on.
"""

import asyncio
import hmac
import secrets
import socket
import threading
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

_COOKIE = "ballbot"
_HEAD_LIMIT = 2**14  # bytes of a request's head
_HEAD_SECONDS = 10.0
_CHUNK = 2**16
_MOST_CONNECTIONS = 200
_TRIED_PORTS = 100


class Gate:
    """Listens on `host`:`port` and passes those who know the token on to a port of this machine."""

    def __init__(self, host: str, port: int, inner_port: int, token: str | None = None):
        """Starts listening.

        Args:
            host: address to bind.
            port: where to listen; the next free one, if it is taken.
            inner_port: of viser's server on 127.0.0.1.
            token: default, a new one.

        Raises:
            OSError: nothing can listen there.
        """
        self.token = secrets.token_urlsafe(16) if token is None else token
        self._host, self._inner = host, inner_port
        self._open = 0
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True, name="ballbot-gate")
        self._thread.start()
        try:
            self._server = asyncio.run_coroutine_threadsafe(self._listen(port), self._loop).result()
        except OSError:
            self._loop.call_soon_threadsafe(self._loop.stop)
            raise
        self.port = int(self._server.sockets[0].getsockname()[1])

    @property
    def address(self) -> str:
        """What to open, with the token."""
        name = socket.gethostname() if self._host in ("0.0.0.0", "::") else self._host
        return f"http://{name}:{self.port}/?token={self.token}"

    def close(self) -> None:
        """Stops listening and closes every connection; may be called again."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._server.close)
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(timeout=2.0)

    async def _listen(self, port: int) -> asyncio.Server:
        for attempt in range(port, port + (_TRIED_PORTS if port else 1)):
            try:
                return await asyncio.start_server(self._serve, self._host, attempt, limit=_HEAD_LIMIT)
            except OSError as error:
                failure = error
        raise OSError(f"cannot listen on {self._host}, ports {port} to {attempt}: {failure}")

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._open += 1
        try:
            if self._open > _MOST_CONNECTIONS:
                return
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _HEAD_SECONDS)
            if (answer := self._answer(head)) is not None:
                writer.write(answer)
                await writer.drain()
                return
            await self._pass_on(head, reader, writer)
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, asyncio.TimeoutError):
            pass  # whoever it was has gone, or does not speak HTTP
        finally:
            self._open -= 1
            writer.close()

    def _answer(self, head: bytes) -> bytes | None:
        """What the gate answers itself; None for a request that may pass."""
        lines = head.decode("latin-1").split("\r\n")
        words = lines[0].split(" ")
        if len(words) != 3:
            return _response("400 Bad Request", "not a request")
        headers = dict(_header(line) for line in lines[1:] if ":" in line)
        given = parse_qs(urlsplit(words[1]).query).get("token", [""])[0]
        if self._is_token(given):
            cookie = f"Set-Cookie: {_COOKIE}={self.token}; Path=/; HttpOnly; SameSite=Strict"
            return _response("303 See Other", "", "Location: /", cookie)
        if not self._is_token(_cookie(headers.get("cookie", ""))):
            return _response("401 Unauthorized", "open the address that ballbot play printed, with its token")
        origin, host = headers.get("origin"), headers.get("host", "")
        if origin is not None and urlsplit(origin).netloc != host:
            return _response("403 Forbidden", "another page may not connect")
        return None

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), self.token.encode())

    async def _pass_on(self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", self._inner)
        try:
            inner_writer.write(head)
            ways = [
                asyncio.ensure_future(_copy(reader, inner_writer)),
                asyncio.ensure_future(_copy(inner_reader, writer)),
            ]
            _, pending = await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            for way in pending:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)
        finally:
            inner_writer.close()


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(_CHUNK):
        writer.write(data)
        await writer.drain()


def _header(line: str) -> tuple[str, str]:
    name, _, value = line.partition(":")
    return name.strip().lower(), value.strip()


def _cookie(text: str) -> str:
    try:
        found = SimpleCookie(text).get(_COOKIE)
    except CookieError:
        return ""
    return "" if found is None else found.value


def _response(status: str, text: str, *headers: str) -> bytes:
    body = text.encode()
    lines = [
        f"HTTP/1.1 {status}",
        f"Content-Length: {len(body)}",
        "Content-Type: text/plain; charset=utf-8",
        "Connection: close",
        *headers,
    ]
    return "\r\n".join(lines).encode() + b"\r\n\r\n" + body
