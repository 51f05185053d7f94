"""Replays as a strip of pictures or as a film."""

import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import imageio.v2 as imageio
import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ballbot_gym import files
from ballbot_gym.drawing.picture import picture
from ballbot_train.report.replay import LEAST_SLIP, Replay

Format = Literal["png", "mp4", "webp"]

_FAILED = "#c01818"
_FONT = Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"
_COLUMNS = 4
_STRIP_SIZE = (520, 390)  # pixels of a moment of a take in a strip
_PAUSE = 1.5  # s, for which a film that loops shows its last picture


def write_strip(replay: Replay, path: Path, frames: int, seconds: float) -> Path:
    """Writes a PNG with a row for each take: its pictures at `frames` equal times until `seconds`."""
    width, height = _STRIP_SIZE
    times = np.linspace(0, seconds, frames).tolist()
    strip = np.hstack([_frame(replay, t, width, len(replay.takes) * height, height // 20, 1) for t in times])
    return files.write(path, imageio.imwrite("<bytes>", strip, "png"))


def write_film(frames: Iterable[np.ndarray], path: Path, fps: int = 25) -> Path:
    """Writes a film.

    Args:
        frames: what `film_frames` yields.
        path: path of the file. Its ending selects the format: .mp4 or .webp. The file appears when it is complete.
            WebP repeats forever, and pauses at the end.
        fps: frames per second.

    Raises:
        OSError: the file cannot be written.
        RuntimeError: there is no ffmpeg.
    """
    options: dict[str, Any]
    content: Any  # bytes
    if path.suffix == ".webp":
        shown: list[Any] = list(frames)
        durations = [round(1000 / fps)] * len(shown)
        durations[-1] += round(1000 * _PAUSE)
        options = {"duration": durations, "loop": 0, "quality": 75, "method": 4}
        content = imageio.mimwrite("<bytes>", shown, "webp", **options)
    else:
        options = {"fps": fps, "codec": "libx264", "quality": 8, "macro_block_size": 2, "ffmpeg_log_level": "error"}
        with TemporaryDirectory() as folder:  # imageio would leave a file of its own if it is interrupted
            unfinished = Path(folder) / "film.mp4"
            with imageio.get_writer(unfinished, **options) as writer:
                for frame in frames:
                    writer.append_data(frame)  # pyright: ignore[reportAttributeAccessIssue]
            content = unfinished.read_bytes()
    return files.write(path, content)


def film_frames(replay: Replay, times: Sequence[float] | np.ndarray, width: int = 1280) -> Iterator[np.ndarray]:
    """Yields frames (h, width, 3), uint8, at times of the episode, s: the takes side by side, at most four in a row."""
    width, height = width // 2 * 2, width * 9 // 32 * 2  # H.264 wants even sizes
    for t in map(float, times):
        yield _frame(replay, t, width, height, max(height // 32, 9), min(len(replay.takes), _COLUMNS))


def _frame(replay: Replay, t: float, width: int, height: int, line: int, columns: int) -> np.ndarray:
    """(height, width, 3) the takes at time t, s, in `columns` columns, with text of the height `line`, px."""
    font, large = (ImageFont.truetype(_FONT, size) for size in (line, 3 * line // 2))
    wide, high = width // columns, (height - 2 * line) // math.ceil(len(replay.takes) / columns)
    letters = max(5, round(1.5 * wide / line))  # that fit into a line
    frame = Image.new("RGB", (width, height), "white")
    pen = ImageDraw.Draw(frame)
    pen.text((line // 2, line // 2), replay.title, "black", font)
    pen.text((width - line // 2, line // 2), f"{t:.2f} s", "black", font, "ra")
    for i, take in enumerate(replay.takes):
        left, top = i % columns * wide + 2, i // columns * high + 2 * line
        right, bottom = left + wide - 4, top + high - 4
        shown = picture(replay.drawing(take, t), max(right - left, 1), max(bottom - top, 1))
        frame.paste(Image.fromarray(shown), (left, top))
        label, slip = textwrap.fill(take.label, letters), take.slip_at(t)
        measured = replay.params.measurements(take.trajectory.state(t))
        lean = replay.params.named_measurements(measured).get("tilt")
        tilt = ("" if lean is None else f"{math.degrees(lean):.0f}°") + f"\nslips, {slip:.1f} m/s" * (slip > LEAST_SLIP)
        pen.text((left + 3, top + 2), label, take.color, font)
        pen.text((left + 3, top + 3 * line // 2 * (1 + label.count("\n"))), tilt, take.color, large)
        if t >= take.trajectory.duration or not take.failed:
            note = "\n".join(textwrap.fill(part, letters) for part in take.note.split("; "))
            pen.text((right - 4, bottom - 4), note, _FAILED if take.failed else "#333333", font, "rd", align="right")
    return np.asarray(frame)
