"""Replays as a strip of pictures or as a film, with plots by matplotlib."""

import io
import math
import tempfile
import textwrap
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import imageio.v2 as imageio
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from ballbot_gym import dynamics, files
from ballbot_gym.drawing import Drawing
from ballbot_gym.picture import picture
from ballbot_gym.trajectory import Trajectory
from ballbot_train.report import figures
from ballbot_train.report.replay import LEAST_SLIP, Replay

Format = Literal["png", "mp4", "gif", "webp"]

_FAILED = "#c01818"
_GIF_COLORS = 128
_INCHES = (
    9.0,
    12.8,
)  # of a film's figure: the narrowest and the widest, between which text has the same size in pixels
_NOTE = 10  # points, of what is said in a take's corner
_STRIP_SIZE = (520, 390)  # pixels of a strip's picture
_FALLEN = 45.0  # deg: at a smaller tilt a failure is the touch of an obstacle, or a lost grip
_PAUSE = 1.5  # s, for which a film that loops shows its last picture


def write_strip(replay: Replay, path: Path, frames: int, seconds: float) -> Path:
    """Writes a PNG with a row for each take: its pictures at `frames` equal times until `seconds`."""
    rows = len(replay.takes)
    figure = Figure(figsize=(2.6 * frames, 2.25 * rows), layout="constrained")
    axes = figure.subplots(rows, frames, squeeze=False)
    for row, take in zip(axes, replay.takes, strict=True):
        for axis, t in zip(row, np.linspace(0, seconds, frames), strict=True):
            _View(axis, *_STRIP_SIZE).draw(replay.drawing(take, t))
            axis.set_aspect("equal")
            held = min(t, take.trajectory.duration)
            axis.set_title(f"{held:.2f} s, {_tilt(take.trajectory.state(held)):.0f}°", fontsize=9)
        if rows > 1:
            row[0].set_ylabel(f"{take.label}\n{take.note}".strip().replace("; ", "\n"), fontsize=8, color=take.color)
    return figures.save(figure, path)


def write_film(
    replay: Replay,
    path: Path,
    seconds: float,
    fps: int = 25,
    speed: float = 1.0,
    width: int = 1280,
    on_frame: Callable[[], None] = lambda: None,
) -> Path:
    """Writes a film of the takes side by side, above their tilts, forces and ground paths.

    Args:
        replay: the takes.
        path: path of the file. Its ending selects the format: .mp4, .gif or .webp. The file appears when it is complete.
            GIF and WebP repeat forever, and pause at the end.
        seconds: time of the episode at which the film ends.
        fps: frames per second.
        speed: seconds of the episode per second of film.
        width: width, px; the height is 9/16 of it.
        on_frame: called after each frame.

    Raises:
        OSError: the file cannot be written, or there is no ffmpeg.
    """
    pictures = _reported(film_frames(replay, film_times(seconds, fps, speed), width), on_frame)
    content = _mp4(pictures, fps, path) if path.suffix == ".mp4" else _animation(pictures, fps, path.suffix)
    return files.write(path, content)


def _reported(pictures: Iterator[np.ndarray], on_frame: Callable[[], None]) -> Iterator[np.ndarray]:
    for frame in pictures:
        yield frame
        on_frame()


def _mp4(pictures: Iterator[np.ndarray], fps: int, path: Path) -> bytes:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:  # interrupted, ffmpeg may still write
        unfinished = Path(folder) / path.name
        options = {"fps": fps, "codec": "libx264", "quality": 8, "macro_block_size": 2, "ffmpeg_log_level": "error"}
        try:
            with imageio.get_writer(unfinished, **options) as writer:
                for frame in pictures:
                    writer.append_data(frame)  # pyright: ignore[reportAttributeAccessIssue]
        except RuntimeError as error:  # imageio-ffmpeg raises it if its wheel brought no ffmpeg
            raise OSError(f"{path}: cannot encode: {error}") from error
        return unfinished.read_bytes()


def _animation(pictures: Iterator[np.ndarray], fps: int, ending: str) -> bytes:
    """A GIF or a WebP that repeats forever."""
    images = [Image.fromarray(frame) for frame in pictures]
    frame_ms = round(1000 / fps)
    durations = [frame_ms] * (len(images) - 1) + [frame_ms + round(1000 * _PAUSE)]
    if ending == ".gif":
        # One palette without dithering: pixels that do not move stay equal from frame to frame, which keeps the file small.
        palette = images[-1].quantize(_GIF_COLORS)
        images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
        options: dict[str, Any] = {"format": "GIF", "optimize": True}
    else:
        options = {"format": "WEBP", "quality": 75, "method": 4}
    buffer = io.BytesIO()
    images[0].save(buffer, save_all=True, append_images=images[1:], duration=durations, loop=0, **options)
    return buffer.getvalue()


def film_times(seconds: float, fps: int, speed: float) -> np.ndarray:
    """The times of the episode at which a film's frames are drawn, s."""
    return np.minimum(np.arange(math.ceil(seconds * fps / speed) + 1) * speed / fps, seconds)


def film_frames(replay: Replay, times: Sequence[float] | np.ndarray, width: int = 1280) -> Iterator[np.ndarray]:
    """Yields frames (h, width, 3), uint8, at times of the episode, s."""
    film = _Film(replay, float(np.max(times)), width)
    for t in times:
        yield film.frame(float(t))


class _View:
    """A picture of a drawing that fills an axes."""

    def __init__(self, axis: Axes, width: int, height: int):
        """Args: width and height in pixels."""
        self._size = width, height
        axis.set_xticks([])
        axis.set_yticks([])
        for spine in axis.spines.values():
            spine.set_color("0.85")
        blank = np.full((height, width, 3), 255, np.uint8)
        self.image = axis.imshow(blank, aspect="auto", interpolation="antialiased")

    def draw(self, drawing: Drawing) -> None:
        """Shows a moment in place of the one before."""
        self.image.set_data(picture(drawing, *self._size))


class _Stage(NamedTuple):
    """The changing parts of one take: the robot, its tilt, how the take ends, and a word that appears when it fails."""

    view: _View
    tilt: Text
    note: Text
    end: Text


class _Film:
    """A figure whose fixed parts are drawn once, and whose moving parts are drawn over them for every frame."""

    def __init__(self, replay: Replay, seconds: float, width: int):
        self._replay = replay
        inches = min(max(width / 100, _INCHES[0]), _INCHES[1])
        self._figure = Figure(figsize=(inches, inches * 9 / 16), dpi=width / inches)
        self._canvas = FigureCanvasAgg(self._figure)
        self._figure.text(0.01, 0.975, replay.title, fontsize=12, va="center")
        self._clock = self._figure.text(0.99, 0.975, "", fontsize=12, va="center", ha="right", family="monospace")
        self._moving: list[Artist] = [self._clock]
        self._add_stages()
        self._add_traces(seconds)
        for artist in self._moving:
            artist.set_animated(True)
        figures.plain(self._figure)
        self._canvas.draw()
        self._fixed = self._canvas.copy_from_bbox(self._figure.bbox)

    def frame(self, t: float) -> np.ndarray:
        self._clock.set_text(f"{t:5.2f} s")
        for take, stage in zip(self._replay.takes, self._stages, strict=True):
            stage.view.draw(self._replay.drawing(take, t))
            slip = take.slip_at(t)
            slips = f"\nslips, {slip:.1f} m/s" if slip > LEAST_SLIP else ""
            stage.tilt.set_text(f"{_tilt(take.trajectory.state(t)):.0f}°{slips}")
            ended = t >= take.trajectory.duration
            stage.end.set_visible(take.failed and ended)
            stage.note.set_visible(ended or not take.failed)
        for cursor in self._cursors:
            cursor.set_xdata([t, t])
        for take, dot in zip(self._replay.takes, self._dots, strict=True):
            dot.set_data(*take.trajectory.state(t)[:2, None])
        self._canvas.restore_region(self._fixed)
        for artist in self._moving:
            self._figure.draw_artist(artist)
        pixels = np.asarray(self._canvas.buffer_rgba())[:, :, :3]
        return pixels[: len(pixels) // 2 * 2, : pixels.shape[1] // 2 * 2].copy()  # H.264 wants even sizes

    def _add_stages(self) -> None:
        count = len(self._replay.takes)
        columns = min(count, 4)
        rows = math.ceil(count / columns)
        width, height = (0.99 - 0.005) / columns, 0.62 / rows
        letter = 0.6 * _NOTE * self._figure.dpi / 72  # its width in pixels: wide ones are wider, spaces narrower
        self._stages: list[_Stage] = []
        for i, take in enumerate(self._replay.takes):
            left, bottom = 0.005 + i % columns * width, 0.95 - (i // columns + 1) * height
            axis = self._figure.add_axes((left + 0.003, bottom, width - 0.006, height - 0.055))
            box = axis.get_window_extent()
            view = _View(axis, round(box.width), round(box.height))
            axis.set_title(take.label, fontsize=11, color=take.color, loc="left", pad=4)
            corner = {"transform": axis.transAxes, "va": "top"}
            tilt = axis.text(0.03, 0.97, "", fontsize=16, color=take.color, **corner)
            end = axis.text(0.97, 0.97, "", fontsize=16, color=_FAILED, ha="right", weight="bold", **corner)
            if take.failed:
                end.set_text("fell" if _tilt(take.trajectory.x[-1]) > _FALLEN else "failed")
            note = axis.text(
                0.97,
                0.03,
                "\n".join(textwrap.fill(part, round(box.width / letter)) for part in take.note.split("; ")),
                fontsize=_NOTE,
                color="0.2",
                ha="right",
                transform=axis.transAxes,
            )
            self._stages.append(_Stage(view, tilt, note, end))
            self._moving += [view.image, tilt, note, end]

    def _add_traces(self, seconds: float) -> None:
        tilt, force, path = (
            self._figure.add_axes((left, 0.075, width, 0.21))
            for left, width in ((0.05, 0.3), (0.41, 0.3), (0.76, 0.23))
        )
        for take in self._replay.takes:
            t, u = take.trajectory.t, take.trajectory.u
            tilt.plot(t, np.degrees(take.trajectory.tilt), color=take.color, lw=1.6)
            force.plot(t[: len(u)], np.hypot(*u.T), color=take.color, lw=1.2, drawstyle=_drawstyle(take.trajectory))
            path.plot(*take.trajectory.x[:, :2].T, color=take.color, lw=1.6)
        tilt.set(xlim=(0, seconds), xlabel="time, s", title="tilt, deg")
        force.set(xlim=(0, seconds), xlabel="time, s", title="force, N")
        path.set(title="ground path, m")
        path.set_aspect("equal", adjustable="datalim")
        figures.add_circles(path, figures.marker_circles(self._replay.markers))
        for axis in (tilt, force, path):
            axis.grid(alpha=0.3)
            axis.tick_params(labelsize=8)
            axis.title.set_fontsize(9)
            axis.xaxis.label.set_fontsize(8)
        self._cursors = [axis.axvline(0, color="0.2", lw=1) for axis in (tilt, force)]
        self._dots = [path.plot([], [], "o", color=take.color, ms=6)[0] for take in self._replay.takes]
        self._moving += [*self._cursors, *self._dots]


def _drawstyle(trajectory: Trajectory) -> str:
    """The matplotlib style of forces over time."""
    return "steps-post" if trajectory.held else "default"


def _tilt(x: np.ndarray) -> float:
    """In degrees."""
    return math.degrees(dynamics.tilt(x))
