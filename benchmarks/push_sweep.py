"""The hardest push that the robot recovers from: LQR, trajectory optimization re-planned from the push, and NMPC.

The robot is at rest when a horizontal impulse hits the centre of mass of its body. LQR and NMPC are not prepared for it: NMPC
has planned to stand still. Trajectory optimization computes a new plan from the state after the push, without a time limit.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from ballbot_baselines import LqrController, NmpcController, TrajoptController
from ballbot_gym import files
from ballbot_gym.env import BallbotEnv
from ballbot_gym.robot import Robot, default_params
from ballbot_gym.rollout import Controller, PlanError, rollout
from ballbot_gym.tasks.stabilize import Stabilize

_SECONDS = 6.0  # until which the robot must be upright again
_UPRIGHT = np.radians(10)
_HARDEST = 640.0  # N·s, as far as is searched


class Unprepared:
    """A controller that planned to stand still at the origin."""

    def __init__(self, controller: Controller):
        self._controller = controller

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        self._controller.reset(t, np.zeros(8), c)

    def act(self, t: float, x: np.ndarray) -> np.ndarray:
        return self._controller.act(t, x)


CONTROLLERS: dict[str, tuple[str, Callable[[Stabilize, Robot], Controller]]] = {
    "LQR": ("#c0392b", LqrController),
    "TO, re-planned": ("#1f6fb2", TrajoptController),
    "NMPC": ("#e08a00", lambda task, params: Unprepared(NmpcController(task, params))),
}


@dataclass(frozen=True)
class Push:
    """The largest impulse survived, N·s, at a bearing, deg."""

    controller: str
    bearing: float
    impulse: float


def after_push(params: Robot, impulse: float, bearing: float) -> np.ndarray:
    """(8,) the state at rest just after a horizontal impulse, N·s, on the body's centre of mass.

    Upright, each axis has [M+m, h; h, J] [v; lean rate] = [p; p·l], with the ball's force finite and so no part in it.
    """
    inertia = np.array([[params.total_mass, params.first_moment], [params.first_moment, params.pivot_inertia]])
    speed, lean_rate = np.linalg.solve(inertia, [impulse, impulse * params.com_height])
    direction = np.array([np.cos(bearing), np.sin(bearing)])
    return np.concatenate([np.zeros(4), speed * direction, lean_rate * direction])


def survives(env: BallbotEnv, controller: Controller, impulse: float, bearing: float) -> bool:
    """Whether the robot does not fall, and is upright at the end."""
    try:
        run = rollout(env, controller, options={"state": after_push(env.params, impulse, bearing)})
    except PlanError:
        return False
    return not run.failure and bool(run.trajectory.tilt[-1] < _UPRIGHT)


def hardest(env: BallbotEnv, controller: Controller, bearing: float, near: float, resolution: float) -> float:
    """The largest impulse survived, N·s, by bisection from a bracket about `near`, to `resolution`.

    At most `_HARDEST`. It takes survival to be monotone, which for NMPC it is not quite: some bearings survive a little more.
    """
    low, high = 0.0, near
    while survives(env, controller, high, bearing):
        if high == _HARDEST:
            return high
        low, high = high, min(1.25 * high, _HARDEST)
    while high - low > resolution:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if survives(env, controller, middle, bearing) else (low, middle)
    return low


def main(out: Path = Path("runs/push_sweep"), bearings: int = 24, resolution: float = 2.0, quick: bool = False) -> None:
    """Sweeps, and writes push_sweep.csv and .png.

    Args:
        out: folder of the results.
        bearings: directions of the push.
        resolution: N·s.
        quick: three bearings, 10 N·s.
    """
    task, params, pushes = Stabilize(), default_params(), []
    env = BallbotEnv(Stabilize(duration=_SECONDS, arena_radius=100.0))
    bearings, resolution = (3, 10.0) if quick else (bearings, resolution)
    for name, (_, make) in CONTROLLERS.items():
        controller, near = make(task, params), 64.0
        for bearing in 2 * np.pi * np.arange(bearings) / bearings:
            near = max(hardest(env, controller, bearing, near, resolution), resolution)
            pushes.append(Push(name, float(np.degrees(bearing)), near))
        mine = [push.impulse for push in pushes if push.controller == name]
        print(f"{name:16s} survives {min(mine):.0f} to {max(mine):.0f} N·s, median {np.median(mine):.0f}", flush=True)
    files.write_csv(out / "push_sweep.csv", [asdict(push) for push in pushes])
    _figure(pushes, out / "push_sweep.png")
    print(f"written to {out}")


def _figure(pushes: list[Push], path: Path) -> None:
    figure = Figure(figsize=(6, 6), layout="constrained")
    axis = figure.subplots(subplot_kw={"projection": "polar"})
    for name, (color, _) in CONTROLLERS.items():
        mine = [push for push in pushes if push.controller == name]
        bearings = np.radians([push.bearing for push in [*mine, mine[0]]])
        axis.plot(bearings, [push.impulse for push in [*mine, mine[0]]], "o-", color=color, label=name, ms=3)
    axis.set_title("largest impulse on the body survived, N·s")
    figure.legend(loc="outside lower center", ncols=3, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    tyro.cli(main)
