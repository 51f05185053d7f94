"""Pictures of a `Drawing`, by NumPy and Pillow: they need neither a display nor OpenGL, and are the same on every machine.

Each body is a surface of revolution. Its faces that are turned to the camera are painted, those far away first. All is
painted twice as large and then halved, so that edges are smooth.
"""

import math
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageColor, ImageDraw

from ballbot_gym.drawing import Drawing, Drawn, GroundPath
from ballbot_gym.robot import Robot, Sphere
from ballbot_gym.tasks.marker import Marker

YAW = math.radians(-55)
"""Direction in which pictures look, rad from the y axis, positive to the left: from behind a robot that moves along x."""
_PITCH, _DISTANCE, _FARTHEST = math.radians(20), 3.4, 6.4  # rad, m, m
_HALF_HEIGHT = 0.42  # of the view, as a tangent
_AIM_HEIGHT = 0.55  # m above the floor
_NEAR = 0.4  # m: what is closer to the camera's plane is not drawn
_FLOOR_REACH = 12  # m
_FINE = 2  # pixels painted for one pixel of the picture, each way
_LINE = 2.2 / 480  # width of a line, in heights of the picture
_DASH = 0.09  # m, of dashed lines, and of the gaps between them
_LINE_HEIGHT = 0.004  # m
_SHADOW = 0.3  # darkness
_LIGHT = np.array([-0.45, -0.55, 1.0]) / math.sqrt(0.45**2 + 0.55**2 + 1)  # towards the light
_FLOOR, _TILE, _NIGHT = np.array([250, 250, 248]), np.array([203, 210, 221]), (26, 31, 51)
_FLAT = 0.05  # m: lower markers are painted on the floor
_ARROW, _HEAD, _HEAD_LENGTH = 0.02, 0.07, 0.16  # m, radii of an arrow and of its head

Rgb = tuple[int, int, int]
_Solid = tuple[np.ndarray, str | Sequence[float]]  # faces (n, 4, 3), m, and their colour


def _turned(*profile: tuple[float, float]) -> np.ndarray:
    """(n, 4, 3) faces of the surface that points (radius, z), from below to above, make when they are turned about z."""
    radius, z = np.array(profile).T[..., None]
    angles = np.linspace(0, 2 * math.pi, 25)
    rings = np.stack([radius * np.cos(angles), radius * np.sin(angles), z + 0 * angles], axis=-1)
    low, high = rings[:-1], rings[1:]
    return np.stack([low[:, :-1], low[:, 1:], high[:, 1:], high[:, :-1]], axis=2).reshape(-1, 4, 3)


_SPHERE = _turned(*((math.sin(a), 0.5 - 0.5 * math.cos(a)) for a in np.linspace(0, math.pi, 11)))
_CYLINDER = _turned((0, 0), (1, 0), (1, 1), (0, 1))
_CONE = _turned((0, 0), (1, 0), (0, 1))


def _placed(mesh: np.ndarray, low: np.ndarray, high: np.ndarray, radius: float) -> np.ndarray:
    """The faces of a mesh whose axis, z from 0 to 1, goes from one point (3,) to another, m."""
    axis = high - low
    length = float(np.linalg.norm(axis))
    across = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.9 * length else [0, 1.0, 0])
    across *= radius / np.linalg.norm(across)
    return low + mesh @ np.stack([across, np.cross(axis / length, across), axis])


def picture(drawing: Drawing, width: int = 640, height: int = 480) -> np.ndarray:
    """(height, width, 3) uint8 of a moment.

    The camera looks at the last robot, from the farther away the more others spread.
    """
    return _Painter(drawing, width, height).paint()


class _Painter:
    """One picture."""

    def __init__(self, drawing: Drawing, width: int, height: int):
        self._drawing = drawing
        ahead = np.array([-math.sin(YAW) * math.cos(_PITCH), math.cos(YAW) * math.cos(_PITCH), -math.sin(_PITCH)])
        right = np.array([math.cos(YAW), math.sin(YAW), 0.0])
        spread = max(
            (math.dist(drawing.params.position(robot.x), drawing.centre) for robot in drawing.robots), default=0.0
        )
        self._eye = np.array([*drawing.centre, _AIM_HEIGHT]) - min(_DISTANCE + spread, _FARTHEST) * ahead
        self._axes = np.stack([right, np.cross(right, ahead), ahead])
        self._image = Image.new("RGB", (_FINE * width, _FINE * height), tuple(_FLOOR.tolist()))
        self._pen = ImageDraw.Draw(self._image)

    def paint(self) -> np.ndarray:
        posts, robots = self._drawing.posts, self._drawing.robots
        self._paint_floor()
        for post in posts:
            if post.height < _FLAT:
                self._paint_solids([_post(post)], post.color[3])
        for path in self._drawing.lines:
            self._paint_line(path)
        bodies = [(_robot(self._drawing.params, robot), robot.alpha) for robot in robots]
        bodies += [([_post(post)], post.color[3]) for post in posts if post.height >= _FLAT]
        self._paint_shadows(bodies)
        for robot, (solids, alpha) in zip(robots, bodies, strict=False):
            if alpha == 1 and (robot.u is not None or robot.push is not None):
                solids += _arrows(self._drawing, robot)
        for solids, alpha in sorted(bodies, key=lambda body: -self._pixels(body[0][0][0].mean(axis=(0, 1)))[1]):
            self._paint_solids(solids, alpha)
        return np.asarray(self._image.reduce(_FINE))

    def _pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The pixels (..., 2) of points (..., 3), m, and their depths (...), m, of at least `_NEAR`."""
        seen = (points - self._eye) @ self._axes.T
        depth = np.maximum(seen[..., 2], _NEAR)
        width, height = self._image.size
        scale = height / (2 * _HALF_HEIGHT)
        return seen[..., :2] / depth[..., None] * (scale, -scale) + (width / 2, height / 2), depth

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
        self._paint_polygons(places[seen], _FLOOR + fade[:, None] * (_TILE - _FLOOR))

    def _paint_line(self, path: GroundPath) -> None:
        """Paints a line on the floor, where it is in front of the camera."""
        way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path.points, axis=0).T))])
        stops = np.append(np.arange(0.0, way[-1], _DASH), way[-1])
        x, y = (np.interp(stops, way, column) for column in path.points.T)
        places, depth = self._pixels(np.column_stack([x, y, np.full(len(stops), _LINE_HEIGHT)]))
        for i in range(0, len(stops) - 1, 2 if path.dashed else 1):
            if (depth[i : i + 2] > _NEAR).all():
                self._pen.line(places[i : i + 2].ravel().tolist(), _rgb(path.color), round(_LINE * self._image.height))

    def _paint_shadows(self, bodies: Sequence[tuple[list[_Solid], float]]) -> None:
        """Paints the shadows of solids and their opacities on the floor; where two meet, the darker one."""
        mask = Image.new("L", self._image.size)
        pen = ImageDraw.Draw(mask)
        for solids, alpha in sorted(bodies, key=lambda body: body[1]):
            faces = np.concatenate([faces for faces, _ in solids])
            places, depth = self._pixels(faces - faces[..., 2:] * (_LIGHT / _LIGHT[2]))
            for outline in places[(depth > _NEAR).all(axis=1)].reshape(-1, 8).tolist():
                pen.polygon(outline, round(255 * _SHADOW * alpha))
        if box := mask.getbbox():
            self._image.paste(_NIGHT, box, mask.crop(box))

    def _paint_solids(self, solids: Sequence[_Solid], alpha: float) -> None:
        """Paints the faces that are turned to the camera, lit by the light, those far away first."""
        faces = np.concatenate([faces for faces, _ in solids])
        normals = np.cross(faces[:, 2] - faces[:, 0], faces[:, 3] - faces[:, 1])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        light = np.clip(normals @ _LIGHT, 0, 1)[:, None]
        colors = np.concatenate([np.tile(_rgb(color), (len(faces), 1)) for faces, color in solids])
        colors = np.minimum(colors * (0.8 + 0.3 * light) + 70 * light**8, 255)
        places, depth = self._pixels(faces)
        shown = (((self._eye - faces.mean(axis=1)) * normals).sum(axis=1) > 0) & (depth > _NEAR).all(axis=1)
        order = np.flatnonzero(shown)[np.argsort(-depth[shown].mean(axis=1))]
        ends = np.stack([places.min(axis=(0, 1)), places.max(axis=(0, 1)) + 2])
        box = tuple(np.clip(ends, 0, self._image.size).astype(int).ravel().tolist())
        before = self._image.crop(box)
        self._paint_polygons(places[order], colors[order])
        if alpha < 1:
            self._image.paste(Image.blend(before, self._image.crop(box), alpha), box)

    def _paint_polygons(self, places: np.ndarray, colors: np.ndarray) -> None:
        """Paints polygons (n, 4, 2) in colours (n, 3), 0 to 255."""
        for outline, color in zip(places.reshape(-1, 8).tolist(), colors.astype(int).tolist(), strict=True):
            self._pen.polygon(outline, tuple(color))


def _post(marker: Marker) -> _Solid:
    foot = np.array([*marker.position, 0.0])
    return _placed(_CYLINDER, foot, foot + (0, 0, marker.height), marker.radius), marker.color


def _robot(params: Robot, robot: Drawn) -> list[_Solid]:
    solids = []
    for shape in params.shapes(robot.x):
        if isinstance(shape, Sphere):
            centre, up = np.array(shape.centre), np.array([0, 0, shape.radius])
            faces = _placed(_SPHERE, centre - up, centre + up, shape.radius)
        else:
            faces = _placed(_CYLINDER, np.array(shape.start), np.array(shape.end), shape.radius)
        solids.append((faces, shape.color or robot.color))
    return solids


def _arrows(drawing: Drawing, robot: Drawn) -> list[_Solid]:
    solids = []
    for color, (start, end) in drawing.arrows(robot):
        neck = end - min(_HEAD_LENGTH / float(np.linalg.norm(end - start)), 0.9) * (end - start)
        solids += [(_placed(_CYLINDER, start, neck, _ARROW), color), (_placed(_CONE, neck, end, _HEAD), color)]
    return solids


def _rgb(color: str | Sequence[float]) -> Rgb:
    """Red, green and blue, 0 to 255, of a colour "#rrggbb", or of one of shares."""
    if isinstance(color, str):
        return ImageColor.getrgb(color)[:3]
    red, green, blue = (round(255 * share) for share in color[:3])
    return red, green, blue
