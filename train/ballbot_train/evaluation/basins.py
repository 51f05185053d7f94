"""Basins of attraction: the states from which each controller brings the robot to rest, and those from which any could.

A map spans the lean γ and one other component of Stabilize's initial state; the rest is zero. A state is recovered if the
episode succeeds: at rest at the origin when it ends. It is recoverable if it lies within the boundary that
`ballbot_baselines.optimum.recovery` finds, or if any controller recovers from it. Turning the world by 180° takes (γ, v) to
(−γ, −v), so only half of every map is run.
"""

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym import files
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.robots import PAPER, named_robot
from ballbot_gym.rollout import Controller, PlanError, rollout
from ballbot_train import jobs
from ballbot_train.evaluation.controllers import portable
from ballbot_train.evaluation.evaluate import as_controller
from ballbot_train.executors import Workers

TASK = "stabilize"
LEAN_LIMIT = 75.0  # degrees, either side
_BOUNDARY_POINTS = 31  # its search goes from value to value, in steps that it can follow
_ARENA_RADIUS = 1000.0  # m: a map asks whether the robot comes back, not how far it goes meanwhile
_DOUBT = 2.0  # degrees beyond the boundary that are run too, because it is only as exact as its regularization


@dataclass(frozen=True)
class Axis:
    """The other component of a map, from −limit to limit."""

    component: int
    """Its index in a state."""
    limit: float
    label: str


AXES: dict[str, Axis] = {"speed": Axis(4, 15.0, "speed ẋ, m/s"), "lean rate": Axis(6, 15.0, "lean rate γ̇, rad/s")}


@dataclass(frozen=True)
class BasinMap:
    """One map: n leans, degrees, by n values of its axis; arrays are (values, leans)."""

    axis: str
    leans: np.ndarray
    values: np.ndarray
    boundary: np.ndarray
    """(m, 2) lean, degrees, and value: the corners of what is recoverable, once around."""
    recoverable: np.ndarray
    recovered: dict[str, np.ndarray]
    """By controller."""


def run(
    controllers: Sequence[str], points: int, physics: str, out: Path, workers: int | Workers, robot: str = PAPER
) -> list[BasinMap]:
    """Finds the boundaries, runs the controllers from every state within them, resumably, and makes a map for each axis.

    Args:
        controllers: names.
        points: along each axis of a map; odd.
        physics: "bullet", "mujoco" or "rk4".
        out: folder of the results.
        workers: a number of processes, or `Workers`.
        robot: by name.
    """
    search = [jobs.Job(f"boundary-{name}", _boundary, (robot,), (name,), "boundary") for name in AXES]
    found = jobs.run(search, out, workers)
    bounds = {name: np.array(entry["boundary"]) for name, (entry,) in zip(AXES, found, strict=True)}
    done = jobs.run(cell_jobs(bounds, controllers, points, physics, robot), out, workers)
    return maps_of(bounds, (entry for entries in done for entry in entries), controllers, points)


def _boundary(robot: str, names: Sequence[str]) -> Iterator[jobs.Entry]:
    from ballbot_baselines.optimum.recovery import largest_leans  # it imports CasADi

    for name in names:
        values = grid(name, _BOUNDARY_POINTS)[1]
        highest = np.degrees(largest_leans(make_task(TASK, robot), named_robot(robot), AXES[name].component, values))
        known = np.isfinite(highest)
        right = np.column_stack([highest, values])[known]
        # −right starts where right ends
        yield {"boundary": np.concatenate([right, -right]).tolist()}


def _within(boundary: np.ndarray, leans: np.ndarray, values: np.ndarray, doubt: float = 0.0) -> np.ndarray:
    """(values, leans) whether each state is inside a boundary, or at most some degrees of lean beyond it."""
    right, left = np.split(boundary, 2)
    highest = np.interp(values, right[:, 1], right[:, 0], left=-np.inf, right=-np.inf)
    lowest = np.interp(values, left[::-1, 1], left[::-1, 0], left=np.inf, right=np.inf)
    return (leans >= lowest[:, None] - doubt) & (leans <= highest[:, None] + doubt)


def grid(axis: str, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Leans (points,), degrees, and values (points,) of the axis."""
    limit = AXES[axis].limit
    return np.linspace(-LEAN_LIMIT, LEAN_LIMIT, points), np.linspace(-limit, limit, points)


def cell_jobs(
    bounds: Mapping[str, np.ndarray], controllers: Sequence[str], points: int, physics: str, robot: str = PAPER
) -> list[jobs.Job]:
    """Every state to run, row by row of every map: those within the boundaries or little beyond, of half a map."""
    work = []
    for name, boundary in bounds.items():
        worth = _within(boundary, *grid(name, points), _DOUBT)
        for controller in controllers:
            sent = portable(controller, make_task(TASK, robot), named_robot(robot))
            arguments = name, controller, physics, points, sent, robot
            for i in range(points // 2, points):
                items = tuple((i, int(j)) for j in np.flatnonzero(worth[i]))
                stem = f"{name}-{controller}-{physics}-{points}-{i:02d}"
                work.append(jobs.Job(stem, _cells, arguments, items, controller))
    return work


def _cells(
    axis: str,
    controller: str,
    physics: str,
    points: int,
    sent: str | Controller,
    robot: str,
    items: Sequence[tuple[int, int]],
) -> Iterator[jobs.Entry]:
    env = BallbotEnv(TASK, physics=physics, robot=robot, arena_radius=_ARENA_RADIUS)
    made = as_controller(sent, env.task, env.params)
    leans, values = grid(axis, points)
    for i, j in items:
        x = np.zeros(env.params.state_size)
        x[2], x[AXES[axis].component] = math.radians(leans[j]), values[i]
        try:
            recovered = rollout(env, made, seed=0, options={"state": x}).success
        except PlanError:
            recovered = False
        yield {"axis": axis, "controller": controller, "i": i, "j": j, "recovered": recovered}
    env.close()


def maps_of(
    bounds: Mapping[str, np.ndarray], entries: Iterable[jobs.Entry], controllers: Sequence[str], points: int
) -> list[BasinMap]:
    """The maps that finished states make up."""
    recovered = {name: {c: np.zeros((points, points), bool) for c in controllers} for name in bounds}
    for entry in entries:
        cells, i, j = recovered[entry["axis"]][entry["controller"]], entry["i"], entry["j"]
        cells[i, j] |= entry["recovered"]
        cells[-1 - i, -1 - j] |= entry["recovered"]
    maps = []
    for name, boundary in bounds.items():
        leans, values = grid(name, points)
        recoverable = np.logical_or.reduce([_within(boundary, leans, values), *recovered[name].values()])
        maps.append(BasinMap(name, leans, values, boundary, recoverable, recovered[name]))
    return maps


def fraction(maps: Sequence[BasinMap], controller: str) -> float:
    """The share of the recoverable states of maps from which a controller recovers."""
    recovered = sum(int(np.sum(basin.recovered[controller])) for basin in maps)
    return recovered / sum(int(np.sum(basin.recoverable)) for basin in maps)


def write(maps: Sequence[BasinMap], facts: Mapping[str, Any], out: Path) -> None:
    """Writes basins.json, which holds the facts as "about", rows and maps, and basins.csv with a line for each state."""
    rows = [
        {"task": TASK, "controller": c, "recovered": fraction(maps, c)}
        | {basin.axis: fraction([basin], c) for basin in maps}
        for c in maps[0].recovered
    ]
    document = {
        "about": facts,
        "rows": rows,
        "maps": [vars(basin) | {"label": AXES[basin.axis].label} for basin in maps],
    }
    text = json.dumps(
        document, ensure_ascii=False, default=lambda array: (0 + array).tolist()
    )  # truth values as 0 and 1
    files.write(out / "basins.json", text + "\n")
    lines = [
        {
            "axis": basin.axis,
            "value": f"{value:g}",
            "lean_deg": f"{lean:g}",
            "recoverable": int(basin.recoverable[i, j]),
            **{name: int(cells[i, j]) for name, cells in basin.recovered.items()},
        }
        for basin in maps
        for i, value in enumerate(basin.values)
        for j, lean in enumerate(basin.leans)
    ]
    files.write_csv(out / "basins.csv", lines)
