"""Pictures of a `Drawing`, by NumPy and Pillow: they need neither a display nor OpenGL, and are the same on every machine.

What is far from the camera is painted first. All is painted twice as large and then halved, so that edges are smooth.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFilter

from ballbot_gym.drawing import BALL, FORCE, PUSH, Drawing, Robot, arrow, body_axis, pose, push_arrow, ring
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks.marker import Marker

YAW = math.radians(-55)
"""Direction in which pictures look, rad from the y axis, positive to the left: from behind a robot that moves along x."""
_PITCH, _DISTANCE = math.radians(20), 3.4  # rad, m
_HALF_HEIGHT = 0.42  # of the view, as a tangent
_AIM_HEIGHT = 0.55  # m above the floor
_NEAR = 0.4  # m: what is closer to the camera's plane is not drawn
_FLOOR_REACH = 12  # m
_FINE = 2  # pixels painted for one pixel of the picture, each way
_LINE = 2.2 / 480  # width of a line, in heights of the picture
_DASH = 0.09  # m, of dashed lines, and of the gaps between them
_LINE_HEIGHT = 0.004  # m
_SHADOW, _BLUR = 0.30, 1 / 200  # darkness; softness in heights of the picture
_LIGHT = np.array([-0.45, -0.55, 1.0]) / math.sqrt(0.45**2 + 0.55**2 + 1)  # towards the light
_ANGLES = np.linspace(0, 2 * math.pi, 32, endpoint=False)
_FLOOR, _TILE, _NIGHT = np.array([250, 250, 248]), np.array([203, 210, 221]), (26, 31, 51)
_FLAT = 0.05  # m: lower markers are painted on the floor
_CAP = 0.06  # of the body's length, in the ball's colour at its top
_SPHERE = ((1.0, -0.35), (0.93, -0.2), (0.82, -0.05), (0.66, 0.08), (0.48, 0.2), (0.3, 0.34), (0.13, 0.5))
"""Discs that make a shaded sphere: their radius, and how light they are."""


Rgb = tuple[int, int, int]


class Camera:
    """A camera that looks at a point from the side and above. Picture coordinates are tangents of angles from the middle."""

    def __init__(self, target: np.ndarray, distance: float = _DISTANCE):
        """Args: target (3,) and the distance from it, m."""
        ahead = np.array([-math.sin(YAW) * math.cos(_PITCH), math.cos(YAW) * math.cos(_PITCH), -math.sin(_PITCH)])
        right = np.array([math.cos(YAW), math.sin(YAW), 0.0])
        self.eye = np.asarray(target) - distance * ahead
        self._axes = np.stack([right, np.cross(right, ahead), ahead])

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Projects points (..., 3), m, to picture coordinates (..., 2), and depths (...), m, of at least `_NEAR`."""
        seen = (np.asarray(points, np.float64) - self.eye) @ self._axes.T
        depth = np.maximum(seen[..., 2], _NEAR)
        return seen[..., :2] / depth[..., None], depth


def picture(drawing: Drawing, width: int = 640, height: int = 480) -> np.ndarray:
    """(height, width, 3) uint8 of a moment.

    The camera looks at the robots' centre, from the farther away the more they spread.
    """
    return _Painter(drawing, width, height).paint()


class _Painter:
    """One picture."""

    def __init__(self, drawing: Drawing, width: int, height: int):
        self._drawing, self._size = drawing, (width, height)
        self._camera = Camera(np.array([*drawing.centre, _AIM_HEIGHT]), _DISTANCE + drawing.spread)
        self._image = Image.new("RGB", (_FINE * width, _FINE * height), tuple(_FLOOR.tolist()))
        self._pen = ImageDraw.Draw(self._image)
        self._scale = _FINE * height / (2 * _HALF_HEIGHT)  # pixels painted per unit of picture coordinates

    def paint(self) -> np.ndarray:
        markers, robots = self._drawing.markers, self._drawing.robots
        self._paint_floor()
        for marker in markers:
            if marker.ring:
                self._paint_line(ring(marker), rgb(marker.color), dashed=True)
            elif marker.height < _FLAT:
                self._paint_marker(marker)
        for path in self._drawing.paths:
            self._paint_line(path.points, rgb(path.color), path.dashed)
        self._paint_shadows()
        bodies = [
            (self._depth(_foot(marker)), marker) for marker in markers if not marker.ring and marker.height >= _FLAT
        ]
        bodies += [(self._depth(robot.x[:2]), robot) for robot in robots]
        for _, body in sorted(bodies, key=lambda body: -body[0]):
            if isinstance(body, Marker):
                self._paint_marker(body)
            else:
                self._paint_robot(body)
        return np.asarray(self._image.reduce(_FINE))

    def _depth(self, point: Sequence[float] | np.ndarray) -> float:
        return float(self._camera.project(np.array([*point[:2], 0.0]))[1])

    def _pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The pixels (..., 2) of points (..., 3), and their depths."""
        places, depth = self._camera.project(points)
        width, height = self._image.size
        return places * (self._scale, -self._scale) + (width / 2, height / 2), depth

    def _paint_floor(self) -> None:
        """Paints every other square metre, paler with the distance."""
        low = np.floor(self._drawing.centre).astype(int) - _FLOOR_REACH
        i, j = np.meshgrid(*(np.arange(start, start + 2 * _FLOOR_REACH + 1) for start in low), indexing="ij")
        dark = (i + j) % 2 == 0
        corners = np.stack([i[dark], j[dark], np.zeros(dark.sum())], axis=-1)[:, None] + np.array(
            [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
        )
        places, depth = self._pixels(corners)
        inside = ((places.max(axis=1) > 0) & (places.min(axis=1) < self._image.size)).all(axis=1)
        seen = (depth > _NEAR).all(axis=1) & inside
        fade = np.clip(1 - depth[seen].mean(axis=1) / (_FLOOR_REACH + 2), 0, 1)
        colors = (_FLOOR + fade[:, None] * (_TILE - _FLOOR)).astype(int)
        for outline, color in zip(places[seen].reshape(-1, 8).tolist(), colors.tolist(), strict=True):
            self._pen.polygon(outline, tuple(color))

    def _paint_line(self, points: np.ndarray, color: Rgb, dashed: bool) -> None:
        """Paints a line on the floor through points (n, 2), m, where it is in front of the camera."""
        way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        if dashed:
            stops = np.append(np.arange(0.0, way[-1], _DASH / 3), way[-1])
            points, way = np.column_stack([np.interp(stops, way, column) for column in points.T]), stops
        places, depth = self._pixels(np.column_stack([points, np.full(len(points), _LINE_HEIGHT)]))
        shown = (depth > _NEAR) & (not dashed or (way / _DASH + 1e-9).astype(int) % 2 == 0)
        for run in np.split(np.arange(len(places)), np.flatnonzero(np.diff(shown)) + 1):
            if len(run) and shown[run[0]]:
                ends = places[run[0] : run[-1] + 2].ravel().tolist()  # a dash goes on to the point where the gap begins
                self._pen.line(ends, color, round(_LINE * self._image.height), joint="curve")

    def _paint_shadows(self) -> None:
        """Paints the soft shadows of all robots and markers."""
        height = self._size[1]
        mask = Image.new("L", self._size)
        pen = ImageDraw.Draw(mask)
        for outlines, darkness in self._shadows():
            places, depth = self._pixels(outlines)
            for outline in places[(depth > _NEAR).all(axis=1)] / _FINE:
                pen.polygon(outline.ravel().tolist(), round(255 * darkness))
        blur = _BLUR * height
        if (box := mask.getbbox()) is None:
            return
        box = _grown(box, 2 * blur, self._size)
        fine = (_FINE * box[0], _FINE * box[1], _FINE * box[2], _FINE * box[3])
        soft = mask.crop(box).filter(ImageFilter.BoxBlur(blur))
        soft = soft.resize((fine[2] - fine[0], fine[3] - fine[1]), Image.Resampling.BILINEAR)
        self._image.paste(_NIGHT, fine, soft)

    def _shadows(self) -> Iterator[tuple[np.ndarray, float]]:
        """Outlines (n, k, 3) on the floor, whose union is the shadow of a body, and how dark they are."""
        for marker in self._drawing.markers:
            if not marker.ring and marker.height >= _FLAT:
                foot = _foot(marker)
                yield _cast(foot, foot + (0, 0, marker.height), marker.radius), _SHADOW
        for robot in sorted(self._drawing.robots, key=lambda robot: robot.alpha):
            ball, low, high = _parts(self._drawing.params, robot)
            radius = self._drawing.params.ball_radius
            darkness = _SHADOW * robot.alpha
            yield _cast(ball - (0, 0, radius / 2), ball + (0, 0, radius / 2), radius), darkness
            yield _cast(low, high, self._drawing.params.body_radius), darkness

    def _paint_marker(self, marker: Marker) -> None:
        foot, radius, color = _foot(marker), marker.radius, rgb(marker.color)
        top = foot + (0, 0, marker.height)
        with self._glass(marker.color[3], np.array([foot, top]), radius):
            if marker.height < _FLAT:
                self._pen.polygon(self._pixels(_circle(top, radius))[0].ravel().tolist(), color)
            else:
                self._paint_cylinder(foot, top, radius, color)

    def _paint_robot(self, robot: Robot) -> None:
        params = self._drawing.params
        bare = robot if robot.alpha == 1 else replace(robot, u=None, push=None)
        with self._glass(robot.alpha, np.array(_parts(params, robot)), max(params.ball_radius, params.body_radius)):
            self._paint_parts(bare)

    @contextmanager
    def _glass(self, alpha: float, points: np.ndarray, radius: float) -> Iterator[None]:
        """What is painted within the block, closer than a radius to points (n, 3), is translucent where alpha < 1."""
        if alpha == 1:
            yield
            return
        places, depth = self._pixels(points)
        reach = 1.5 * self._scale * radius / float(depth.min())
        box = _grown((*places.min(axis=0), *places.max(axis=0)), reach, self._image.size)
        before = self._image.crop(box)
        yield
        self._image.paste(Image.blend(before, self._image.crop(box), alpha), box)

    def _paint_parts(self, robot: Robot) -> None:
        params = self._drawing.params
        ball, low, high = _parts(params, robot)
        neck = high - _CAP * params.body_length * body_axis(robot.x)
        radius = params.body_radius
        parts = [
            (ball, lambda: self._paint_sphere(ball, params.ball_radius, rgb(BALL))),
            ((low + high) / 2, lambda: self._paint_cylinder(low, neck, radius, rgb(robot.color))),
            ((low + 3 * high) / 4, lambda: self._paint_cylinder(neck, high, 1.02 * radius, rgb(BALL))),
        ]
        if (ends := arrow(params, robot)) is not None:
            parts.append(((ends[0] + ends[1]) / 2, lambda: self._paint_arrow(*ends, rgb(FORCE))))
        if (push := push_arrow(params, robot)) is not None:
            parts.append(((push[0] + push[1]) / 2, lambda: self._paint_arrow(*push, rgb(PUSH))))
        for _, paint in sorted(parts, key=lambda part: -float(self._camera.project(part[0])[1])):
            paint()

    def _paint_sphere(self, centre: np.ndarray, radius: float, color: Rgb) -> None:
        (x, y), depth = self._pixels(centre)
        if depth <= _NEAR:
            return
        size = self._scale * radius / float(depth)
        for share, light in _SPHERE:
            reach = share * size
            px, py = x - 0.3 * (size - reach), y - 0.42 * (size - reach)  # towards the light
            self._pen.ellipse((px - reach, py - reach, px + reach, py + reach), _lighter(color, light))

    def _paint_cylinder(self, low: np.ndarray, high: np.ndarray, radius: float, color: Rgb) -> None:
        axis = (high - low) / np.linalg.norm(high - low)
        normals = _around(axis)
        rings, depth = self._pixels(np.stack([low + radius * normals, high + radius * normals]))
        if (depth <= _NEAR).any():
            return
        after = np.roll(np.arange(len(normals)), -1)
        sides = normals + normals[after]
        faces = np.concatenate([rings[0], rings[0][after], rings[1][after], rings[1]], axis=1)
        lights = sides @ _LIGHT / np.linalg.norm(sides, axis=1)
        for k in np.flatnonzero(sides @ (self._camera.eye - low) > 2 * radius):
            self._pen.polygon(faces[k].tolist(), _shaded(color, float(lights[k])))
        for end, rim, outward in ((low, rings[0], -axis), (high, rings[1], axis)):
            if outward @ (self._camera.eye - end) > 0:
                self._pen.polygon(rim.ravel().tolist(), _shaded(color, 0.3 + float(outward @ _LIGHT)))

    def _paint_arrow(self, start: np.ndarray, end: np.ndarray, color: Rgb) -> None:
        """A horizontal arrow between points (3,), m."""
        length = float(np.linalg.norm(end - start))
        along, head = (end - start) / length, min(0.16, length)
        aside = np.array([-along[1], along[0], 0.0])
        neck = end - head * along
        half = [start - 0.02 * aside, neck - 0.02 * aside, neck - 0.07 * aside, end]
        outline = np.array([*half, neck + 0.07 * aside, neck + 0.02 * aside, start + 0.02 * aside])
        places, depth = self._pixels(outline)
        if (depth > _NEAR).all():
            self._pen.polygon(places.ravel().tolist(), color)


class PictureScene:
    """Draws states of one ballbot among a task's markers as pictures of 640 × 480."""

    def __init__(self, params: BallbotParams):
        self._params, self._markers = params, ()

    def set_markers(self, markers: Sequence[Marker]) -> None:
        """Replaces the task's markers."""
        self._markers = tuple(markers)

    def draw(self, x: Sequence[float]) -> np.ndarray:
        """(480, 640, 3) uint8 of state x (8,)."""
        return picture(Drawing(self._params, (Robot(np.array(x)),), markers=self._markers))

    def close(self) -> None:
        """There is nothing to release."""


def _grown(box: Sequence[float], by: float, size: tuple[int, int]) -> tuple[int, int, int, int]:
    """A box (left, upper, right, lower) of pixels, larger by some, within a picture of some size."""
    left, upper = (min(max(math.floor(low - by), 0), limit - 1) for low, limit in zip(box[:2], size, strict=True))
    right, lower = (min(max(math.ceil(high + by), 1), limit) for high, limit in zip(box[2:], size, strict=True))
    return left, upper, max(right, left + 1), max(lower, upper + 1)


def _parts(params: BallbotParams, robot: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The ball's centre, and the two ends of the body's axis."""
    place = pose(params, robot.x)
    return place.ball, 2 * place.body - place.top, place.top


def _foot(marker: Marker) -> np.ndarray:
    return np.array([*marker.position, 0.0])


def _circle(centre: np.ndarray, radius: float) -> np.ndarray:
    """(n, 3) points of a horizontal circle."""
    return centre + radius * np.stack([np.cos(_ANGLES), np.sin(_ANGLES), 0 * _ANGLES], axis=1)


def _around(axis: np.ndarray) -> np.ndarray:
    """(n, 3) unit vectors around a unit vector, at right angles to it."""
    across = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.9 else [0, 1.0, 0])
    across /= np.linalg.norm(across)
    return np.outer(np.cos(_ANGLES), across) + np.outer(np.sin(_ANGLES), np.cross(axis, across))


def _cast(low: np.ndarray, high: np.ndarray, radius: float) -> np.ndarray:
    """(n, 4, 3) the shadows on the floor of what a cylinder's sides are made of, from its axis outwards."""
    normals = radius * _around((high - low) / np.linalg.norm(high - low))
    ends = np.stack([low + normals, low - normals, high - normals, high + normals], axis=1)
    rims = np.stack(
        [
            end + np.stack([normals, np.roll(normals, -1, 0), -normals, -np.roll(normals, -1, 0)], 1)
            for end in (low, high)
        ]
    )
    points = np.concatenate([ends, *rims])
    return points - points[..., 2:] * (_LIGHT / _LIGHT[2])


def rgb(color: str | Sequence[float]) -> Rgb:
    """Red, green and blue, 0 to 255, of a colour "#rrggbb", or of one of shares."""
    if isinstance(color, str):
        return ImageColor.getrgb(color)[:3]
    red, green, blue = (round(255 * share) for share in color[:3])
    return red, green, blue


def _shaded(color: Rgb, light: float) -> Rgb:
    """The colour, darker or lighter by the `light` that falls on it, 0 to 1."""
    return _lighter(color, -0.25 + 0.5 * min(max(light, 0.0), 1.0))


def _lighter(color: Rgb, share: float) -> Rgb:
    """The colour mixed with white, or with black if share < 0."""
    target = 255 if share > 0 else 0
    red, green, blue = (round(value + abs(share) * (target - value)) for value in color)
    return red, green, blue
