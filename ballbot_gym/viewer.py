"""A page in the browser that shows drawings live, by viser. It needs no display, because the browser draws.

This is the one place that knows viser's scene. `ballbot play` adds its controls beside the scene. An environment with
render_mode="human" shows itself here.
"""

import contextlib
import io
import logging
import math
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np

from ballbot_gym.drawing import BALL, FORCE, PUSH, Drawing, GroundPath, Robot, arrow, pose, push_arrow, ring
from ballbot_gym.engines import State
from ballbot_gym.lazy import missing
from ballbot_gym.params import BallbotParams
from ballbot_gym.picture import rgb
from ballbot_gym.tasks.marker import Marker

HOST, PORT = "127.0.0.1", 8080
_TRIED_PORTS = 100

_EYE, _AIM = (-2.6, -1.8, 1.5), (0.0, 0.0, 0.5)  # m: from behind a robot that moves along x
_SQUARE = 1.0  # m, of the floor
_LINE_HEIGHT = 0.008  # m, so that lines on the floor do not flicker
_SHADOW, _SHADOW_HEIGHT = 0.3, 0.003  # opacity, and m above the floor
_MOST_SEGMENTS = 120  # of a path
_DASH = 2  # a dashed line shows every second segment
_FOLLOW = 0.15  # share of the distance by which the camera follows in each drawing
_JUMP = 4.0  # m, of a distance that it follows at once
_LABEL_HEIGHT = 0.16  # m, between the labels of robots that are in one place
_GRAB_REACH = 3.0  # m, the farthest that a drag counts

Grab = Callable[[int, str, np.ndarray], None]
"""Gets the id of the client who drags the robot, "start", "update" or "end", and how far (2,) on the floor, m."""


def has_viser() -> bool:
    """Whether viser is installed."""
    return find_spec("viser") is not None


def import_viser() -> Any:
    """viser, or an ImportError that says what to do."""
    try:
        import viser
    except ModuleNotFoundError as error:
        raise missing('the page of render_mode="human" and of `ballbot play`', error.name, "play") from error
    return viser


class Viewer:
    """A server whose page shows the last drawing. `server` is viser's. Every browser that opens `address` sees the same."""

    def __init__(self, host: str = HOST, port: int = PORT, label: str = "ballbot"):
        """Starts the server.

        Args:
            host: address to bind. If others than this machine reach it, the page asks for the token in `address`.
            port: where to listen; the next free one, if it is taken.
            label: title of the page.

        Raises:
            ImportError: viser is missing.
            OSError: nothing can listen there.
        """
        viser = import_viser()
        from ballbot_gym.gate import Gate, guard  # it imports what comes with viser

        port, self._gate = _free_port(host, port), Gate(host)
        # Whoever sends garbage, or leaves while the server stops, would get a traceback onto the user's terminal.
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        # viser prints an address that may not be the one to open.
        with contextlib.redirect_stdout(io.StringIO()), guard(self._gate):
            self.server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.on_grab: Grab | None = None
        self._host = host
        self._nodes: dict[str, list[Any]] = {}
        self._looks: dict[str, Any] = {}
        self._shift = np.zeros(2)
        self._lock = threading.Lock()
        self._closed = False
        scene = self.server.scene
        scene.set_up_direction("+z")
        scene.configure_default_lights(cast_shadow=False)  # shadows of light are slow without a graphics card
        scene.world_axes.visible = False
        self.server.initial_camera.position, self.server.initial_camera.look_at = _EYE, _AIM
        self._world = scene.add_frame("/world", show_axes=False)
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
    def port(self) -> int:
        """Where the server listens."""
        return self.server.get_port()

    @property
    def address(self) -> str:
        """What to open in a browser, with the token if it takes one."""
        host = {HOST: "localhost", "0.0.0.0": socket.gethostname(), "::": socket.gethostname()}.get(
            self._host, self._host
        )
        token = f"/?token={self._gate.token}" if self._gate.token else ""
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}{token}"

    def draw(self, drawing: Drawing) -> None:
        """Shows a moment. What is the same as before is not sent again."""
        with self._lock:
            if self._closed:
                return
            with self.server.atomic():
                self._draw(drawing)

    def centre_on(self, point: np.ndarray) -> None:
        """Moves the scene at once so that a point of the floor (2,), m, is in the middle."""
        self._shift = np.asarray(point, np.float64).copy()

    def aim(self) -> None:
        """Turns every browser's camera to where it was first."""
        for client in self.server.get_clients().values():
            client.camera.position, client.camera.look_at = _EYE, _AIM

    def close(self) -> None:
        """Stops the server; may be called again."""
        with self._lock:
            if not self._closed:
                self._closed = True
                self.server.stop()

    def _draw(self, drawing: Drawing) -> None:
        goal = drawing.robots[-1].x[:2] if drawing.robots else np.zeros(2)
        self._shift += (_FOLLOW if np.hypot(*(goal - self._shift)) < _JUMP else 1.0) * (goal - self._shift)
        self._world.position = (-self._shift[0], -self._shift[1], 0.0)
        shown = {"markers"}
        self._draw_markers(drawing.markers)
        for i, robot in enumerate(reversed(drawing.robots)):
            shown |= self._draw_robot(drawing.params, robot, grab=i == 0)
            if robot.label:
                top = pose(drawing.params, robot.x).top + (0.0, 0.0, _LABEL_HEIGHT * (i + 1))
                shown.add(self._draw_label(f"label {robot.name}", robot.label, top))
        for path in drawing.paths:
            shown.add(self._draw_path(path))
        for key in set(self._nodes) - shown:
            self._remove(key)

    def _draw_robot(self, params: BallbotParams, robot: Robot, grab: bool) -> set[str]:
        """Moves a robot and its arrows; returns their keys."""
        key = f"robot {robot.name}"
        if self._looks.get(key) != (look := (params, robot.color, robot.alpha, grab)):
            self._remove(key)
            self._nodes[key], self._looks[key] = self._add_robot(params, robot, grab), look
        ball, body, _ = self._nodes[key]
        place = pose(params, robot.x)
        ball.position, body.position, body.wxyz = place.ball, place.body, place.turn
        keys = {key, f"force {robot.name}", f"push {robot.name}"}
        self._draw_arrow(f"force {robot.name}", arrow(params, robot), FORCE)
        self._draw_arrow(f"push {robot.name}", push_arrow(params, robot), PUSH)
        return keys

    def _add_robot(self, params: BallbotParams, robot: Robot, grab: bool) -> list[Any]:
        """The nodes that move, then the one that holds them all."""
        scene, name = self.server.scene, f"/world/{_node_name(robot.name)}"
        root = scene.add_frame(name, show_axes=False)
        opacity = None if robot.alpha == 1 else robot.alpha
        ball, body = (scene.add_frame(f"{name}/{part}", show_axes=False) for part in ("ball", "body"))
        look = {"opacity": opacity, "cast_shadow": False, "receive_shadow": False}
        sphere = scene.add_icosphere(f"{name}/ball/shape", params.ball_radius, rgb(BALL), **look)
        radius, length = params.body_radius, params.body_length
        shape = scene.add_cylinder(f"{name}/body/shape", radius, length, rgb(robot.color), **look)
        cap = scene.add_cylinder(
            f"{name}/body/cap",
            1.02 * radius,
            0.06 * length,
            rgb(BALL),
            position=(0.0, 0.0, 0.44 * length),
            **look,
        )
        scene.add_cylinder(
            f"{name}/ball/shadow",
            1.3 * params.ball_radius,
            0.002,
            (40, 45, 60),
            opacity=_SHADOW * robot.alpha,
            position=(0.0, 0.0, _SHADOW_HEIGHT - params.ball_radius),
            cast_shadow=False,
            receive_shadow=False,
        )
        if grab:
            for part in (sphere, shape, cap):
                part.on_drag("left")(self._grabbed)
        return [ball, body, root]

    def _draw_arrow(self, key: str, ends: tuple[np.ndarray, np.ndarray] | None, color: str) -> None:
        if key not in self._nodes:
            if ends is None:
                return
            name = f"/world/{_node_name(key)}"
            self._nodes[key] = [self.server.scene.add_arrows(name, np.array([ends]), rgb(color))]
        (node,) = self._nodes[key]
        node.visible = ends is not None
        if ends is not None:
            node.points = np.array([ends], np.float32)

    def _draw_label(self, key: str, text: str, place: np.ndarray) -> str:
        if key not in self._nodes:
            self._nodes[key] = [self.server.scene.add_label(f"/world/{_node_name(key)}", text, anchor="bottom-center")]
        (node,) = self._nodes[key]
        node.text, node.position = text, place
        return key

    def _draw_path(self, path: GroundPath) -> str:
        key = f"path {path.name}"
        segments = _segments(path)
        if self._looks.get(key) != path.color:
            self._remove(key)
            self._looks[key] = path.color
            name = f"/world/{_node_name(key)}"
            thickness = 0.02 if path.dashed else 0.015
            self._nodes[key] = [
                self.server.scene.add_line_segments(name, segments, rgb(path.color), thickness=thickness)
            ]
        (node,) = self._nodes[key]
        node.points = segments
        return key

    def _draw_markers(self, markers: Sequence[Marker]) -> None:
        if self._looks.get("markers") == tuple(markers):
            return
        self._remove("markers")
        self._looks["markers"] = tuple(markers)
        self._nodes["markers"] = [self._add_marker(i, marker) for i, marker in enumerate(markers)]

    def _add_marker(self, i: int, marker: Marker) -> Any:
        scene, (x, y), color = self.server.scene, marker.position, rgb(marker.color[:3])
        if marker.ring:
            segments = _segments(GroundPath(ring(marker), ""))
            return scene.add_line_segments(f"/world/marker{i}", segments, color, thickness=0.03)
        opacity = None if marker.color[3] == 1 else marker.color[3]
        return scene.add_cylinder(
            f"/world/marker{i}",
            marker.radius,
            marker.height,
            color,
            opacity=opacity,
            position=(x, y, marker.height / 2),
        )

    def _remove(self, key: str) -> None:
        nodes = self._nodes.pop(key, [])
        for node in nodes[-1:] if key.startswith("robot ") else nodes:
            node.remove()
        self._looks.pop(key, None)

    async def _grabbed(self, event: Any) -> None:
        """A coroutine, so that viser keeps the order of the events."""
        if self.on_grab is not None:
            self.on_grab(event.client_id, event.phase, _dragged(event))


class PageScene:
    """Shows an environment in a page, in real time. It has the methods of `PictureScene`."""

    def __init__(self, params: BallbotParams, frame_seconds: float):
        """Starts the page and says its address on stderr.

        Args:
            params: the robot.
            frame_seconds: s, between two drawings.

        Raises:
            ImportError: viser is missing.
        """
        self._viewer = Viewer()
        self._params, self._frame_seconds = params, frame_seconds
        self._markers: tuple[Marker, ...] = ()
        self._trace: list[np.ndarray] = []
        self._next = 0.0
        sys.stderr.write(f"the robot is shown at {self._viewer.address}\n")

    @property
    def address(self) -> str:
        """What to open in a browser."""
        return self._viewer.address

    def set_markers(self, markers: Sequence[Marker]) -> None:
        """Replaces the task's markers; an episode begins."""
        self._markers, self._trace = tuple(markers), []

    def draw(self, x: State) -> None:
        """Shows state x when its time has come."""
        now = time.perf_counter()
        self._next = max(self._next + self._frame_seconds, now)
        time.sleep(self._next - now)
        state = np.array(x)
        self._trace.append(state[:2])
        robot, path = Robot(state), GroundPath(np.array(self._trace), "#d97706")
        self._viewer.draw(Drawing(self._params, (robot,), (path,) if len(self._trace) > 1 else (), self._markers))

    def close(self) -> None:
        """Stops the page; may be called again."""
        self._viewer.close()


def _free_port(host: str, port: int) -> int:
    """The first port from `port` on where a server can listen. viser would wait for ever where there is none."""
    failure: Exception | None = None
    for attempt in range(port, port + (_TRIED_PORTS if port else 1)):
        try:
            socket.create_server((host, attempt), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
            return attempt
        except (OSError, OverflowError) as error:
            failure = error
    raise OSError(f"cannot listen on {host}, port {port}: {failure}; give another address or port of this machine")


def _segments(path: GroundPath) -> np.ndarray:
    """(n, 2, 3) the line segments of a path, at most `_MOST_SEGMENTS`."""
    points = path.points
    if len(points) > _MOST_SEGMENTS:
        points = points[np.linspace(0, len(points) - 1, _MOST_SEGMENTS + 1).round().astype(int)]
    on_floor = np.column_stack([points, np.full(len(points), _LINE_HEIGHT)]).astype(np.float32)
    segments = np.stack([on_floor[:-1], on_floor[1:]], axis=1)
    return segments[::_DASH] if path.dashed else segments


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
    if not math.isfinite(length):
        return np.zeros(2)
    return vector * min(1.0, _GRAB_REACH / length) if length else vector


def _node_name(name: str) -> str:
    """A name without what viser reads as a path."""
    return "".join(letter if letter.isalnum() else "_" for letter in name)
