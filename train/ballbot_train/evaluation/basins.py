"""Basins of attraction: the states that each controller brings to rest, and the states that any controller could.

A map spans the lean γ and one other component of Stabilize's initial state; the rest is zero. A state is recovered if the
episode succeeds: at rest at the origin when it ends. It is recoverable if it lies within the boundary that
`ballbot_baselines.optimum.recovery` finds, or if any controller recovers from it. Turning the world by 180° takes (γ, v) to
(−γ, −v), so only half of every map is run.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym import files
from ballbot_gym.env import make_task
from ballbot_gym.robot import PAPER, named_robot
from ballbot_train.evaluation.results import Result
from ballbot_train.evaluation.runner import Group, MeasuredRun
from ballbot_train.work import jobs
from ballbot_train.work.executors import Workers

TASK = "stabilize"
LEAN_LIMIT = 75.0  # degrees, either side
_BOUNDARY_POINTS = 31  # its search goes from value to value, in steps that it can follow
_ARENA_RADIUS = 1000.0  # m: a map asks whether the robot comes back, not how far it goes meanwhile
_DOUBT = 2.0  # degrees beyond the boundary that are run too, because it is only as exact as its regularization


@dataclass(frozen=True)
class _Axis:
    """The other component of a map, from −limit to limit."""

    component: int
    """Its index in a state."""
    limit: float
    label: str


AXES: dict[str, _Axis] = {"speed": _Axis(4, 15.0, "speed ẋ, m/s"), "lean rate": _Axis(6, 15.0, "lean rate γ̇, rad/s")}


@dataclass(frozen=True)
class _BasinMap:
    """One map: n leans, degrees, by n values of its axis; arrays are (values, leans)."""

    axis: str
    leans: np.ndarray
    values: np.ndarray
    boundary: np.ndarray
    """(m, 2) lean, degrees, and value: the corners of what is recoverable, once around."""
    recoverable: np.ndarray
    recovered: dict[str, np.ndarray]
    """By controller."""

    def fraction(self, controller: str) -> float:
        """The share of the recoverable states that a controller brings to rest."""
        return float(self.recovered[controller].sum() / self.recoverable.sum())


@dataclass(frozen=True)
class Basins:
    """A map for each of `AXES`, of the same controllers."""

    maps: tuple[_BasinMap, ...]

    @classmethod
    def run(
        cls,
        controllers: Sequence[str],
        points: int,
        physics: str,
        out: Path,
        workers: int | Workers,
        robot: str = PAPER,
    ) -> "Basins":
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
        cells = _cells_of(bounds, points)
        groups = _groups_of(cells, controllers, points, physics, robot)
        results = MeasuredRun(out, workers).measure(groups, 0)
        return cls(tuple(_maps_of(bounds, cells, results, controllers, points)))

    def fraction(self, controller: str) -> float:
        """The share of the recoverable states of all maps that a controller brings to rest."""
        recovered = sum(int(np.sum(basin.recovered[controller])) for basin in self.maps)
        return recovered / sum(int(np.sum(basin.recoverable)) for basin in self.maps)

    def write(self, facts: Mapping[str, Any], out: Path) -> None:
        """Writes basins.json, which holds the facts as "about", rows and maps, and basins.csv with a line for each state."""
        rows = [
            {"task": TASK, "controller": c, "recovered": self.fraction(c)}
            | {basin.axis: basin.fraction(c) for basin in self.maps}
            for c in self.maps[0].recovered
        ]
        document = {
            "about": facts,
            "rows": rows,
            "maps": [vars(basin) | {"label": AXES[basin.axis].label} for basin in self.maps],
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
            for basin in self.maps
            for i, value in enumerate(basin.values)
            for j, lean in enumerate(basin.leans)
        ]
        files.write_csv(out / "basins.csv", lines)


def _boundary(robot: str, names: Sequence[str]) -> Iterator[jobs.Entry]:
    from ballbot_baselines.optimum.recovery import largest_leans  # it imports CasADi

    for name in names:
        values = _grid(name, _BOUNDARY_POINTS)[1]
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


def _grid(axis: str, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Leans (points,), degrees, and values (points,) of the axis."""
    limit = AXES[axis].limit
    return np.linspace(-LEAN_LIMIT, LEAN_LIMIT, points), np.linspace(-limit, limit, points)


def _cells_of(bounds: Mapping[str, np.ndarray], points: int) -> dict[str, np.ndarray]:
    """The states to run, as (n, 2) rows and columns of each map: those within the boundaries or little beyond, of half a
    map.
    """
    worth = {name: _within(boundary, *_grid(name, points), _DOUBT) for name, boundary in bounds.items()}
    return {name: np.argwhere(inside & (np.arange(points) >= points // 2)[:, None]) for name, inside in worth.items()}


def _groups_of(
    cells: Mapping[str, np.ndarray], controllers: Sequence[str], points: int, physics: str, robot: str = PAPER
) -> list[Group]:
    """What to run: every controller from all states of each map. Results are labelled with their "axis"."""
    groups = []
    for name, chosen in cells.items():
        leans, values = _grid(name, points)
        starts = np.zeros((len(chosen), named_robot(robot).state_size))
        starts[:, AXES[name].component], starts[:, 2] = values[chosen[:, 0]], np.radians(leans[chosen[:, 1]])
        world: dict[str, Any] = {"starts": starts, "fields": {"arena_radius": _ARENA_RADIUS}, "labels": {"axis": name}}
        groups += [Group(TASK, each, physics, robot, counts_for=each, **world) for each in controllers]
    return groups


def _maps_of(
    bounds: Mapping[str, np.ndarray],
    cells: Mapping[str, np.ndarray],
    results: Iterable[Result],
    controllers: Sequence[str],
    points: int,
) -> list[_BasinMap]:
    """The maps that the results of all states make up."""
    recovered = {name: {c: np.zeros((points, points), bool) for c in controllers} for name in bounds}
    for result in results:
        axis = result.labels["axis"]
        found, (i, j) = recovered[axis][result.controller], cells[axis][result.episode]
        found[i, j] |= result.success
        found[-1 - i, -1 - j] |= result.success
    maps = []
    for name, boundary in bounds.items():
        leans, values = _grid(name, points)
        recoverable = np.logical_or.reduce([_within(boundary, leans, values), *recovered[name].values()])
        maps.append(_BasinMap(name, leans, values, boundary, recoverable, recovered[name]))
    return maps
