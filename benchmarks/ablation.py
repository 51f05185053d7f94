"""What makes Stabilize learnable by PPO: `ballbot train rsl_ppo` with all that helps, and without one part after the other.

`--share 0.15` trains only the first seventh of each run, as it is in the whole one: with fewer iterations alone the step size
and the deviation of the actions fall too early, and no variant learns.

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
from ballbot_train.learning import schedules
from ballbot_train.learning.curricula import Curriculum
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.learning.learners.rsl_ppo import RslPpoConfig

_TEST_EPISODES = 10  # in PyBullet at the end of a run: the curves are those of the closed form
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
    share: float = 1.0,
    num_envs: int | None = None,
    workers: int = 1,
    out: Path = Path("runs/ablation"),
) -> None:
    """Trains what is missing and draws the curves.

    Args:
        task: name of a task; the step size and the deviation that stay constant are those of stabilize.
        variants: names of variants.
        seeds: as of `ballbot train --seeds`.
        share: in (0, 1]: only so much of the beginning of each run is trained, with the schedules of the whole one.
        num_envs: of each training; default, as tuned.
        workers: runs at once, each on one core.
        out: folder of all runs; the curves are in its folder `curves`.
    """
    check_names("variant", variants, VARIANTS)
    if not 0 < share <= 1:
        raise SystemExit(f"--share must be above 0 and at most 1, not {share:g}")
    for name in variants:
        changes = VARIANTS[name] | ({} if num_envs is None else {"num_envs": num_envs})
        console.print(f"{name}: {changes or 'as tuned'}")
        settings = beginning(replace(LEARNERS["rsl_ppo"].settings(task), **changes), share)
        folder = out / task / name
        train(
            "rsl_ppo",
            task=task,
            settings=settings,
            seeds=seeds,
            workers=workers,
            test_episodes=_TEST_EPISODES,
            out=folder,
        )
    curves(tuple(out / task / name for name in variants), out=out / "curves" / task)


def beginning(settings: RslPpoConfig, share: float) -> RslPpoConfig:
    """The settings of a run that is the first share of another one, its schedules included."""
    return replace(
        settings,
        total_iterations=max(1, round(share * settings.total_iterations)),
        final_learning_rate=schedules.geometric(settings.learning_rate, settings.final_learning_rate, share),
        final_std=schedules.geometric(settings.std, settings.final_std, share),
        final_gamma=schedules.discount(settings.gamma, settings.final_gamma, share),
    )


if __name__ == "__main__":
    tyro.cli(main)
