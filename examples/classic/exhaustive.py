"""Optima against exhaustive search: dynamic programming on a fine grid, for the two systems whose states are two numbers.

    python examples/classic/exhaustive.py --out docs/experiments --picture docs/pictures/classic-value.png

For every certified episode it computes the value of the grid and of a grid of half the spacing, follows the grid's actions in
the exact system, and improves that motion locally. It writes a line for each episode, and prints a summary. With `--policy`
it draws the paths of a model of Stable-Baselines3 that was trained in Pendulum-v1, too.
"""

import ctypes
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import ballbot_classic
import gymnasium
import matplotlib.pyplot as plt
import numpy as np
import tyro

from ballbot_baselines import Backoff
from ballbot_gym import TASKS, certified, files, machine_code, named_robot

FOLDER = Path(__file__).parent
FLAGS = ("-O3", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast")
ACTIONS = {"pendulum": 13, "mountain_car": 7}  # of which the best is refined
SHOWN = {"pendulum": (0, 2, 3), "mountain_car": (0, 1)}  # episodes in the picture


@dataclass(frozen=True)
class System:
    """What a grid needs of a task: an angle that wraps and another coordinate, as grid_NAME.c defines them."""

    low: float
    high: float
    """Of the second coordinate. The mountain car has nodes at 0, the orbit of the wall, if 52 divides their number less 1."""
    shape: tuple[int, int]
    """Nodes of the coarser grid."""
    most: float
    """Above every value that matters."""
    ages: int
    """Control steps after which nodes that move are placed anew."""
    last_is_free: bool
    """Whether the last control step costs its own state alone, so that no action matters."""
    view: tuple[tuple[float, float], tuple[float, float]]
    """States in the picture."""


SYSTEMS = {
    "pendulum": System(-8.0, 8.0, (256, 201), 1e9, 1, True, ((-np.pi, np.pi), (-8.0, 8.0))),
    "mountain_car": System(
        -4.125305251948621, 3.819727085137612, (96, 209), 100.0, 16, False, ((-1.2, 0.45), (-0.055, 0.055))
    ),
}


class _Grid(ctypes.Structure):
    _fields_ = (
        ("low", ctypes.c_double * 2),
        ("high", ctypes.c_double * 2),
        ("nodes", ctypes.c_int64 * 2),
        ("actions", ctypes.c_int64),
        ("age", ctypes.c_int64),
        ("left", ctypes.c_int64),
        ("most", ctypes.c_double),
    )


class Grid:
    """Tables (nodes + 1) of the least cost of what follows, of the control steps of an episode, backwards in time.

    The last number of a table is the value where the system stops; see grid.c.
    """

    def __init__(self, name: str, finer: float):
        self._name, self._task, self._system = name, TASKS[name](), SYSTEMS[name]
        count, others = self._system.shape
        self._shape = 2 * round(count * finer / 2), round((others - 1) * finer) + 1
        source = "".join((FOLDER / file).read_text(encoding="utf-8") for file in (f"grid_{name}.c", "grid.c"))
        self._code = ctypes.CDLL(str(machine_code.library(f"grid-{name}", source, FLAGS)))
        self._steps = self._task.steps - self._system.last_is_free  # in which an action matters

    def tables(self, keep: bool) -> list[np.ndarray]:
        """Those of steps 1 to the last, float32; where they are not kept, that of step 1 alone."""
        size = self._shape[0] * self._shape[1] + 1
        found = [np.full(size, 0.0 if self._system.last_is_free else self._system.most, np.float32)]
        for step in range(self._steps - 1, 0, -1):
            now, age = np.empty(size, np.float32), step % self._system.ages
            self._code.sweep(self._table_of(step + 1), _pointer(found[-1]), ctypes.c_int64(age), _pointer(now))
            found = [*found, now] if keep else [now]
            if not step % 50:
                print(f"{self._name}, {self._shape[0]} × {self._shape[1]} nodes: {step} steps left", flush=True)
        return found[::-1]

    def _table_of(self, step: int) -> Any:
        """Where the nodes of the table of a step are."""
        system = self._system
        bounds, age = ((-np.pi, system.low), (np.pi, system.high)), step % system.ages
        return ctypes.byref(_Grid(*bounds, self._shape, ACTIONS[self._name], age, self._steps - step, system.most))

    def values(self, table: np.ndarray, states: np.ndarray) -> np.ndarray:
        """The least costs (n,) from states (n, 2) at the start, by the table of step 1."""
        return self._followed(1, table, states.copy(), np.zeros(len(states), np.uint8))[2]

    def motions(self, tables: list[np.ndarray], states: np.ndarray) -> tuple[list[Any], np.ndarray]:
        """What following the grid's actions in the exact system gives from states (n, 2).

        Returns:
            a pair of states (k+1, 2) and actions (k, 1) for each, and their costs (n,), inf where the goal is not reached.
        """
        n, x, ended = len(states), states.copy(), np.zeros(len(states), np.uint8)
        path, taken, total, lengths = [x.copy()], [], np.zeros(n), np.zeros(n, int)
        for step, table in enumerate(tables, 1):
            lengths += ended == 0
            actions, costs, _ = self._followed(step, table, x, ended)
            total += costs
            path.append(x.copy())
            taken.append(actions)
        if self._system.last_is_free:
            task, still = self._task, np.zeros((n, 1))
            total += task.control_dt * task.cost(x, still, np.zeros(0))
            path.append(named_robot(task.ROBOT).step(x, still, task.control_dt))
            taken.append(np.zeros(n))
            lengths += 1
        else:
            total[ended == 0] = np.inf
        moved, applied = np.stack(path, axis=1), np.stack(taken, axis=1)[..., None]
        return [(moved[i, : k + 1], applied[i, :k]) for i, k in enumerate(lengths)], total

    def _followed(
        self, step: int, table: np.ndarray, states: np.ndarray, ended: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Actions, costs and values (n,) of the control step before that of a table.

        States (n, 2) and ended (n,) become those after it.
        """
        actions, costs, values = np.zeros((3, len(states)))
        pointers = map(_pointer, (states, actions, costs, values, ended))
        self._code.follow(self._table_of(step), _pointer(table), ctypes.c_int64(len(states)), *pointers)
        return actions, costs, values


def _pointer(array: np.ndarray) -> Any:
    return array.ctypes.data_as(ctypes.c_void_p)


def polished(name: str, x: np.ndarray, u: np.ndarray) -> float:
    """The cost of the local optimum to which a motion x (n+1, 2), u (n, 1) leads."""
    task = TASKS[name]()
    cases = import_module(f"ballbot_classic.{name}_cases")
    episode = SimpleNamespace(task=task, params=named_robot(task.ROBOT), x0=x[0], c=np.zeros(0), backoff=Backoff())
    return min((each.cost for each in cases.solutions(task, episode, [(x, u)]) if each.is_optimal), default=np.inf)


def compared(name: str, finer: float, episodes: int) -> tuple[list[dict[str, float]], Grid, np.ndarray]:
    """Lines of the table of a task; its grid, and the table of the first step."""
    task = TASKS[name]()
    known = certified.load(task, named_robot(task.ROBOT), episodes=range(episodes))
    states, costs = known.states[:episodes], known.costs[:episodes]
    coarse, fine = Grid(name, finer), Grid(name, 2 * finer)
    tables = coarse.tables(keep=True)
    motions, rolled = coarse.motions(tables, states)
    values = coarse.values(tables[0], states)
    first = tables[0]
    del tables
    finest = fine.values(fine.tables(keep=False)[0], states)
    lines = []
    for i, (x, u) in enumerate(motions):
        lines.append(
            {
                "seed": i,
                "optimum": costs[i],
                "grid": values[i],
                "finer_grid": finest[i],
                "followed": rolled[i],
                "improved": polished(name, x, u) if np.isfinite(rolled[i]) else np.inf,
            }
        )
    return lines, coarse, first


def summary(name: str, lines: list[dict[str, float]]) -> str:
    """A line of a Markdown table."""
    column = {key: np.array([line[key] for line in lines]) for key in lines[0]}
    best = column["optimum"]
    off = [best / column[key] - 1 for key in ("grid", "finer_grid")]
    cells = [f"{np.median(np.abs(each)):.4%}, {np.abs(each).max():.4%}" for each in off]
    lower = [f"{(best / column[key] - 1).max():.1e}" for key in ("followed", "improved")]
    inside = int((np.abs(off[1]) < 1e-3).sum())
    return f"| {name} | {len(lines)} | {' | '.join(cells)} | {inside} | {' | '.join(lower)} |"


def draw(shown: dict[str, tuple[Grid, np.ndarray]], policy: Path | None, path: Path) -> None:
    """The values over the states, with optimal paths over them, and those of a policy."""
    figure, panels = plt.subplots(1, len(shown), figsize=(6 * len(shown), 4.5), squeeze=False, layout="constrained")
    for panel, (name, (grid, table)) in zip(panels[0], shown.items(), strict=True):
        task, view = TASKS[name](), SYSTEMS[name].view
        a, b = np.meshgrid(*(np.linspace(*each, 201) for each in view), indexing="ij")
        values = grid.values(table, np.column_stack([a.ravel(), b.ravel()])).reshape(a.shape)
        drawn = panel.contourf(a, b, values, 24, cmap="viridis_r")
        figure.colorbar(drawn, ax=panel, label="least cost to the end")
        known = certified.load(task, named_robot(task.ROBOT), episodes=range(max(SHOWN[name]) + 1))
        for seed in SHOWN[name]:
            _draw(panel, known.trajectories[seed].x, name, "white", "-")
            if policy is not None and name == "pendulum":
                _draw(panel, _driven(policy, task.counterpart, seed), name, "#d62728", "--")
        panel.set(title=task.counterpart, xlim=view[0], ylim=view[1])
        first, second = named_robot(task.ROBOT).STATE
        panel.set(xlabel=f"{first.name}, {first.unit}", ylabel=f"{second.name}, {second.unit}")
    figure.savefig(path, dpi=90)


def _draw(panel: Any, x: np.ndarray, name: str, color: str, style: str) -> None:
    """A path; an angle that wraps makes a gap."""
    place, rate = x[:, 0].copy(), x[:, 1].copy()
    if name == "pendulum":
        place = (place + np.pi) % (2 * np.pi) - np.pi
        gaps = np.flatnonzero(np.abs(np.diff(place)) > np.pi) + 1
        place, rate = np.insert(place, gaps, np.nan), np.insert(rate, gaps, np.nan)
    panel.plot(place, rate, style, color=color, linewidth=1.2)
    panel.plot(place[0], rate[0], "o", color=color, markersize=4)


def _driven(policy: Path, id: str, seed: int) -> np.ndarray:
    """(n, 2) states through which a model of PPO takes the environment."""
    from stable_baselines3 import PPO

    model, env = PPO.load(policy, device="cpu"), gymnasium.make(id)
    seen, _ = env.reset(seed=seed)
    unwrapped: Any = env.unwrapped
    states, ended = [np.array(unwrapped.state)], False
    while not ended:
        action, _ = model.predict(seen, deterministic=True)
        seen, _, terminated, truncated, _ = env.step(action)
        states.append(np.array(unwrapped.state))
        ended = terminated or truncated
    return np.array(states)


def main(
    tasks: tuple[str, ...] = tuple(SYSTEMS),
    episodes: int = 200,
    finer: float = 1.0,
    out: Path = Path("runs/exhaustive"),
    picture: Path | None = None,
    policy: Path | None = None,
) -> None:
    """Compares, writes a file for each task and the picture, and prints the summary.

    Args:
        tasks: pendulum, mountain_car or both.
        episodes: number of certified episodes, from the first.
        finer: how many times finer than usual the grids are.
        out: folder of a table for each task.
        picture: file of the picture; default, none.
        policy: a model of Stable-Baselines3's PPO that was trained in Pendulum-v1, whose paths the picture shows too.
    """
    if unknown := set(tasks) - set(SYSTEMS):
        raise SystemExit(f"unknown tasks {', '.join(sorted(unknown))}; known: {', '.join(SYSTEMS)}")
    ballbot_classic.register()
    rows, shown = [], {}
    for name in tasks:
        lines, grid, table = compared(name, finer, episodes)
        shown[name] = grid, table
        files.write_csv(out / f"classic-exhaustive-{name.replace('_', '-')}.csv", lines)
        rows.append(summary(name, lines))
    print(
        "| task | episodes | optimum against the grid: median, most | the same, half the spacing | within 0.1 % | "
        "optimum above the motion that follows the grid, at most | the same, improved |\n|---|---|---|---|---|---|---|"
    )
    print("\n".join(rows))
    if picture:
        draw(shown, policy, picture)


if __name__ == "__main__":
    tyro.cli(main)
