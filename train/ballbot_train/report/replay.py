"""Episodes to look at: the same one under several controllers, as a strip of pictures or as a film."""

import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import imageio.v2 as imageio
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ballbot_baselines import CONTROLLERS
from ballbot_gym import certified, dynamics, files
from ballbot_gym.env import BallbotEnv
from ballbot_gym.params import BallbotParams, default_params
from ballbot_gym.rollout import Controller, PlanError, rollout
from ballbot_gym.tasks.marker import Marker
from ballbot_gym.trajectory import Trajectory
from ballbot_train.evaluation.controllers import make_controller
from ballbot_train.report import figures
from ballbot_train.report.perspective import GroundPath, Robot, Sketch

Format = Literal["png", "mp4", "gif"]

_GHOST = "#3d4b66"
_FILE_DT = 0.02  # s, at which what runs smoothly between its times is drawn


@dataclass(frozen=True)
class Take:
    """One trajectory to watch.

    `note` says how it ended. `ghost` is what an expert would have done from `ghost_start`, s: its own times begin at 0.
    """

    label: str
    trajectory: Trajectory
    color: str
    note: str = ""
    ghost: Trajectory | None = None
    ghost_start: float = 0.0

    @property
    def end(self) -> float:
        """When both it and its ghost have ended, s."""
        ghost_end = self.ghost_start + self.ghost.duration if self.ghost is not None else 0.0
        return max(self.trajectory.duration, ghost_end)

    def ghost_state(self, t: float) -> np.ndarray | None:
        """(8,) at time t of the take, s; None where there is no ghost."""
        if self.ghost is None or t < self.ghost_start:
            return None
        return self.ghost.state(t - self.ghost_start)


@dataclass(frozen=True)
class Replay:
    """Takes of the same episode, and what else stands on the floor."""

    title: str
    takes: tuple[Take, ...]
    markers: tuple[Marker, ...] = ()
    params: BallbotParams = field(default_factory=default_params)

    @property
    def duration(self) -> float:
        """Of the longest take or ghost, s."""
        return max(take.end for take in self.takes)


def certified_replay(
    task: str, controllers: Sequence[str], episode: int, physics: str = "bullet", skip_planless: bool = False
) -> Replay:
    """A certified episode under controllers by name.

    Args:
        task: name of a task.
        controllers: as for `make_controller`.
        episode: index of the episode.
        physics: "bullet" or "rk4".
        skip_planless: leave out controllers that find no plan.

    Raises:
        ValueError: an unknown task, controller or episode.
        PlanError: a controller finds no plan, unless `skip_planless`.
    """
    env = BallbotEnv(task, physics=physics)
    try:
        episode_set = certified.load(env.task)
        if not 0 <= episode < len(episode_set):
            raise ValueError(f"episode must be 0 to {len(episode_set) - 1}, not {episode}")
        takes = []
        for i, name in enumerate(controllers):
            controller = make_controller(name, env.task, env.params)
            try:
                takes.append(_take(env, controller, name, i, episode_set, episode))
            except PlanError:
                if not skip_planless:
                    raise
        markers = tuple(env.task.markers(episode_set.constants[episode]))
        return Replay(f"{task}, certified episode {episode}", tuple(takes), markers, env.params)
    finally:
        env.close()


def _take(
    env: BallbotEnv,
    controller: Controller,
    name: str,
    i: int,
    episode_set: certified.EvaluationSet,
    episode: int,
) -> Take:
    run = rollout(env, controller, options=episode_set.options(episode))
    if run.failure:
        note = f"fails at {run.trajectory.duration:.2f} s"
    else:
        note = f"regret {round(100 * (run.cost / episode_set.costs[episode] - 1), 1) + 0:.1f} %"  # + 0: no −0.0
    return Take(figures.label(name), run.trajectory, figures.color(Path(name).stem, i), note)


def with_ghosts(replay: Replay, task: str, episode: int, at: float, expert: str, physics: str) -> Replay:
    """Adds to every take of a certified episode what an expert would have done from time `at`, s.

    The expert gets a whole episode's time from there, and the same physics.

    Raises:
        ValueError: a take has ended by then, or its state is beyond what the task allows.
        PlanError: the expert finds no way to go on from any take; where it finds one from some, the others' notes say so.
    """
    env = BallbotEnv(task, physics=physics)
    try:
        c = certified.load(env.task).constants[episode]
        controller = CONTROLLERS[expert](env.task, env.params)
        takes = []
        for take in replay.takes:
            if not 0 <= at < take.trajectory.duration:
                raise ValueError(
                    f"{take.label} ends at {take.trajectory.duration:.2f} s: no ghost can start at {at:g} s"
                )
            start = round(at / env.task.control_dt) * env.task.control_dt
            options = {"state": take.trajectory.state(start), "constants": c}
            try:
                run = rollout(env, controller, options=options)
            except PlanError:
                takes.append(replace(take, note=f"{take.note}; {expert} finds no way on from {start:.2f} s"))
                continue
            end = "fails" if run.failure else "at the goal" if run.success else "goes on"
            note = f"{take.note}; ghost from {start:.2f} s: {end}"
            takes.append(replace(take, ghost=run.trajectory, ghost_start=start, note=note))
        if all(take.ghost is None for take in takes):
            raise PlanError(f"{expert} finds no way on from {at:g} s under {', '.join(take.label for take in takes)}")
        return replace(replay, takes=tuple(takes))
    finally:
        env.close()


def file_replay(paths: Sequence[Path]) -> Replay:
    """Trajectory files side by side.

    Raises:
        TrajectoryError: a file is missing or holds no trajectory.
    """
    takes = []
    for i, path in enumerate(paths):
        trajectory = Trajectory.load(path)
        if not len(trajectory.u):
            raise ValueError(f"{path} holds a single state: nothing moves")
        if trajectory.xdot is not None or not trajectory.held:
            trajectory = trajectory.resampled(_FILE_DT)
        shifted = replace(trajectory, t=trajectory.t - trajectory.t[0])
        takes.append(Take(_label(path, paths), shifted, figures.color(path.stem, i)))
    return Replay(", ".join(take.label for take in takes), tuple(takes))


def _label(path: Path, paths: Sequence[Path]) -> str:
    """The file's name, with its folder where others are called the same."""
    unique = sum(other.stem == path.stem for other in paths) == 1
    return path.stem if unique else f"{path.parent.name}/{path.stem}"


def write_strip(replay: Replay, path: Path, frames: int, seconds: float) -> Path:
    """A PNG of frames at equal times until `seconds`: a row for each take."""
    rows = len(replay.takes)
    figure = Figure(figsize=(2.6 * frames, 2.25 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, frames, squeeze=False)
    for row, take in zip(axes, replay.takes, strict=True):
        for axis, t in zip(row, np.linspace(0, seconds, frames), strict=True):
            _show(Sketch(axis, replay.params, replay.markers, aspect=4 / 3), take, t)
            axis.set_aspect("equal")
            held = min(t, take.end)
            axis.set_title(f"{held:.2f} s, {_tilt(take.trajectory.state(held)):.0f}°", fontsize=9)
        if rows > 1 or take.ghost is not None:
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
    """An MP4 or GIF, by the path's ending, of the takes side by side over their tilts, forces and ground paths.

    Args:
        replay: what to show.
        path: of the file, which appears when it is complete.
        seconds: until which time of the episode.
        fps: frames per second.
        speed: episode seconds per second of film.
        width: px; the height is 9/16 of it.
        on_frame: called after each frame.

    Raises:
        OSError: the file cannot be written, or there is no ffmpeg.
    """
    options: dict[str, object] = {"mode": "I", "loop": 0, "duration": 1000 / fps}
    if path.suffix == ".mp4":
        options = {"fps": fps, "codec": "libx264", "quality": 8, "macro_block_size": 2, "ffmpeg_log_level": "error"}
    with tempfile.TemporaryDirectory() as folder:
        unfinished = Path(folder) / path.name
        try:
            with imageio.get_writer(unfinished, **options) as writer:
                for picture in film_frames(replay, film_times(seconds, fps, speed), width):
                    writer.append_data(picture)
                    on_frame()
        except RuntimeError as error:  # of imageio-ffmpeg, where its wheel brought no ffmpeg
            raise OSError(f"{path}: cannot encode: {error}") from error
        return files.write(path, unfinished.read_bytes())


def film_times(seconds: float, fps: int, speed: float) -> np.ndarray:
    """Times of the episode, s, of a film's frames."""
    return np.minimum(np.arange(math.ceil(seconds * fps / speed) + 1) * speed / fps, seconds)


def film_frames(replay: Replay, times: Sequence[float] | np.ndarray, width: int = 1280) -> Iterator[np.ndarray]:
    """Frames (h, width, 3), uint8, at times of the episode, s."""
    film = _Film(replay, float(np.max(times)), width)
    for t in times:
        yield film.frame(float(t))


class _Film:
    """A figure whose fixed parts are drawn once, and whose moving parts are drawn over them for every frame."""

    def __init__(self, replay: Replay, seconds: float, width: int):
        self._replay = replay
        self._figure = Figure(figsize=(12.8, 7.2), dpi=width / 12.8)
        self._canvas = FigureCanvasAgg(self._figure)
        self._figure.text(0.01, 0.975, replay.title, fontsize=12, va="center")
        self._clock = self._figure.text(0.99, 0.975, "", fontsize=12, va="center", ha="right", family="monospace")
        self._moving: list = [self._clock]
        self._add_stages()
        self._add_traces(seconds)
        for artist in self._moving:
            artist.set_animated(True)
        self._canvas.draw()
        self._fixed = self._canvas.copy_from_bbox(self._figure.bbox)

    def frame(self, t: float) -> np.ndarray:
        self._clock.set_text(f"{t:5.2f} s")
        for take, sketch, readout in zip(self._replay.takes, self._stages, self._readouts, strict=True):
            _show(sketch, take, t)
            readout.set_text(f"{_tilt(take.trajectory.state(t)):.0f}°")
        for cursor in self._cursors:
            cursor.set_xdata([t, t])
        for take, dot in zip(self._replay.takes, self._dots, strict=True):
            dot.set_data(*take.trajectory.state(t)[:2, None])
        self._canvas.restore_region(self._fixed)
        for artist in self._moving:
            artist.axes.draw_artist(artist) if artist.axes else self._figure.draw_artist(artist)
        picture = np.asarray(self._canvas.buffer_rgba())[:, :, :3]
        return picture[: len(picture) // 2 * 2, : picture.shape[1] // 2 * 2].copy()  # H.264 wants even sizes

    def _add_stages(self) -> None:
        count = len(self._replay.takes)
        columns = min(count, 4)
        rows = math.ceil(count / columns)
        width, height = (0.99 - 0.005) / columns, 0.62 / rows
        self._stages, self._readouts = [], []
        for i, take in enumerate(self._replay.takes):
            left, bottom = 0.005 + i % columns * width, 0.95 - (i // columns + 1) * height
            axis = self._figure.add_axes((left + 0.003, bottom, width - 0.006, height - 0.055))
            aspect = (width - 0.006) * 16 / ((height - 0.055) * 9)
            sketch = Sketch(axis, self._replay.params, self._replay.markers, aspect)
            axis.set_title(take.label, fontsize=11, color=take.color, loc="left", pad=4)
            note = take.note.replace("; ", "\n")
            axis.text(0.98, 0.97, note, transform=axis.transAxes, fontsize=9, ha="right", va="top", color="0.35")
            readout = axis.text(0.03, 0.96, "", transform=axis.transAxes, fontsize=16, va="top", color=take.color)
            self._stages.append(sketch)
            self._readouts.append(readout)
            self._moving += [*sketch.artists, readout]

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
            if take.ghost is not None:
                ghost = {"color": take.color, "lw": 1.2, "ls": "--", "alpha": 0.7}
                later = take.ghost_start + take.ghost.t
                tilt.plot(later, np.degrees(take.ghost.tilt), **ghost)
                force.plot(later[:-1], np.hypot(*take.ghost.u.T), drawstyle="steps-post", **ghost)
                path.plot(*take.ghost.x[:, :2].T, **ghost)
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


def _show(sketch: Sketch, take: Take, t: float) -> None:
    """Draws a take at time t, s; after its end it stands still. The camera keeps the ghost in view."""
    x, ghost = take.trajectory.state(t), take.ghost_state(t)
    u = take.trajectory.force(t) if t < take.trajectory.duration else None
    robots, paths = [Robot(x, take.color, u)], [GroundPath(_way(take.trajectory, t), take.color)]
    middle, apart = x[:2], 0.0
    if ghost is not None:
        robots.insert(0, Robot(ghost, _GHOST, alpha=0.4))
        paths.append(GroundPath(_way(take.ghost, t - take.ghost_start), _GHOST, dashed=True))
        middle, apart = (x[:2] + ghost[:2]) / 2, float(np.hypot(*(x - ghost)[:2]))
    sketch.show(middle, robots, paths, zoom_out=apart)


def _way(trajectory: Trajectory, t: float) -> np.ndarray:
    """(n, 2) ground path until time t, m."""
    return np.concatenate([trajectory.x[trajectory.t < t, :2], trajectory.state(t)[None, :2]])


def _drawstyle(trajectory: Trajectory) -> str:
    """Of its forces over time."""
    return "steps-post" if trajectory.held else "default"


def _tilt(x: np.ndarray) -> float:
    """In degrees."""
    return math.degrees(dynamics.tilt(x))
