"""How trajectories, episodes, optima and leaderboard rows show themselves in a line, and motions in 3D.

Their 3D replays and figures are drawn by `ballbot_train.report`, which is imported when it is asked for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ballbot_gym import lazy
from ballbot_gym.robot import Robot

if TYPE_CHECKING:
    from ballbot_gym.trajectory import Trajectory


class Displayed:
    """What shows itself by its facts."""

    def facts(self) -> dict[str, str]:
        """What there is to say in a line: figures with their units, by what they are."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name} {value}' for name, value in self.facts().items())})"


class Moving(Displayed):
    """What shows a motion."""

    @property
    def motion(self) -> Trajectory:
        """The motion that is shown."""
        return getattr(self, "trajectory")  # noqa: B009 (a field of the subclasses)

    def show(self, *others: Moving, labels: Sequence[str] = (), robot: str | Robot = "paper") -> Path | None:
        """The replay in 3D: in a Jupyter notebook below the cell, elsewhere in the browser.

        Args:
            others: trajectories, episodes or optima to show next to it.
            labels: a name for each; default, what they are.
            robot: what is drawn, a name in `ROBOTS` or its parameters.

        Returns:
            The page that was written and opened; None in a notebook.

        Raises:
            ModuleNotFoundError: the extra that draws is not installed; the message names it.
            ValueError: no such robot, another number of labels, or a single state, in which nothing moves.
        """
        return lazy.load("ballbot_train.report.notebook:show_motions")((self, *others), labels, robot)

    def plot(self, *others: Moving, labels: Sequence[str] = ()) -> Any:
        """A matplotlib Figure of positions, velocities, leans, forces and the path. For arguments and errors see `show`."""
        return lazy.load("ballbot_train.report.notebook:plot_motions")((self, *others), labels)


def percent(share: float) -> str:
    """A share in words, "–" where there is none."""
    return f"{100 * share:.2f} %" if math.isfinite(share) else "–"
