"""`ballbot evaluate POLICY`: one policy on thousands of fresh episodes, or anything that acts on the certified ones."""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from ballbot_gym import certified
from ballbot_gym.env import BallbotEnv
from ballbot_gym.randomization import Randomization, checked_randomization, track_of
from ballbot_gym.robots import PAPER, file_name
from ballbot_gym.rollout import rollout
from ballbot_train import jobs
from ballbot_train.commands.options import WorkersOption
from ballbot_train.console import (
    Physics,
    RobotName,
    check_least,
    console,
    physics_or_default,
    print_table,
    progress_bars,
)
from ballbot_train.evaluation.benchmark import benchmark, controllers_of, open_run, policy_digests
from ballbot_train.evaluation.controllers import is_expert, make_controller, task_name
from ballbot_train.evaluation.results import HEADER, cells, leaderboard, write_leaderboard
from ballbot_train.executors import Workers
from ballbot_train.provenance import provenance

_FRESH = 10_000
_WORST = 10
_SHOWN_BINS = 6
_FULL_BIN = 20  # episodes from which a bin is called weak


def evaluate(
    policy: str,
    /,
    task: str | None = None,
    fresh: int | None = None,
    seed: int = 0,
    optima: int = 0,
    episodes: int = 0,
    physics: Physics | None = None,
    out: Path | None = None,
    workers: WorkersOption = Workers(),
    robot: RobotName = PAPER,
    randomization: str | None = None,
) -> None:
    """Runs a policy on 10,000 fresh episodes: failures, success and cost by what makes episodes hard, the worst ten.

    Args:
        policy: a policy file, a model saved by Stable-Baselines3 (.zip), or the name of a policy that comes
            with the package; with --episodes also an expert. Statistics of VecNormalize are read from
            MODEL.vecnormalize.npz beside the model, which `ballbot_train.save_vecnormalize` writes.
        task: name of its task; default the one that its file names or whose observations fit, or else stabilize.
        fresh: how many fresh episodes, in the batched closed-form model; default 10000, or none where --episodes is given.
            They are never the certified ones.
        seed: of the fresh episodes.
        optima: of how many fresh episodes, from the first, the optimum is found too, for their regret. Optima stay in the
            folder `optima` beside --out, for later calls and other policies.
        episodes: how many of the certified episodes to run in PyBullet.
        physics: of the certified episodes, "bullet", "mujoco" or "rk4"; default, the first that is installed.
        out: folder of the results; default runs/evaluate/TASK-POLICY, with the robot's name if that is not paper. An
            interrupted run continues here.
        workers: who does the work, for optima and certified episodes.
        robot: whose episodes.
        randomization: name of the track on which the fresh episodes are, of robots and delays that the policy is not told;
            certified episodes of tracks are run by `ballbot benchmark --randomization`.
    """
    varied = checked_randomization(randomization)
    if episodes and randomization:
        raise ValueError("--episodes knows no tracks; give ballbot benchmark --randomization")
    task = task_name(policy, task, robot)
    chosen = controllers_of([task], [policy], robot)
    check_least(0, seed=seed, optima=optima, episodes=episodes)
    Workers.of(workers)
    if episodes > certified.EPISODES:
        raise ValueError(f"episodes must be at most {certified.EPISODES}, the certified ones, not {episodes}")
    fresh = (0 if episodes else _FRESH) if fresh is None else fresh
    check_least(0, fresh=fresh)
    if optima > fresh:
        raise ValueError(f"optima must be at most the {fresh} fresh episodes, not {optima}")
    if not fresh and not episodes:
        raise ValueError("nothing to run: give --fresh or --episodes")
    if fresh and is_expert(policy):
        raise ValueError(
            f"{policy} is an expert, which acts in one episode at a time, and fresh episodes run all at once; give a policy, "
            "or run the expert on certified episodes with --episodes"
        )
    named = f"{task}-{Path(policy).stem}" + (f"-on-{randomization}" if randomization else "")
    out = Path("runs") / "evaluate" / file_name(named, robot) if out is None else out
    if fresh:
        _fresh(policy, task, fresh, seed, optima, out, workers, robot, varied)
    if episodes:
        _certified(chosen, episodes, physics_or_default(physics, robot), out / "certified", workers, robot)


def _fresh(
    policy: str,
    task: str,
    episodes: int,
    seed: int,
    optima: int,
    out: Path,
    workers: Workers,
    robot: str,
    varied: Randomization,
) -> None:
    from ballbot_train.evaluation import fresh  # it imports torch
    from ballbot_train.report import figures

    fresh.check_fresh(episodes, seed)
    jobs.make_folder(out)
    facts = provenance() | {
        "task": task,
        "policy": policy,
        "robot": robot,
        "policies": policy_digests({task: [policy]}, robot),
        "seed": seed,
        "episodes": episodes,
        "physics": "closed form, batched, float64",
    }
    with progress_bars({"episodes": episodes}) as bars:
        progress = partial(bars.advance, "episodes")
        result = fresh.evaluate_fresh(policy, task, episodes, seed, None, progress, robot, varied)
    if optima:
        with progress_bars({task: optima}) as bars:
            track = f"-{track_of(varied)}" if varied.moves_optima else ""
            folder = out.parent / "optima" / f"{file_name(task, robot)}{track}-{seed}"
            found = fresh.find_optima(task, optima, seed, folder, workers, bars.advance, robot, varied)
        result = replace(result, optima=found)
    binned = result.bins()
    worst = _worst(result, policy, task, out / "worst", robot, varied)
    fresh.write(result, binned, worst, facts, out)
    picture = figures.save(figures.fresh_figure(result, binned), out / "fresh.png")
    _print(result, binned, worst)
    console.print(f"figure: {picture}\nall episodes: {out / 'fresh.csv'}\nthe worst: {out / 'worst.csv'}")


def _worst(
    result: Any, policy: str, task: str, folder: Path, robot: str, varied: Randomization
) -> list[dict[str, Any]]:
    """The worst episodes, each with its trajectory in a file that `ballbot replay` draws."""
    env = BallbotEnv(task, physics="rk4", robot=robot, randomization=varied)
    controller = make_controller(policy, env.task, env.params)
    for stale in folder.glob("episode-*.npz"):  # of an earlier evaluation
        stale.unlink()
    worst = []
    for i in result.worst(_WORST):
        drawn = {"drawn": result.drawn[i]} if varied.varies_episodes else {}
        options = {"state": result.states[i], "constants": result.constants[i], **drawn}
        run = rollout(env, controller, seed=0, options=options)
        path = run.trajectory.save(folder / f"episode-{i}.npz")
        constants = dict(zip(env.task.constant_names, result.constants[i].tolist(), strict=True))
        start = {"start": result.states[i].tolist(), "constants": constants}
        worst.append(result.episode(i) | start | {"replay": shlex.join(["ballbot", "replay", str(path)])})
    env.close()
    return worst


def _print(result: Any, binned: Sequence[Any], worst: Sequence[dict[str, Any]]) -> None:
    row = result.summary()
    failed_by = ", ".join(f"{count} {name}" for name, count in row.failed_by.items())
    facts = [
        ["success [95 %]", f"{100 * row.success:.2f} % [{100 * row.success_low:.2f}, {100 * row.success_high:.2f}]"],
        [
            "failures per 10,000 [95 %]",
            f"{row.failures_per_10000:.1f} [{row.failures_per_10000_low:.1f}, {row.failures_per_10000_high:.1f}]"
            + (f" ({failed_by})" if failed_by else ""),
        ],
        [
            "cost: mean, median, 99th percentile, worst",
            f"{row.cost_mean:.2f}, {row.cost_median:.2f}, {row.cost_p99:.2f}, {row.cost_worst:.2f}",
        ],
    ]
    if row.optima:
        shares = (row.regret_mean, row.regret_median, row.regret_p99, row.regret_worst)
        facts.append([f"regret on {row.optima} optima, the same", ", ".join(f"{share:.2%}" for share in shares)])
    title = f"{result.policy}: {row.episodes} fresh episodes of {result.task.id}, seed {result.seed}"
    print_table(title, ["", ""], facts)
    weakest = sorted(
        (entry for entry in binned if entry.episodes >= _FULL_BIN and entry.success < 1),
        key=lambda entry: entry.success,
    )
    if weakest:
        header = ["range with the least success", "", "episodes", "success", "failures", "mean cost"]
        rows = [
            [
                entry.measure,
                f"{entry.low:.4g}" if entry.low == entry.high else f"{entry.low:.4g} to {entry.high:.4g}",
                f"{entry.episodes}",
                f"{entry.success:.1%}",
                f"{entry.failures}",
                f"{entry.cost_mean:.1f}",
            ]
            for entry in weakest[:_SHOWN_BINS]
        ]
        print_table("", header, rows)
    rows = [[str(entry["episode"]), entry["replay"], entry["failed"] or "–", f"{entry['cost']:.1f}"] for entry in worst]
    print_table("", ["worst", "look at it with", "failed", "cost"], rows)


def _certified(
    chosen: dict[str, list[str]], episodes: int, physics: str, out: Path, workers: Workers, robot: str
) -> None:
    settings = {"physics": physics, "episodes": episodes}
    facts = open_run(out, chosen, workers, policy_digests(chosen, robot), 0, robot, **settings)
    results = benchmark(chosen, episodes, physics, out, workers, robot=robot)
    rows = leaderboard(results)
    write_leaderboard(rows, results, facts, out)
    jobs.release(out)
    table = [cells(row) for row in rows]
    print_table(f"{episodes} certified episodes, physics={physics}", HEADER, table)
    console.print(f"all episodes: {out / 'episodes.csv'}")
