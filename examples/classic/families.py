"""Why the acrobot's optimum needs a search: the best motions whose hip bends to either side first are different local optima.

    python examples/classic/families.py --episodes 50 --out docs/experiments/classic-acrobot-families.csv

For each of the first certified episodes it finds the best motion of each side, and the motion that the cheapest guess
alone leads to. It writes a line for each episode, and prints a summary.
"""

from dataclasses import dataclass
from pathlib import Path

import ballbot_classic
import numpy as np
import tyro
from ballbot_classic.acrobot import AcrobotUp

from ballbot_baselines import PlanError, find_optimum
from ballbot_gym import certified, files, named_robot

BEND = 0.5  # rad, from where a bend counts
SAME = 1e-4  # relative: costs that differ by less are the same


def first_bend(x: np.ndarray) -> int:
    """1 or −1: the side to which the hip of a motion x (n+1, 4) bends first; 0 if it never does."""
    bent = np.flatnonzero(np.abs(x[:, 1]) > BEND)
    return int(np.sign(x[bent[0], 1])) if len(bent) else 0


@dataclass(frozen=True)
class OneSide(AcrobotUp):
    """The acrobot's task, searched from guesses that bend to one side first."""

    side: int = 1

    def guesses(self, x: np.ndarray, c: np.ndarray, params: object) -> list[tuple[np.ndarray, np.ndarray]]:
        return [guess for guess in super().guesses(x, c, params) if first_bend(guess[0]) == self.side]


@dataclass(frozen=True)
class OneGuess(AcrobotUp):
    """The acrobot's task, searched from its cheapest guess alone."""

    def guesses(self, x: np.ndarray, c: np.ndarray, params: object) -> list[tuple[np.ndarray, np.ndarray]]:
        return super().guesses(x, c, params)[:1]


def cost(task: AcrobotUp, x0: np.ndarray) -> float:
    """Of the best motion that is found, inf if there is none."""
    try:
        found = find_optimum(task, named_robot("acrobot"), x0, np.zeros(0))
    except PlanError:
        return np.inf
    return found.cost if found.status == "optimal" else np.inf


def main(episodes: int = 50, out: Path = Path("runs/acrobot-families.csv")) -> None:
    """Compares, writes the table and prints the summary.

    Args:
        episodes: certified episodes, from the first.
        out: file of the table.
    """
    ballbot_classic.register()
    known = certified.load(AcrobotUp(), named_robot("acrobot"), episodes=range(episodes))
    searches = {"right": OneSide(side=1), "left": OneSide(side=-1), "one_guess": OneGuess()}
    lines = []
    for seed, (x0, optimum) in enumerate(zip(known.states[:episodes], known.costs[:episodes], strict=True)):
        lines.append(
            {"seed": seed, "optimum": float(optimum)} | {name: cost(task, x0) for name, task in searches.items()}
        )
        print(lines[-1], flush=True)
    files.write_csv(out, lines)
    column = {key: np.array([line[key] for line in lines]) for key in lines[0]}
    print(
        "| search | finds the optimum | costs more where it does not: median, most | finds no motion |\n|---|---|---|---|"
    )
    for name in searches:
        excess = column[name] / column["optimum"] - 1
        missed = excess[(excess > SAME) & np.isfinite(excess)]
        more = f"{np.median(missed):.1%}, {missed.max():.1%}" if len(missed) else ""
        print(f"| {name} | {(excess <= SAME).mean():.0%} | {more} | {np.isinf(excess).mean():.0%} |")


if __name__ == "__main__":
    tyro.cli(main)
