"""Who may open a live page, and what a browser may send there.

Any website that somebody has open can connect to a server on the same machine, and can give this machine a name that it owns.
So `Origin` and `Host` of every connection are checked. Everybody who is not on this machine needs a token besides. viser sets
whatever a browser names, so nothing reaches it that its own page would not send.
"""

import asyncio
import contextlib
import hmac
import ipaddress
import secrets
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from typing import Annotated, Any, Literal
from urllib.parse import parse_qs, urlsplit

import msgspec

_COOKIE = "ballbot"
_MOST_CONNECTIONS = 50
_LARGEST_MESSAGE = 2**16  # bytes
_RATE, _BURST = 200.0, 200.0  # messages of one browser per second, and how many may come at once
_LARGEST_NUMBER = 1e9  # in a control without bounds; viser can send no integers of more than 64 bits
_STARTING = threading.Lock()

_Text = Annotated[str, msgspec.Meta(max_length=1000)]
_Pair = tuple[float, float]
_Vector = tuple[float, float, float]


class _Message(msgspec.Struct, tag_field="type"):
    """What viser's page sends, with the names of viser. Fields that viser checks itself are left out."""


class _Camera(_Message, tag="ViewerCameraMessage"):
    wxyz: tuple[float, float, float, float]
    position: _Vector
    look_at: _Vector
    up_direction: _Vector


class _Drag(_Message, tag="SceneNodeDragMessage"):
    phase: Literal["start", "update", "end"]
    name: _Text
    start_position: _Vector
    end_position: _Vector
    start_screen_pos: _Pair
    end_screen_pos: _Pair


class _Hold(_Message, tag="GuiButtonHoldMessage"):
    uuid: _Text


class _Command(_Message, tag="CommandTriggerMessage"):
    uuid: _Text


class _Value(msgspec.Struct, forbid_unknown_fields=True):
    value: bool | int | float | _Text


class _Update(_Message, tag="GuiUpdateMessage"):
    uuid: _Text
    updates: _Value


_DECODER = msgspec.msgpack.Decoder(_Camera | _Drag | _Hold | _Command | _Update)


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


class Visitor:
    """Decides which messages of a browser reach viser: those of its page, to controls that can be used, with their values."""

    def __init__(self, control: Callable[[str], Any]):
        """`control` gives viser's control with an id; None where there is none."""
        self._control = control
        self._arrived = False
        self._next = 0.0

    async def wait(self) -> None:
        """Returns when the browser may send again."""
        now = time.monotonic()
        self._next = max(self._next, now - _BURST / _RATE) + 1 / _RATE
        await asyncio.sleep(max(0.0, self._next - now))

    def may_send(self, raw: Any) -> bool:
        """Whether viser gets a message. Its first one says where the camera is: until then viser knows no client."""
        try:
            message = _DECODER.decode(raw)
        except (msgspec.DecodeError, TypeError):
            return False
        self._arrived |= isinstance(message, _Camera)
        return self._arrived and (not isinstance(message, _Update) or self._fits(message))

    def _fits(self, message: _Update) -> bool:
        control, value = self._control(message.uuid), message.updates.value
        if control is None or control.disabled or not control.visible:
            return False
        if (options := getattr(control, "options", None)) is not None:
            return value in options
        if isinstance(control.value, bool | str):
            return type(value) is type(control.value)
        low = -_LARGEST_NUMBER if control.min is None else control.min
        high = _LARGEST_NUMBER if control.max is None else control.max
        return not isinstance(value, bool | str) and low <= value <= high


@contextlib.contextmanager
def guard(gate: Gate, control: Callable[[str], Any]) -> Iterator[None]:
    """A viser server that is started meanwhile passes everything through the gate. `control` is as for `Visitor`.

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
            visitor, receive = Visitor(control), connection.recv

            async def recv() -> Any:
                while True:
                    message = await receive()
                    await visitor.wait()
                    if visitor.may_send(message):
                        return message

            connection.recv = recv
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
