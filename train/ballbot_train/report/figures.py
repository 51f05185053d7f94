"""Figures of trajectories and of comparisons, in matplotlib."""

import io
import itertools
import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib import patches
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import LogFormatter

from ballbot_gym import files
from ballbot_gym.robot import Ballbot, Robot
from ballbot_gym.tasks.marker import Marker
from ballbot_train.evaluation.basins import AXES, TASK, Basins
from ballbot_train.evaluation.results import Result, Row
from ballbot_train.evaluation.robustness import NONE, REGRET, STRESSES, curve_of
from ballbot_train.report.labels import ORDER, color, labels
from ballbot_train.report.replay import Take

_LEGEND_COLUMNS = 4  # below each task's axes
_LEAST_REGRET = 0.01  # %: the left end of a logarithmic axis


def trajectory_figure(
    title: str, takes: Sequence[Take], markers: Sequence[Marker] = (), robot: Robot | None = None
) -> Figure:
    """The paper's form: position, velocity and lean over time, forces over time, and the ground path.

    Of a `robot` that is no ballbot, all components of states and actions over time.
    """
    if robot is not None and not isinstance(robot, Ballbot):
        return _components_figure(title, takes, robot)
    figure = Figure(figsize=(12, 6.2), layout="constrained")
    figure.suptitle(title, fontsize=13)
    axes = figure.subplot_mosaic(
        [["position", "velocity", "path"], ["lean", "force", "path"]], width_ratios=[1, 1, 1.25]
    )
    panels = {
        "position": ("ball position, m", 0, "x solid, y dotted", 1.0),
        "velocity": ("ball velocity, m/s", 4, "ẋ solid, ẏ dotted", 1.0),
        "lean": ("lean, deg", 2, "γ solid, θ dotted", 180 / math.pi),
        "force": ("force, N", None, "Fx solid, Fy dotted", 1.0),
    }
    for key, (y_label, first, names, factor) in panels.items():
        axis = axes[key]
        for take, i in itertools.product(takes, range(2)):
            shown = take.trajectory
            values = shown.u[:, i] if first is None else shown.x[:, first + i]
            held = "steps-post" if first is None and shown.held else "default"
            look = {"color": take.color, "lw": 1.5, "alpha": 0.8 if i else 1.0, "drawstyle": held}
            axis.plot(shown.t[: len(values)], factor * values, ":" if i else take.style, **look)
        axis.set_ylabel(y_label)
        axis.set_title(names, fontsize=9, color="0.35")
        axis.grid(alpha=0.3)
        axis.axhline(0, color="0.6", lw=0.6)
    for key in ("lean", "force"):
        axes[key].set_xlabel("time, s")
    path = axes["path"]
    for take in takes:
        name = f"{take.label}, {take.note}" if take.note else take.label
        path.plot(*take.trajectory.x[:, :2].T, take.style, color=take.color, lw=2, label=name)
    for marker in markers:
        look = {"fill": not marker.ring, "ls": "--" if marker.ring else "-", "color": marker.color[:3]}
        path.add_patch(patches.Circle(marker.position, marker.radius, **look, alpha=0.4)).set_zorder(0)
    for mark, x in (("o", takes[0].trajectory.x[0]), ("s", takes[0].trajectory.x[-1])):
        path.plot(*x[:2], mark, color="k", ms=5)
    path.set_aspect("equal", adjustable="datalim")
    path.set(xlabel="x, m", ylabel="y, m", title="ground path (● start, ■ end)")
    path.grid(alpha=0.3)
    path.legend(fontsize=9, loc="best")
    _plain(figure)
    return figure


def _components_figure(title: str, takes: Sequence[Take], robot: Robot) -> Figure:
    shown = [(each, True, i) for i, each in enumerate(robot.STATE)]
    shown += [(each, False, i) for i, each in enumerate(robot.ACTION)]
    columns = min(3, len(shown))
    rows = math.ceil(len(shown) / columns)
    figure = Figure(figsize=(4 * columns, 2.6 * rows), layout="constrained")
    figure.suptitle(title, fontsize=13)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    for axis, (quantity, of_state, i) in zip(axes, shown, strict=False):
        for take in takes:
            motion = take.trajectory
            values = motion.x[:, i] if of_state else motion.u[:, i]
            held = "default" if of_state or not motion.held else "steps-post"
            name = f"{take.label}, {take.note}" if take.note else take.label
            axis.plot(motion.t[: len(values)], values, take.style, color=take.color, drawstyle=held, label=name)
        axis.set_ylabel(f"{quantity.name}, {quantity.unit}")
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    axes[len(shown) - 1].set_xlabel("time, s")
    for axis in axes[len(shown) :]:
        axis.set_visible(False)
    _plain(figure)
    return figure


def regret_figure(results: Sequence[Result], ways: Mapping[str, str] = {}) -> Figure:
    """For every task, the share of episodes that each controller finishes within a given regret.

    `ways` are the whole ways of shipped policies by "TASK/NAME".
    """
    tasks = list(dict.fromkeys(result.task for result in results))
    figure = Figure(figsize=(4.2 * len(tasks), 3.8), layout="constrained")
    axes = figure.subplots(1, len(tasks), squeeze=False)
    for axis, task in zip(axes[0], tasks, strict=True):
        named = labels((result.controller for result in results if result.task == task), task, ways)
        for i, controller in enumerate(named):
            group = [result for result in results if (result.task, result.controller) == (task, controller)]
            # an episode that stands but misses its goal has no meaningful regret
            regrets = np.sort([max(100 * result.regret, _LEAST_REGRET) for result in group if result.success])
            share = 100 * np.arange(1, len(regrets) + 1) / len(group)
            axis.step(regrets, share, where="post", lw=2, color=color(controller, i), label=named[controller])
        axis.set(
            xscale="log", xlim=(_LEAST_REGRET, 1000), ylim=(0, 102), title=task, xlabel="cost above the optimum, %"
        )
        axis.grid(alpha=0.3)
    axes[0][0].set_ylabel("episodes that succeed, %")
    # a controller may be in some of the tasks only
    shown = {label: line for axis in axes[0] for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    ordered = sorted(shown, key=[*ORDER, *shown].index)
    columns = min(len(ordered), max(_LEGEND_COLUMNS * len(tasks), 1))
    figure.legend([shown[each] for each in ordered], ordered, loc="outside lower center", ncols=columns, fontsize=9)
    return figure


def robustness_figure(rows: Sequence[Row], task: str, ways: Mapping[str, str] = {}) -> Figure:
    """Success and regret of every controller on a task against the severity of every disturbance.

    Regret, with its 95 % interval, is drawn where at least half of the episodes did not fail.
    """
    stresses = list(dict.fromkeys(row.labels["stress"] for row in rows if row.labels["stress"] != NONE))
    named = labels((row.controller for row in rows if row.task == task), task, ways)
    figure = Figure(figsize=(2.9 * len(stresses), 5.6), layout="constrained")
    axes = figure.subplots(2, len(stresses), squeeze=False, sharey="row", sharex="col")
    figure.suptitle(f"{task}: success and regret under disturbances", fontsize=13)
    for i, stress in enumerate(stresses):
        above, below = axes[:, i]
        for k, controller in enumerate(named):
            points = curve_of(rows, task, controller, stress)
            levels, shade, width = [row.labels["level"] for row in points], color(controller, k), max(1.5, 3.5 - k)
            success = [100 * row.success for row in points]
            above.plot(levels, success, "o-", ms=4, lw=width, color=shade, label=named[controller])
            standing = [row for row in points if 2 * row.falls <= row.episodes and math.isfinite(row.regret_mean)]
            levels = [row.labels["level"] for row in standing]
            below.plot(levels, [100 * row.regret_mean for row in standing], "o-", ms=4, lw=width, color=shade)
            low, high = ([100 * getattr(row, f"regret_{end}") for row in standing] for end in ("low", "high"))
            below.fill_between(levels, low, high, color=shade, alpha=0.15, lw=0)
        above.set(ylim=(-4, 104), title=stress)
        below.set_yscale("symlog", linthresh=1)
        below.set_xlabel(textwrap.fill(STRESSES[stress].label, 28), fontsize=9)
        for axis in (above, below):
            axis.grid(alpha=0.3)
    axes[0][0].set_ylabel("success, %")
    axes[1][0].set_ylabel(REGRET)
    handles, texts = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, texts, loc="outside lower center", ncols=min(len(texts), _LEGEND_COLUMNS), fontsize=9)
    return figure


def basin_figure(basins: Basins, ways: Mapping[str, str] = {}) -> Figure:
    """The initial states that each controller brings to rest, coloured, on those that the robot's limits allow, grey."""
    maps = basins.maps
    controllers, named = list(maps[0].recovered), labels(maps[0].recovered, TASK, ways)
    size = (max(6.0, 1.2 + 3.1 * len(controllers)), 0.8 + 3.1 * len(maps))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(maps), len(controllers), squeeze=False, sharex=True, sharey="row")
    figure.suptitle("Stabilize: from where the robot comes to rest at the origin", fontsize=13)
    for basin, line in zip(maps, axes, strict=True):
        for k, (controller, axis) in enumerate(zip(controllers, line, strict=True)):
            cells = np.where(basin.recovered[controller], 2.0, np.where(basin.recoverable, 1.0, 0.0))
            colors = ListedColormap(["white", "0.88", color(controller, k)])
            axis.pcolormesh(
                basin.leans, basin.values, cells, cmap=colors, vmin=0, vmax=2, shading="nearest", alpha=0.85
            )
            axis.fill(*basin.boundary.T, fill=False, ec="k", lw=1.6)
            axis.set_title(f"{named[controller]}: {basin.fraction(controller):.0%}", fontsize=10)
            axis.axhline(0, color="0.5", lw=0.5)
            axis.axvline(0, color="0.5", lw=0.5)
            axis.set_xlim(-81, 81)
        line[0].set_ylabel(AXES[basin.axis].label)
    for axis in axes[-1]:
        axis.set_xlabel("lean γ, degrees")
    figure.supxlabel("black: the boundary of what the robot can recover; per cent: share of it recovered", fontsize=9)
    return figure


def save(figure: Figure, path: Path) -> Path:
    """Writes a figure as a PNG."""
    _plain(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return files.write(path, buffer.getvalue())


def _plain(figure: Figure) -> None:
    """Shows dollar signs as they are: a name is no formula, and one that is half a formula cannot be drawn."""
    for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
        if axis.get_scale() != "linear":  # these ticks are labelled by formulas
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(LogFormatter())
    for text in figure.findobj(Text):
        text.set_parse_math(False)  # pyright: ignore[reportAttributeAccessIssue]
