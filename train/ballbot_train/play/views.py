"""What there is to see of a playground."""

import math
from pathlib import Path

import numpy as np

from ballbot_gym import dynamics
from ballbot_gym.drawing import GHOST_OPACITY, Drawing, GroundPath, Robot
from ballbot_train.play.runner import Runner, failure_word
from ballbot_train.play.simulation import Playground
from ballbot_train.report import labels

_PLAN_POINTS = 60  # of a drawn plan


def drawing(playground: Playground) -> Drawing:
    """The present moment."""
    main, push = playground.main, playground.shown_push
    robots, paths = [], []
    for i, runner in reversed(list(enumerate(playground.runners))):
        name, tint = f"ghost {i}" if i else "robot", _color(runner, i)
        force = np.array(runner.force) if runner is main and not main.violated else None
        alpha = GHOST_OPACITY if i else 1.0
        x, pushed = np.array(runner.x), push if runner is main else None
        said = failure_word(runner.violated) or f"{math.degrees(dynamics.tilt(runner.x)):.0f}°"
        robots.append(Robot(x, tint, force, alpha, name, pushed, f"{labels.label(runner.name)} {said}"))
        if len(runner.trace) > 1:
            paths.append(GroundPath(np.array(runner.trace), tint, name=name))
    if (planned := _plan(playground)) is not None:
        paths.append(GroundPath(planned, _color(main, 0), dashed=True, name="plan"))
    markers = tuple(playground.world.task.markers(playground.start[1]))
    return Drawing(playground.world.params, tuple(robots), tuple(paths), markers)


def _color(runner: Runner, i: int) -> str:
    """The colour of the `i`-th robot."""
    return labels.color(Path(runner.name).stem, i)


def status(playground: Playground) -> str:
    """What goes on, in a line."""
    if playground.preparing:
        waiting = [labels.label(runner.wanted) for runner in playground.runners if runner.controller is None]
        return f"preparing {', '.join(waiting)} … the first time in a task, solvers are compiled"
    if playground.ended and playground.scores:
        return playground.scores[-1].text
    of = f"{playground.seconds:.1f} s of {playground.world.task.duration:g} s"
    return f"{labels.label(playground.main.name)}, {of}"


def _plan(playground: Playground) -> np.ndarray | None:
    """(n, 2) where the main robot's controller plans to go, m; None if it does not plan."""
    main = playground.main
    if main.violated or playground.ended:
        return None
    if hasattr(main.controller, "predicted"):
        predicted = getattr(main.controller, "predicted")  # noqa: B009
        return None if predicted is None else predicted[:, :2]
    rest = main.rest_of_plan(playground.steps)
    return None if rest is None or len(rest) < 2 else rest[:: max(1, len(rest) // _PLAN_POINTS), :2]
