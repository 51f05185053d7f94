"""What makes Stabilize learnable by PPO: `ballbot train rsl_ppo` with all that helps, and without one part after the other.

Every variant trains on several seeds, as a queue of one-core runs that goes on where it was stopped. Then the learning curves
of all variants are drawn: interquartile means over the seeds, against env steps and against minutes.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import tyro

from ballbot_train.commands.curves import curves
from ballbot_train.commands.train import train
from ballbot_train.console import check_names, console
from ballbot_train.learning.curricula import Curriculum
from ballbot_train.learning.learners import LEARNERS

FAILURE_PRICE = 300.0  # of a failure, where living does not pay

VARIANTS: dict[str, dict[str, Any]] = {
    "all": {},
    "no-products": {"products": False},
    "no-pay": {"pay": False, "failure_price": FAILURE_PRICE},
    "no-arena": {"arena": False},
    "no-pay-no-arena": {"pay": False, "failure_price": FAILURE_PRICE, "arena": False},
    "no-symmetry": {"symmetry": "none"},
    "whole-episodes": {"episode_seconds": 8.0},
    "no-short-episodes": {"curriculum": Curriculum()},
    "constant-discount": {"final_gamma": 0.995},
    "few-minibatches": {"num_mini_batches": 4},
    "constant-deviation": {"final_std": 0.2},
    "constant-step-size": {"final_learning_rate": 2e-3},
    "nothing": {
        "products": False,
        "pay": False,
        "failure_price": FAILURE_PRICE,
        "arena": False,
        "symmetry": "none",
        "episode_seconds": 8.0,
        "num_mini_batches": 4,
        "curriculum": Curriculum(),
        "final_gamma": 0.995,
    },
}
"""Settings of rsl_ppo that each variant changes."""


def main(
    task: str = "stabilize",
    variants: tuple[str, ...] = tuple(VARIANTS),
    seeds: str = "0:5",
    total_iterations: int | None = None,
    num_envs: int | None = None,
    workers: int = 1,
    out: Path = Path("runs/ablation"),
) -> None:
    """Trains what is missing and draws the curves.

    Args:
        task: name of a task; the step size and the deviation that stay constant are those of stabilize.
        variants: names of variants.
        seeds: as of `ballbot train --seeds`.
        total_iterations: of each training; default, as tuned for the task. Schedules end with it.
        num_envs: of each training; default, as tuned.
        workers: runs at once, each on one core.
        out: folder of all runs; the curves are in its folder `curves`.
    """
    check_names("variant", variants, VARIANTS)
    sizes = {"total_iterations": total_iterations, "num_envs": num_envs}
    for name in variants:
        changes = VARIANTS[name] | {size: value for size, value in sizes.items() if value is not None}
        console.print(f"{name}: {changes or 'as tuned'}")
        settings = replace(LEARNERS["rsl_ppo"].settings(task), **changes)
        train("rsl_ppo", task=task, settings=settings, seeds=seeds, workers=workers, out=out / task / name)
    curves(tuple(out / task / name for name in variants), out=out / "curves" / task)


if __name__ == "__main__":
    tyro.cli(main)
