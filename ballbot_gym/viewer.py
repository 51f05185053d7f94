"""A page in the browser that shows drawings live, by viser. It needs no display, because the browser draws.

This is the one place that knows viser's scene. `ballbot play` adds its controls beside the scene. An environment with
render_mode="human" shows itself here.
"""

import contextlib
import io
import logging
import math
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np

from ballbot_gym.drawing import BALL, FORCE, PUSH, Drawing, GroundPath, Robot, arrows, pose
from ballbot_gym.lazy import imports_of
from ballbot_gym.params import BallbotParams
from ballbot_gym.picture import rgb

PORT = 8080
_EYE, _AIM = (-2.6, -1.8, 1.5), (0.0, 0.0, 0.5)  # m: from behind a robot that moves along x
_SQUARE = 1.0  # m, of the floor
_LINE_HEIGHT = 0.008  # m, so that lines on the floor do not flicker
_SHADOW, _SHADOW_HEIGHT = 0.3, 0.003  # opacity, and m above the floor
_DASH = 2  # a dashed line shows every second segment
_FOLLOW = 0.15  # share of the distance by which the camera follows in each drawing
_JUMP = 4.0  # m, of a distance that it follows at once
_LABEL_HEIGHT = 0.16  # m, between the labels of robots that are in one place
_GRAB_REACH = 3.0  # m, the farthest that a drag counts
_LOCAL = r"(localhost|127\.0\.0\.1|\[::1\])(:\d+)?"  # names that no website can have; tunnels have other ports
_STARTING = threading.Lock()


def has_viser() -> bool:
    """Whether viser is installed."""
    return find_spec("viser") is not None


def import_viser() -> Any:
    """viser, or an ImportError that says what to do."""
    with imports_of('the page of render_mode="human" and of `ballbot play`', "play"):
        import viser
    return viser


class Viewer:
    """A server whose page shows the last drawing. `server` is viser's. Every browser that opens `address` sees the same.

    It listens on this machine alone.
    """

    def __init__(self, port: int = PORT, label: str = "ballbot"):
        """Starts the server.

        Args:
            port: where to listen, or the next free one if it is taken; 0 is any free one.
            label: title of the page.

        Raises:
            ImportError: viser is missing.
            ValueError: no such port.
        """
        viser = import_viser()
        if not 0 <= port < 2**16:  # viser would wait for ever
            raise ValueError(f"port must be 0 to {2**16 - 1}, not {port}")
        # Whoever leaves while the server stops would get a traceback onto the user's terminal.
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        with contextlib.redirect_stdout(io.StringIO()), _guarded():  # viser greets with an address
            self.server = viser.ViserServer(host="127.0.0.1", port=port, label=label, verbose=False)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.on_grab: Callable[[np.ndarray], object] | None = None
        """Gets how far (2,) on the floor somebody has dragged the robot, m, when the drag ends."""
        self._next = 0.0
        self._looks: object = None
        self._parts: list[list[Any]] = []
        self._shift = np.zeros(2)
        scene = self.server.scene
        scene.set_up_direction("+z")
        scene.configure_default_lights(cast_shadow=False)  # shadows of light are slow without a graphics card
        scene.world_axes.visible = False
        self.server.initial_camera.position, self.server.initial_camera.look_at = _EYE, _AIM
        self._world, self._bodies = (scene.add_frame(name, show_axes=False) for name in ("/world", "/world/bodies"))
        self._lines = scene.add_line_segments("/world/lines", *_segments(()), thickness=0.015)
        self._arrows = {
            color: scene.add_arrows(f"/world/{color}", _segments(())[0], rgb(color)) for color in (FORCE, PUSH)
        }
        scene.add_grid(
            "/world/floor",
            infinite_grid=True,
            cell_size=_SQUARE,
            section_size=5 * _SQUARE,
            cell_color=(205, 210, 218),
            section_color=(165, 172, 186),
            fade_distance=40.0,
            shadow_opacity=0.0,
        )

    @property
    def address(self) -> str:
        """What to open in a browser."""
        return f"http://localhost:{self.server.get_port()}"

    def draw(self, drawing: Drawing) -> None:
        """Shows a moment. What is the same as before is not sent again."""
        params, robots = drawing.params, drawing.robots[::-1]
        looks = params, drawing.posts, [(robot.color, robot.alpha) for robot in robots]
        with self.server.atomic():
            self._follow(drawing.centre)
            if looks != self._looks:
                self._looks, self._parts = looks, self._add_bodies(drawing)
            for i, (robot, (ball, body, _, label)) in enumerate(zip(robots, self._parts, strict=True)):
                place = pose(params, robot.x)
                ball.position, body.position, body.wxyz = place.ball, place.body, place.turn
                label.text, label.visible = robot.label, robot.label != ""
                label.position = place.top + (0.0, 0.0, _LABEL_HEIGHT * (i + 1))
            shown = [arrow for robot in robots for arrow in arrows(pose(params, robot.x), robot)]
            for color, node in self._arrows.items():
                ends = [ends for own, ends in shown if own == color]
                node.points = np.array(ends, np.float32).reshape(-1, 2, 3)
            self._lines.points, self._lines.colors = _segments(drawing.lines)

    def show(self, drawing: Drawing, seconds: float) -> None:
        """Shows a moment when so much time has passed since the last one, s."""
        now = time.perf_counter()
        self._next = max(self._next + seconds, now)
        time.sleep(self._next - now)
        self.draw(drawing)

    def close(self) -> None:
        """Stops the server; may be called again."""
        self.server.stop()

    def _follow(self, goal: np.ndarray) -> None:
        """Moves the scene so that a point of the floor (2,), m, comes to the middle."""
        at_once = self._looks is None or np.hypot(*(goal - self._shift)) > _JUMP
        self._shift = self._shift + (1.0 if at_once else _FOLLOW) * (goal - self._shift)
        self._world.position = (-self._shift[0], -self._shift[1], 0.0)

    def _add_bodies(self, drawing: Drawing) -> list[list[Any]]:
        """Adds posts and robots in place of those before. Nodes of each robot, the last one first, which can be dragged."""
        scene, name = self.server.scene, "/world/bodies"
        self._bodies.remove()
        self._bodies = scene.add_frame(name, show_axes=False)
        for i, post in enumerate(drawing.posts):
            look = {"position": (*post.position, post.height / 2), "opacity": _opacity(post.color[3])}
            scene.add_cylinder(f"{name}/post{i}", post.radius, post.height, rgb(post.color), **look)
        robots = enumerate(drawing.robots[::-1])
        parts = [self._add_robot(f"{name}/robot{i}", drawing.params, robot) for i, robot in robots]
        for part in parts[0][:3] if parts else ():
            part.on_drag("left")(self._grabbed)
        return parts

    def _add_robot(self, name: str, params: BallbotParams, robot: Robot) -> list[Any]:
        scene, radius, length = self.server.scene, params.body_radius, params.body_length
        look = {"opacity": _opacity(robot.alpha), "cast_shadow": False, "receive_shadow": False}
        ball = scene.add_icosphere(f"{name}/ball", params.ball_radius, rgb(BALL), **look)
        body = scene.add_cylinder(f"{name}/body", radius, length, rgb(robot.color), **look)
        place = (0.0, 0.0, 0.44 * length)
        cap = scene.add_cylinder(f"{name}/body/cap", 1.02 * radius, 0.06 * length, rgb(BALL), position=place, **look)
        scene.add_cylinder(
            f"{name}/ball/shadow",
            1.3 * params.ball_radius,
            0.002,
            (40, 45, 60),
            position=(0.0, 0.0, _SHADOW_HEIGHT - params.ball_radius),
            **look | {"opacity": _SHADOW * robot.alpha},
        )
        return [ball, body, cap, scene.add_label(f"{name}/label", "", anchor="bottom-center", visible=False)]

    async def _grabbed(self, event: Any) -> None:
        """A coroutine, so that viser keeps the order of the events."""
        if self.on_grab is not None and event.phase == "end":
            self.on_grab(_dragged(event))


@contextlib.contextmanager
def _guarded() -> Iterator[None]:
    """A viser server that is started meanwhile answers no other website.

    Any page that is open in a browser can connect to a server on the same machine, and can give this machine a name that it
    owns. So `Host` and `Origin` of every request are checked, and nobody may frame the page.

    Raises:
        RuntimeError: none was started, or this version of viser starts it in another way.
    """
    from websockets.asyncio import server

    guarded = False

    def serve(handler: Any, host: str, port: int, **settings: Any) -> Any:
        nonlocal guarded
        guarded, answer = True, settings["process_request"]

        def process_request(connection: Any, request: Any) -> Any:
            if refusal := _refusal(request.headers):
                return connection.respond(403, refusal)
            response = answer(connection, request)
            if response is not None:
                response.headers["Content-Security-Policy"] = "frame-ancestors 'self'"
            return response

        settings["process_request"] = process_request
        return start(handler, host, port, **settings)

    with _STARTING:  # else another thread's guard could be kept for ever
        start = server.serve
        server.serve = serve  # pyright: ignore[reportAttributeAccessIssue] viser takes no other
        try:
            yield
        finally:
            server.serve = start
    if not guarded:
        raise RuntimeError("this version of viser cannot be guarded; install the one that constraints.txt names")


def _refusal(headers: Any) -> str:
    """Why a request with these headers is not answered; "" where it is."""
    hosts = headers.get_all("Host")
    if len(hosts) != 1 or not re.fullmatch(_LOCAL, hosts[0]):
        return "open the address that was printed: the page has no other name"
    if any(origin != f"http://{hosts[0]}" for origin in headers.get_all("Origin")):
        return "another page may not connect"
    return ""


def _opacity(alpha: float) -> float | None:
    return None if alpha == 1 else alpha


def _segments(paths: Sequence[GroundPath]) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2, 3) the line segments of paths, m, and the colours of their ends."""
    segments, colors = [np.zeros((0, 2, 3), np.float32)], [np.zeros((0, 2, 3), np.uint8)]
    for path in paths:
        on_floor = np.column_stack([path.points, np.full(len(path.points), _LINE_HEIGHT)])
        segments.append(np.stack([on_floor[:-1], on_floor[1:]], axis=1)[:: _DASH if path.dashed else 1])
        colors.append(np.full(segments[-1].shape, rgb(path.color)))
    return np.concatenate(segments, dtype=np.float32), np.concatenate(colors, dtype=np.uint8, casting="unsafe")


def _dragged(event: Any) -> np.ndarray:
    """(2,) how far the pointer has dragged the robot on the floor, m; where that is unclear, along the screen."""
    start, end = np.array(event.start_position, np.float64), np.array(event.end_position, np.float64)
    eye = np.array(event.client.camera.position, np.float64)
    ray = end - eye
    on_level = end
    if ray[2] < -1e-3 and eye[2] > start[2]:  # the pointer's ray meets the level at which the robot was taken
        on_level = eye + (start[2] - eye[2]) / ray[2] * ray
    vector = (on_level - start)[:2]
    length = float(np.hypot(*vector))
    return vector * (_GRAB_REACH / max(length, _GRAB_REACH)) if math.isfinite(length) else np.zeros(2)
