"""The ballbot in perspective, drawn with polygons of matplotlib, so that lines are clean and ghosts are translucent.

A sphere is drawn as a circle, and a cylinder as the hull of its two end circles. Bodies far from the camera are painted
first.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from scipy.spatial import ConvexHull

from ballbot_gym.drawing import BALL, FORCE, Drawing, GroundPath, Robot, arrow, body_axis
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks.marker import Marker

_YAW, _PITCH, _DISTANCE = (
    math.radians(-55),
    math.radians(20),
    3.4,
)  # rad, rad, m: from behind a robot that moves along x
_HALF_HEIGHT = 0.42  # of the view, as a tangent
_AIM_HEIGHT = 0.55  # m above the floor
_NEAR = 0.4  # m: points closer to the camera's plane are not drawn
_FLOOR_REACH = 12  # m
_LIGHT = np.array([-0.45, -0.55, 1.0]) / math.sqrt(0.45**2 + 0.55**2 + 1)  # towards the light
_ANGLES = np.linspace(0, 2 * math.pi, 28, endpoint=False)

Rgb = tuple[float, float, float]
Rgba = tuple[float, float, float, float]


class Camera:
    """A camera that looks at a point from the side and above. Picture coordinates are tangents of angles from the middle."""

    def __init__(self, target: np.ndarray, distance: float = _DISTANCE):
        """Args: target (3,) and the distance from it, m."""
        ahead = np.array([-math.sin(_YAW) * math.cos(_PITCH), math.cos(_YAW) * math.cos(_PITCH), -math.sin(_PITCH)])
        right = np.array([math.cos(_YAW), math.sin(_YAW), 0.0])
        self.eye = np.asarray(target) - distance * ahead
        self._axes = np.stack([right, np.cross(right, ahead), ahead])

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Projects points (..., 3), m, to picture coordinates (..., 2), and depths (...), m, of at least `_NEAR`."""
        seen = (np.asarray(points, np.float64) - self.eye) @ self._axes.T
        depth = np.maximum(seen[..., 2], _NEAR)
        return seen[..., :2] / depth[..., None], depth


class PerspectiveView:
    """One axes with robots, paths and markers on a chequered floor. Each call of `draw` replaces its contents."""

    def __init__(self, axis: Axes, aspect: float):
        """Args: aspect is the axes' width over its height."""
        axis.set(xlim=(-_HALF_HEIGHT * aspect, _HALF_HEIGHT * aspect), ylim=(-_HALF_HEIGHT, _HALF_HEIGHT))
        axis.set_xticks([])
        axis.set_yticks([])
        axis.set_facecolor("#fbfbfa")
        for spine in axis.spines.values():
            spine.set_color("0.85")
        self._floor = PolyCollection([], lw=0)
        self._lines = LineCollection([], capstyle="round")
        self._solids = PolyCollection([], lw=0.3)
        for collection in (self._floor, self._lines, self._solids):
            axis.add_collection(collection)
        self._solids.set_snap(False)  # snapping makes the edges of thin upright bodies wavy
        self.artists = (self._floor, self._lines, self._solids)

    def draw(self, drawing: Drawing) -> None:
        """Draws a moment. The camera looks at the robots' centre, from the farther away the more they spread."""
        camera = Camera(np.array([*drawing.centre, _AIM_HEIGHT]), _DISTANCE + drawing.spread)
        params = drawing.params
        self._draw_floor(camera, drawing.centre)
        self._draw_lines(camera, drawing.paths, drawing.markers)
        solids = [(0.0, _shadow(camera, params, robot)) for robot in drawing.robots]  # shadows lie under all bodies
        bodies = [_marker(camera, marker) for marker in drawing.markers if not marker.ring]
        for robot in drawing.robots:
            bodies += _robot(camera, params, robot)
        solids += sorted(bodies, key=lambda body: -body[0])
        faces = [face for _, body in solids for face in body]
        self._solids.set_verts([outline for outline, _ in faces])
        self._solids.set_facecolor([color for _, color in faces])
        self._solids.set_edgecolor([color if color[3] == 1 else (0, 0, 0, 0) for _, color in faces])

    def _draw_floor(self, camera: Camera, middle: np.ndarray) -> None:
        """Draws every other square metre, paler with the distance."""
        low = np.floor(middle).astype(int) - _FLOOR_REACH
        i, j = np.meshgrid(*(np.arange(start, start + 2 * _FLOOR_REACH + 1) for start in low), indexing="ij")
        dark = (i + j) % 2 == 0
        corners = np.stack([i[dark], j[dark], np.zeros(dark.sum())], axis=-1)[:, None] + np.array(
            [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
        )
        places, depth = camera.project(corners)
        seen = (depth > _NEAR).all(axis=1)
        fade = np.clip(1 - depth[seen].mean(axis=1) / (_FLOOR_REACH + 2), 0, 1)
        self._floor.set_verts(list(places[seen]))
        self._floor.set_facecolor([(0.80, 0.83, 0.88, 0.8 * share) for share in fade])

    def _draw_lines(self, camera: Camera, paths: Sequence[GroundPath], markers: Sequence[Marker]) -> None:
        lines: list[tuple[np.ndarray, Sequence[float], Any, float]] = [
            (path.points, to_rgb(path.color), "--" if path.dashed else "-", 2.2) for path in paths
        ]
        for marker in markers:
            if marker.ring:
                around = marker.radius * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
                fine = np.concatenate([around, around[:1]]) + np.array(marker.position)
                lines.append((fine, marker.color[:3], (0, (4, 3)), 1.5))
        segments, colors, styles, widths = [], [], [], []
        for points, color, style, width in lines:
            places, depth = camera.project(np.column_stack([points, np.full(len(points), 0.004)]))
            for run in np.split(np.arange(len(places)), np.flatnonzero(np.diff(depth <= _NEAR)) + 1):
                if depth[run[0]] > _NEAR:  # only the part in front of the camera
                    segments.append(places[run])
                    colors.append(color)
                    styles.append(style)
                    widths.append(width)
        self._lines.set_segments(segments)
        self._lines.set_color(colors)
        self._lines.set_linestyle(styles)
        self._lines.set_linewidth(widths)


Face = tuple[np.ndarray, Rgba]
"""A polygon (n, 2) of the picture and its colour, RGBA."""


def _robot(camera: Camera, params: BallbotParams, robot: Robot) -> list[tuple[float, list[Face]]]:
    ball = np.array([robot.x[0], robot.x[1], params.ball_radius])
    axis = body_axis(robot.x)
    middle = ball + params.com_height * axis
    half = params.body_length / 2 * axis
    parts = [
        _sphere(camera, ball, params.ball_radius, to_rgb(BALL), robot.alpha),
        _cylinder(camera, middle - half, middle + half, params.body_radius, to_rgb(robot.color), robot.alpha),
    ]
    if (ends := arrow(params, robot)) is not None:
        parts.append(_arrow(camera, *ends, robot.alpha))
    return parts


def _marker(camera: Camera, marker: Marker) -> tuple[float, list[Face]]:
    foot = np.array([*marker.position, 0.0])
    depth, faces = _cylinder(
        camera, foot, foot + np.array([0, 0, marker.height]), marker.radius, marker.color[:3], marker.color[3]
    )
    return (math.inf if marker.height < 0.05 else depth), faces  # a disc is painted first


def _shadow(camera: Camera, params: BallbotParams, robot: Robot) -> list[Face]:
    """The shadow of ball and body on the floor."""
    ball = np.array([robot.x[0], robot.x[1], params.ball_radius])
    top = ball + (params.com_height + params.body_length / 2) * body_axis(robot.x)
    ring = params.ball_radius * np.stack([np.cos(_ANGLES), np.sin(_ANGLES), 0 * _ANGLES], axis=1)
    points = np.concatenate([ball + ring, top + ring])
    on_floor = points - points[:, 2:] * (_LIGHT / _LIGHT[2])
    return [(_hull(camera.project(on_floor)[0]), (0.1, 0.12, 0.2, 0.16 * robot.alpha))]


def _sphere(
    camera: Camera, centre: np.ndarray, radius: float, color: Sequence[float], alpha: float
) -> tuple[float, list[Face]]:
    (place,), (depth,) = camera.project(centre[None])
    circle = radius / depth * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
    glance = radius / depth * np.array([-0.3, 0.4])
    shades = ((1.0, 0.0), (0.6, 0.18), (0.25, 0.4)) if alpha == 1 else ((1.0, 0.0),)
    faces = [(place + size * circle + (1 - size) * glance, (*_lighter(color, light), alpha)) for size, light in shades]
    return depth, faces


def _cylinder(
    camera: Camera, low: np.ndarray, high: np.ndarray, radius: float, color: Sequence[float], alpha: float
) -> tuple[float, list[Face]]:
    axis = (high - low) / np.linalg.norm(high - low)
    across = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.9 else [0, 1.0, 0])
    across /= np.linalg.norm(across)
    normals = np.outer(np.cos(_ANGLES), across) + np.outer(np.sin(_ANGLES), np.cross(axis, across))
    rings = [camera.project(end + radius * normals)[0] for end in (low, high)]
    (_,), (depth,) = camera.project((low + high)[None] / 2)
    faces: list[Face] = [(_hull(np.concatenate(rings)), (*_shaded(color, 0.2), alpha))]
    if alpha == 1:  # the inner edges would show through translucent sides
        for k in range(len(normals)):
            after = (k + 1) % len(normals)
            normal = normals[k] + normals[after]
            if normal @ (camera.eye - low) > 2 * radius:
                side = np.array([rings[0][k], rings[0][after], rings[1][after], rings[1][k]])
                faces.append((side, (*_shaded(color, float(normal @ _LIGHT / np.linalg.norm(normal))), 1.0)))
    for end, ring, outward in ((low, rings[0], -axis), (high, rings[1], axis)):
        if outward @ (camera.eye - end) > 0:
            faces.append((ring, (*_shaded(color, float(0.3 + outward @ _LIGHT)), alpha)))
    return depth, faces


def _arrow(camera: Camera, start: np.ndarray, end: np.ndarray, alpha: float) -> tuple[float, list[Face]]:
    """A horizontal arrow between points (3,), m."""
    length = float(np.linalg.norm(end - start))
    along, head = (end - start) / length, min(0.16, length)
    aside = np.array([-along[1], along[0], 0.0])
    neck, tip = start + (length - head) * along, end
    outline = np.array(
        [
            start - 0.02 * aside,
            neck - 0.02 * aside,
            neck - 0.07 * aside,
            tip,
            neck + 0.07 * aside,
            neck + 0.02 * aside,
            start + 0.02 * aside,
        ]
    )
    places, depth = camera.project(outline)
    return float(depth.mean()), [(places, (*to_rgb(FORCE), alpha))]


def _hull(points: np.ndarray) -> np.ndarray:
    return points[ConvexHull(points, qhull_options="QJ").vertices]


def _shaded(color: Sequence[float], light: float) -> Rgb:
    """The colour, darker or lighter by the `light` that falls on it, 0 to 1."""
    return _lighter(color, -0.2 + 0.45 * min(max(light, 0.0), 1.0))


def _lighter(color: Sequence[float], share: float) -> Rgb:
    """The colour mixed with white, or with black if share < 0."""
    target = 1.0 if share > 0 else 0.0
    red, green, blue = (float(value + abs(share) * (target - value)) for value in color)
    return red, green, blue
