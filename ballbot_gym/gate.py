"""Who may open a live page.

Any website that somebody has open can connect to a server on the same machine, and can give this machine a name that it owns.
So `Origin` and `Host` of every connection are checked. Everybody who is not on this machine needs a token besides.
"""

import contextlib
import hmac
import ipaddress
import secrets
import threading
from collections.abc import Awaitable, Callable, Iterator
from typing import Any
from urllib.parse import parse_qs, urlsplit

_COOKIE = "ballbot"
_MOST_CONNECTIONS = 50
_LARGEST_MESSAGE = 2**16  # bytes
_STARTING = threading.Lock()


class Gate:
    """Decides which requests a page answers. One that listens on more than this machine asks for its `token`."""

    def __init__(self, host: str):
        """For a server that is bound to the address `host`."""
        self.token = "" if _is_local(host) else secrets.token_urlsafe(16)

    def refusal(self, path: str, headers: Any) -> tuple[int, str, dict[str, str]] | None:
        """How a request that may not pass is answered, by status, text and headers; None for one that may pass."""
        hosts, cookies = headers.get_all("Host"), "; ".join(headers.get_all("Cookie")).split("; ")
        try:
            name = urlsplit("//" + "".join(hosts)).hostname
            origins = [urlsplit(origin).netloc for origin in headers.get_all("Origin")]
            given = parse_qs(urlsplit(path).query).get("token", [""])[0]
        except ValueError:  # brackets without an address of version 6
            return 400, "not an address", {}
        if len(hosts) != 1 or not (self.token or _is_local(name)):
            return 403, "open the address that was printed: the page has no other name", {}
        if any(origin != hosts[0] for origin in origins):
            return 403, "another page may not connect", {}
        if self.token and self._is_token(given):
            cookie = f"{_COOKIE}={self.token}; Path=/; HttpOnly; SameSite=Strict"
            return 303, "", {"Location": "/", "Set-Cookie": cookie}
        if self.token and not any(self._is_token(cookie.removeprefix(f"{_COOKIE}=")) for cookie in cookies):
            return 401, "open the address that was printed, with its token", {}
        return None

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(errors="replace"), self.token.encode())


@contextlib.contextmanager
def guard(gate: Gate) -> Iterator[None]:
    """A viser server that is started meanwhile passes every request through the gate.

    Raises:
        RuntimeError: none was started, or this version of viser starts it in another way.
    """
    from websockets.asyncio import server

    guarded = False

    def serve(handler: Callable[[Any], Awaitable[None]], host: str, port: int, **settings: Any) -> Any:
        nonlocal guarded
        guarded, answer = True, settings["process_request"]

        def process_request(connection: Any, request: Any) -> Any:
            refusal = gate.refusal(request.path, request.headers)
            status, text, headers = refusal or (0, "", {"Content-Security-Policy": "frame-ancestors 'self'"})
            response = connection.respond(status, text) if refusal else answer(connection, request)
            if response is not None:
                response.headers.update(headers)
            return response

        async def handle(connection: Any) -> None:
            if len(connection.server.connections) <= _MOST_CONNECTIONS:
                await handler(connection)

        settings |= {"process_request": process_request, "max_size": _LARGEST_MESSAGE}
        return start(handle, host, port, **settings)

    with _STARTING:
        start = server.serve
        server.serve = serve  # pyright: ignore[reportAttributeAccessIssue] viser takes no other
        try:
            yield
        finally:
            server.serve = start
    if not guarded:
        raise RuntimeError("this version of viser cannot be guarded; install the one that constraints.txt names")


def _is_local(host: str | None) -> bool:
    """Whether only this machine reaches an address, and no website can have it as its name."""
    with contextlib.suppress(ValueError):
        return host == "localhost" or ipaddress.ip_address(host or "").is_loopback
    return False
