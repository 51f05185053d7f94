"""`ballbot optimize`: the optimum of one episode."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_baselines import PlanarBound, find_optimum
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robot import PAPER
from ballbot_gym.tasks import TASKS
from ballbot_train.report import figures, labels
from ballbot_train.work.console import RobotName, check_least, check_names, console, print_table

_MOST_STEPS = 5000  # control steps of an episode; longer ones take hours and gigabytes


def optimize(
    task: str,
    /,
    state: tuple[float, float, float, float, float, float, float, float] | None = None,
    constants: dict[str, float] = {},  # noqa: B006 (tyro's default; never changed)
    seed: int = 0,
    duration: float | None = None,
    out: Path = Path("runs/optimize"),
    robot: RobotName = PAPER,
) -> None:
    """Finds the optimum of one episode, and writes its trajectory and figure.

    Args:
        task: name of a task.
        state: x y γ θ ẋ ẏ γ̇ θ̇ at the start, in m, rad, m/s, rad/s; default drawn with the seed. Robots with wheels then
            have a yaw of 0 and no spin.
        constants: constants of the episode by name, e.g. --constants speed 3; others are drawn with the seed.
        seed: seed of what is drawn.
        duration: longest episode, s.
        out: folder of trajectory.npz and figure.png.
        robot: name of the robot.
    """
    check_names("task", [task], TASKS)
    check_least(0, seed=seed)
    problem = make_task(task, robot, **({} if duration is None else {"duration": duration}))
    if problem.steps > _MOST_STEPS:
        raise ValueError(
            f"duration {duration:g} s is too long to optimize; give at most {_MOST_STEPS * problem.control_dt:g} s"
        )
    env = BallbotEnv(problem, physics="rk4", robot=robot)
    options: dict[str, Any] = {"constants": constants}
    if state is not None:
        options["state"] = (*state, *[0.0] * (env.params.state_size - len(state)))
    _, info = env.reset(seed=seed, options=options)
    optimum = find_optimum(env.task, env.params, info["state"], info["constants"], twice=True)
    trajectory = optimum.trajectory
    path = trajectory.save(out / "trajectory.npz")
    take = figures.Take("optimum", trajectory, labels.color("trajopt"))
    figure = figures.trajectory_figure(env.task.id, [take], env.task.markers(info["constants"]), env.params)
    picture = figures.save(figure, out / "figure.png")
    rows = [
        ["cost", f"{optimum.cost:.6f}"],
        ["duration, s", f"{trajectory.duration:.2f}"],
        ["peak tilt, deg", f"{math.degrees(trajectory.tilt.max()):.2f}"],
        ["peak force, N", f"{np.abs(trajectory.u).max():.1f}"],
        ["status", f"{optimum.status}; {optimum.solver}: {optimum.solver_status}, {optimum.iterations} iterations"],
        ["constraint violation", f"{optimum.violation:.1e}"],
        ["search, s", f"{optimum.seconds:.3f}"],
    ]
    print_table(env.task.id, ["", ""], rows)
    least = PlanarBound.stored().of_episode(env.task, env.params, info["state"])
    if not math.isnan(least):
        console.print(
            f"No successful motion in the vertical plane of this start costs less than {least:.6f}, so its regret is at most "
            f"{optimum.cost / least - 1:.1%}. `ballbot prove --planar` proves it.",
            soft_wrap=True,
        )
    console.print(f"trajectory: {path}\nfigure: {picture}")
