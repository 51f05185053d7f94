"""The forces of the floor along the paper's optima, friction and normal force, and the cost of a limit of friction."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure

from ballbot_gym import certified, files
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robot import TRACKS, Robot, default_params, named_robot
from ballbot_gym.rollout import PlanError, rollout
from ballbot_gym.tasks import TASKS
from ballbot_gym.trajectory import Trajectory

_SHOWN = 2.0  # greatest coefficient of friction in the figure
_SWEPT = (1.2, 1.0, 0.9, 0.8, 0.7, 0.6)
_STARTS = {  # task: the paper's start and constants
    "stabilize": (np.array([-1.0, 0, 0, 0, 0, 5.0, 0, 0]), np.zeros(0)),
    "turn": (np.array([0.0, -1.0, 0, 0, 0, 10.0, 0, 0]), np.array([10.0])),
}


def floor_force(params: Robot, trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Normal force (n,) as a fraction of the weight, and needed friction (n,), inf where the floor would have to pull."""
    fx, fy, normal = params.contact(trajectory.x[:-1], trajectory.u)
    needed = np.where(normal > 0, np.hypot(fx, fy) / np.where(normal > 0, normal, 1), math.inf)
    return normal / params.weight, needed


def demand(out: Path) -> None:
    """What the paper's stored optima ask of the floor."""
    params, rows = default_params(), []
    figure = Figure(figsize=(10, 6), layout="constrained")
    axes = figure.subplots(2, 2, sharey=True)
    for name, axis in zip(TASKS, axes.flat, strict=True):
        for i, trajectory in enumerate(certified.load(name, "paper").trajectories):
            load, needed = floor_force(params, trajectory)
            rows.append(
                {
                    "task": name,
                    "episode": i,
                    "least_normal_force": load.min(),
                    "greatest_friction": needed.max(),
                    "share_beyond_1": np.mean(needed > 1),
                }
            )
            axis.plot(trajectory.t[:-1], np.minimum(needed, _SHOWN * 1.05), color="C0", alpha=0.35, lw=1)
        axis.axhline(0.8, color="C3", lw=1, ls="--")
        axis.set(title=name, xlabel="time, s", ylim=(0, _SHOWN), xlim=(0, None))
    for axis in axes[:, 0]:
        axis.set_ylabel("friction needed")
    figure.suptitle("Friction that the optima of the paper's robot need; dashed: 0.8, the rolling robot's floor")
    path = out / "friction.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    files.write_csv(out / "demand.csv", rows)
    for name in TASKS:
        of = [row for row in rows if row["task"] == name]
        pulls = sum(row["least_normal_force"] < 0 for row in of)
        within = sum(row["greatest_friction"] <= 1 for row in of)
        print(f"{name}: {pulls} of {len(of)} optima need a floor that pulls; {within} stay within a friction of 1")


def sweep(out: Path) -> None:
    """Cost and lean of the rolling robot's optima against friction."""
    from ballbot_baselines import find_optimum

    rolling, rows = named_robot("rolling"), []
    free = dataclasses.replace(rolling, friction=math.inf)
    for name, (x, c) in _STARTS.items():
        task = make_task(name, "rolling")
        best = find_optimum(task, free, x, c)
        found = [(math.inf, best)]
        for friction in _SWEPT:
            try:
                found.append((friction, find_optimum(task, dataclasses.replace(rolling, friction=friction), x, c)))
            except PlanError:
                print(f"{name}: no way at a friction of {friction}")
        for friction, optimum in found:
            lean = math.degrees(optimum.trajectory.tilt.max())
            rows.append({"task": name, "friction": friction, "cost": optimum.cost, "lean": lean})
            print(f"{name}: friction {friction:g}: {optimum.cost / best.cost - 1:+.1%}, lean {lean:.1f}°", flush=True)
    files.write_csv(out / "sweep.csv", rows)
    figure = Figure(figsize=(10, 3.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name in _STARTS:
        of = [row for row in rows if row["task"] == name]
        bound = [row for row in of if math.isfinite(row["friction"])]
        left.plot(
            [row["friction"] for row in bound],
            [100 * (row["cost"] / of[0]["cost"] - 1) for row in bound],
            "o-",
            label=name,
        )
        right.plot([row["friction"] for row in bound], [row["lean"] for row in bound], "o-", label=name)
    left.set(xlabel="coefficient of friction", ylabel="cost over unlimited friction, %")
    right.set(xlabel="coefficient of friction", ylabel="greatest lean, degrees")
    left.legend()
    figure.savefig(out / "sweep.png", dpi=110)


class _Floor(BallbotEnv):
    """Keeps what the floor gives in each step, and how fast the ball slips after it."""

    def reset(self, **arguments: Any) -> tuple[np.ndarray, dict[str, Any]]:
        self.grips: list[np.ndarray] = []
        self.slips: list[float] = []
        return super().reset(**arguments)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        result = super().step(action)
        self.grips.append(result[-1]["grip"])
        self.slips.append(self.slip)
        return result


def contact(out: Path, episodes: int) -> None:
    """What the simulated floor gives the rolling robot under tracked plans."""
    from ballbot_baselines import TrajoptController

    robot, rows = named_robot("rolling"), []
    for name in TASKS:
        task, stored = make_task(name, "rolling"), certified.load(name, "rolling")
        env = _Floor(task, physics="bullet", robot="rolling")
        for i in range(episodes):
            run = rollout(env, TrajoptController(task, robot), options=stored.options(i))
            *_, normal, needed = np.array(env.grips).T
            rows.append(
                {
                    "task": name,
                    "episode": i,
                    "success": int(run.success),
                    "least_normal_force": normal.min() / robot.weight,
                    "greatest_friction": needed.max(),
                    "greatest_slip": max(env.slips),
                }
            )
        env.close()
        of = [row for row in rows if row["task"] == name]
        print(
            f"{name}: {sum(row['success'] for row in of)} of {episodes} succeed; the floor presses with at least "
            f"{min(row['least_normal_force'] for row in of):.0%} of the weight and gives a friction of at most "
            f"{max(row['greatest_friction'] for row in of):.2f}; the ball slips at most "
            f"{max(row['greatest_slip'] for row in of):.3f} m/s",
            flush=True,
        )
    files.write_csv(out / "contact.csv", rows)


def never_slip(out: Path, episodes: int) -> None:
    """What it costs to slip on no floor of "unknown": each robot's optimum on the slipperiest, over that on its own."""
    from ballbot_baselines import find_optimum

    nominal, track, rows = named_robot("rolling"), TRACKS["unknown"], []
    for name in TASKS:
        task, stored = make_task(name, nominal), certified.load(name, nominal, randomization=track)
        for i in range(episodes):
            drawn = [*stored.drawn[i]]
            drawn[track.DRAWN.index("friction")] = track.friction[0]
            slippery = track.robot(nominal, tuple(drawn))
            try:
                cost = find_optimum(task, slippery, stored.states[i], stored.constants[i]).cost
            except PlanError:
                cost = math.nan
            rows.append({"task": name, "episode": i, "costs_more": cost / stored.costs[i] - 1})
        more = np.array([row["costs_more"] for row in rows if row["task"] == name])
        found = more[np.isfinite(more)]
        print(
            f"{name}: {len(found)} of {episodes} can do without slipping anywhere, which costs {found.mean():.1%} more "
            f"(median {np.median(found):.1%}, worst {found.max():.0%})",
            flush=True,
        )
    files.write_csv(out / "never_slip.csv", rows)


def main(
    out: Path = Path("runs/friction"), costs: bool = False, contact_episodes: int = 0, unknown_episodes: int = 0
) -> None:
    """Measures what the stored optima of the paper's robot need, and writes demand.csv and friction.png.

    Args:
        out: folder of the results.
        contact_episodes: of each task's certified ones, in which the rolling robot tracks its plans in PyBullet's contact;
            contact.csv has the forces of the floor.
        costs: also find optima of the rolling robot at several coefficients of friction, which takes minutes, and write
            sweep.csv and sweep.png with their cost and greatest lean.
        unknown_episodes: of the rolling robot's certified ones on the track "unknown", whose optima are found for the
            slipperiest floor too; never_slip.csv has the additional cost.
    """
    demand(out)
    if costs:
        sweep(out)
    if contact_episodes:
        contact(out, contact_episodes)
    if unknown_episodes:
        never_slip(out, unknown_episodes)


if __name__ == "__main__":
    tyro.cli(main)
