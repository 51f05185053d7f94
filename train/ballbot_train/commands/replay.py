"""`ballbot replay`: pictures and films of an episode or of trajectory files."""

import math
from pathlib import Path

import numpy as np

from ballbot_gym.engines import default_physics
from ballbot_gym.registry import own_robot
from ballbot_gym.robot import PAPER, file_name
from ballbot_gym.tasks import TASKS
from ballbot_train.commands.options import Filter
from ballbot_train.evaluation.controllers import ControllerName
from ballbot_train.evaluation.names import file_part
from ballbot_train.report.film import Format, film_frames, write_film, write_strip
from ballbot_train.report.replay import Replay, certified_replay
from ballbot_train.work.console import Physics, RobotName, check_names, console, physics_or_default, progress_bar

_MOST_FRAMES = 100_000
_WIDTHS = {"mp4": 1280, "webp": 640}  # px


def replay(
    source: tuple[str, ...],
    /,
    controllers: tuple[str, ...] = ("trajopt",),
    episode: int = 0,
    physics: Physics | None = None,
    format: Format = "png",
    seconds: float | None = None,
    frames: int = 5,
    fps: int = 25,
    speed: float = 1.0,
    width: int | None = None,
    out: Path = Path("runs/replay"),
    robot: RobotName = PAPER,
    frictions: tuple[float, ...] = (),
    filter: Filter | None = None,
) -> None:
    """Draws a certified episode under one or several controllers, or trajectory files, as a strip of pictures or a film.

    Args:
        source: name of a task, or trajectory files (.npz).
        controllers: names of controllers or policy files; several are shown side by side.
        episode: index of the certified episode.
        physics: "bullet", "mujoco" or "rk4"; default, the first that is installed.
        format: png, a strip of pictures; mp4 or webp, a film.
        seconds: time of the last picture, s; default the end of the episode.
        frames: number of pictures in a strip, at equal times.
        fps: frames per second of a film.
        speed: seconds of the episode per second of film; 0.5 is slow motion.
        width: width of a film, px; default 1280 for mp4, 640 for webp.
        out: folder of the file. The file is named after task, controllers and episode.
        robot: name of the robot, with its episodes; default, the robot that the task names. Trajectory files are drawn with
            the paper's robot by default.
        frictions: coefficients of friction, for a robot whose ball rolls: every controller is shown on each of these floors.
            Where the ball slips, its path is red.
        filter: filter in front of every controller: it estimates the robot, the delay, or the state from sensors.
    """
    _check(1 <= fps <= 1000, f"fps must be 1 to 1000, not {fps}")
    _check(1 <= frames <= 100, f"frames must be 1 to 100, not {frames}")
    _check(0 < speed < math.inf, f"speed must be positive, not {speed}")
    _check(seconds is None or 0 < seconds < math.inf, f"seconds must be positive, not {seconds}")
    _check(width is None or 64 <= width <= 7680, f"width must be 64 to 7680 px, not {width}")
    if all(Path(entry).suffix == ".npz" for entry in source):
        _check(bool(source), "give the name of a task, or trajectory files")
        _check(not frictions, "trajectory files were recorded on one floor: give --frictions with a task")
        paths = [Path(entry) for entry in source]
        shown, name = Replay.of_files(paths), "+".join(file_part(str(path)) for path in paths)
    else:
        _check(len(source) == 1, f"give one task, or trajectory files ending in .npz, not {' '.join(source)}")
        check_names("task", source, TASKS)
        robot = own_robot(source[0], robot)
        physics = physics_or_default(physics, robot)
        _check(bool(controllers), "give at least one controller")
        controllers = tuple(ControllerName(name).behind(filter).text for name in controllers)
        shown = certified_replay(source[0], controllers, episode, physics, robot=robot, frictions=frictions)
        made = file_name(source[0], robot)
        # parts of names hold no plus, so that no other controllers or floors make the same name
        name = f"{made}-{'+'.join(file_part(controller) for controller in controllers)}-{episode}"
        name += "".join(f"+{friction}" for friction in frictions) + f"-{physics}" * (physics != default_physics())
    end = min(shown.duration if seconds is None else seconds, shown.duration)
    path = out / f"{name}.{format}"
    if format == "png":
        console.print(f"picture: {write_strip(shown, path, frames, end)}")
        return
    count = end * fps / speed
    _check(count <= _MOST_FRAMES, f"the film would have {count:.3g} frames; give another speed or fps")
    times = np.minimum(np.arange(math.ceil(count) + 1) * speed / fps, end)
    with progress_bar() as progress:
        drawn = film_frames(shown, times, width or _WIDTHS[format])
        write_film(progress.track(drawn, total=len(times), description="frames"), path, fps)
    console.print(f"film: {path}, {path.stat().st_size / 1e6:.1f} MB")


def _check(right: bool, message: str) -> None:
    if not right:
        raise ValueError(message)
