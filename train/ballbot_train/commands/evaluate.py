"""`ballbot evaluate POLICY`: one controller on the certified episodes, or on thousands of fresh ones."""

import shlex
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ballbot_gym import certified, files
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.registry import own_robot
from ballbot_gym.robot import PAPER, Randomization, file_name
from ballbot_gym.rollout import rollout
from ballbot_train.commands.options import Filter, WorkersOption
from ballbot_train.evaluation.controllers import ControllerName, controllers_of, policy_digests
from ballbot_train.evaluation.names import file_part
from ballbot_train.evaluation.results import TABLE, leaderboard
from ballbot_train.evaluation.runner import Group, MeasuredRun, checked_episodes
from ballbot_train.work import jobs
from ballbot_train.work.console import (
    Physics,
    RobotName,
    check_least,
    console,
    physics_or_default,
    print_table,
    progress_bars,
)
from ballbot_train.work.executors import Workers
from ballbot_train.work.provenance import provenance

_OPTIMA = 100  # fresh episodes whose regret is shown unless another number is given
_WORST = 10
_SHOWN_BINS = 6
_FULL_BIN = 20  # a bin with fewer episodes is not called weak


def evaluate(
    policy: str,
    /,
    task: str | None = None,
    episodes: int = certified.EPISODES,
    fresh: int | None = None,
    physics: Physics | None = None,
    seed: int = 0,
    optima: int | None = None,
    adversarial: bool = False,
    out: Path | None = None,
    workers: WorkersOption = Workers(),
    robot: RobotName = PAPER,
    randomization: str | None = None,
    filter: Filter | None = None,
) -> None:
    """Runs a controller on the certified episodes; or with --fresh on thousands of fresh ones, to find rare failures.

    Args:
        policy: a policy file, a model saved by Stable-Baselines3 (.zip), or the name of a controller that comes
            with the package.
        task: name of the task; default, the one that the file of the policy names or whose observations fit, else stabilize.
        episodes: number of certified episodes, from the first.
        fresh: number of fresh episodes to run instead of certified ones, all at once in the batched closed-form model.
        physics: engine for certified episodes, "bullet", "mujoco" or "rk4"; default, the first that is installed.
        seed: seed of the fresh episodes; or of the bootstrap intervals, and of noise and pushes in certified episodes.
        optima: number of fresh episodes, from the first, for which the optimum is computed too, so that they have a regret;
            default 100, or none if --randomization varies what optima depend on. Optima are stored in the user's cache
            folder, for later calls and other policies.
        adversarial: search for worse starts, too, from the 1,000 hardest of the fresh episodes.
        out: folder of the results; default runs/evaluate/TASK-POLICY, with the robot's name if that is not paper.
        workers: where episodes run and optima are computed.
        robot: name of the robot, with its episodes; default, the robot that the task names.
        randomization: name of a track, whose robots, delays and sensor errors are hidden from the policy.
        filter: filter in front of the policy: it estimates the robot, the delay, or the state from sensors.
    """
    varied = Randomization.checked(randomization)
    robot = robot if task is None else own_robot(task, robot)
    task, policy = ControllerName(policy).task(task, robot), ControllerName(policy).behind(filter).text
    chosen = controllers_of([task], [policy], [robot])
    check_least(0, optima=optima or 0)
    named = f"{task}-{file_part(policy)}" + (f"+{randomization}" if randomization else "")
    out = Path("runs") / "evaluate" / file_name(named, robot) if out is None else out
    if fresh is not None:
        if physics not in (None, "rk4"):
            raise ValueError("fresh episodes run in the batched closed-form model; leave out --physics")
        if optima is None:
            optima = 0 if varied.moves_optima else min(_OPTIMA, fresh)
        _evaluate_fresh(policy, task, fresh, seed, optima, adversarial, out, workers, robot, varied)
        return
    if adversarial:
        raise ValueError("a search for hard starts begins at fresh episodes; give --fresh with --adversarial")
    if optima:
        raise ValueError("certified episodes already have optima; give --optima with --fresh")
    engine, count = physics_or_default(physics, robot), checked_episodes(episodes)
    settings = {"physics": engine, "episodes": count, "seed": seed}
    settings |= {"tracks": [randomization]} if randomization else {}
    run = MeasuredRun.open(out, workers, chosen, robot, **settings)
    group = Group(task, policy, engine, robot, randomization=varied, own_optima=True)
    results = run.measure([group], count, seed, record=not varied.active)
    rows = leaderboard(results, seed)
    title = f"{count} certified episodes of {task}, physics={engine}"
    run.publish("leaderboard", title, TABLE, rows, results)
    console.print(f"all episodes: {out / 'episodes.csv'}")


def _evaluate_fresh(
    policy: str,
    task: str,
    count: int,
    seed: int,
    optima: int,
    adversarial: bool,
    out: Path,
    workers: Workers,
    robot: str,
    varied: Randomization,
) -> None:
    """A policy on fresh episodes: failures, success and cost by what makes episodes hard, and the worst ten."""
    from ballbot_train.evaluation import fresh as episodes  # it imports torch

    if optima > count:
        raise ValueError(f"optima must be at most the {count} fresh episodes, not {optima}")
    episodes.check_fresh(policy, make_task(task, robot), count, seed, robot)  # before anything is written
    if adversarial:
        from ballbot_train.evaluation.adversarial import check_searchable

        check_searchable(make_task(task, robot), varied)
    jobs.RunFolder(out).make()
    of = {"task": task, "policy": policy, "robot": robot, "randomization": varied.track}
    if (out / "fresh.json").exists():  # of the same policy they are replaced
        about = files.read_json(out / "fresh.json").get("about")
        held = {name: about.get(name, of[name]) for name in of} if isinstance(about, dict) else {}
        jobs.check_same(held, of, out, "results")
    facts = provenance() | {
        **of,
        "policies": policy_digests({robot: {task: [policy]}}, robot),
        "seed": seed,
        "episodes": count,
        "physics": "closed form, batched, float64",
    }
    with progress_bars({"episodes": count}) as advance:
        progress = partial(advance, "episodes")
        result = episodes.evaluate_fresh(policy, task, count, seed, None, progress, robot, varied, workers)
    if optima:
        result = result.with_optima(optima, workers)
    worst = _worst(result, policy, task, out / "worst", robot, varied)
    result.write(worst, facts, out)
    _print(result, worst)
    console.print(f"all episodes: {out / 'fresh.csv'}\nthe worst: {out / 'worst.csv'}")
    if adversarial:
        _search(result, policy, task, out, workers, robot)


def _search(result: Any, policy: str, task: str, out: Path, workers: Workers, robot: str) -> None:
    """Searches for worse starts than the fresh episodes have, and writes them all, and the motions of the worst ten."""
    from ballbot_train.evaluation import adversarial

    with progress_bars({"searches": min(adversarial.SEARCHES, len(result))}) as advance:
        began, ended = adversarial.hard_starts(policy, result, workers, partial(advance, "searches"))
    columns = {
        "success": ended.success,
        "failure": ended.failure,
        "cost": ended.costs,
        "optimum": ended.optima,
        "regret": ended.regrets,
        "regret_before": began.regrets,
    }
    numbers = {name: values.tolist() for name, values in columns.items()}
    numbers |= {f"x{k}": values.tolist() for k, values in enumerate(ended.states.T)}
    numbers |= dict(zip(result.task.constant_names, ended.constants.T.tolist(), strict=True))
    lines = [dict(zip(numbers, values, strict=True)) for values in zip(*numbers.values(), strict=True)]
    files.write_csv(out / "adversarial.csv", lines)
    shown, rows = range(len(lines))[:_WORST], []
    for i, command in enumerate(_motions("start", shown, ended, policy, task, out / "adversarial", robot)):
        end = "fails" if ended.failure[i] else f"{ended.regrets[i]:.1%}" if ended.success[i] else "goal missed"
        rows.append([str(i), command, end, f"{ended.costs[i]:.1f}"])
    failed, missed = int(ended.failure.sum()), int((~ended.success & ~ended.failure).sum())
    title = f"{len(lines)} searches for hard starts: {failed} ended in a failure, {missed} in a missed goal"
    print_table(title, ["start", "look at it with", "regret", "cost"], rows)
    console.print(f"where all searches ended: {out / 'adversarial.csv'}")


def _worst(
    result: Any, policy: str, task: str, folder: Path, robot: str, varied: Randomization
) -> list[dict[str, Any]]:
    """The worst episodes, each with its trajectory in a file that `ballbot replay` draws."""
    numbers, worst = result.worst(_WORST), []
    commands = _motions("episode", numbers, result, policy, task, folder, robot, varied)
    for i, command in zip(numbers, commands, strict=True):
        constants = dict(zip(result.task.constant_names, result.constants[i].tolist(), strict=True))
        start = {"start": result.states[i].tolist(), "constants": constants}
        worst.append(result.episode(i) | start | {"replay": command})
    return worst


def _motions(
    kind: str,
    numbers: Sequence[int],
    starts: Any,
    policy: str,
    task: str,
    folder: Path,
    robot: str,
    varied: Randomization = Randomization(),
) -> list[str]:
    """Runs some of many starts once more, and writes each trajectory to KIND-NUMBER.npz.

    Args:
        kind: what the files begin with.
        numbers: of the starts.
        starts: their states and constants, and with a randomization what was drawn.
        policy: with `task`, `robot` and `varied`, what runs.
        folder: of the files.

    Returns:
        The commands that show them.
    """
    env = BallbotEnv(task, physics="rk4", robot=robot, randomization=varied)
    controller = ControllerName(policy).make(env.task, env.params)
    for stale in folder.glob(f"{kind}-*.npz"):  # of an earlier run of the command
        stale.unlink()
    commands = []
    for i in numbers:
        drawn = {"drawn": starts.drawn[i]} if varied.varies_episodes else {}
        options = {"state": starts.states[i], "constants": starts.constants[i], **drawn}
        path = rollout(env, controller, seed=0, options=options).trajectory.save(folder / f"{kind}-{i}.npz")
        commands.append(shlex.join(["ballbot", "replay", str(path)]))
    env.close()
    return commands


def _print(result: Any, worst: Sequence[dict[str, Any]]) -> None:
    row = result.summary()
    failed_by = ", ".join(f"{count} {name}" for name, count in row.failed_by.items())
    facts = [
        ["success [95 %]", f"{100 * row.success:.2f} % [{100 * row.success_low:.2f}, {100 * row.success_high:.2f}]"],
        *([["in the goal or near it", f"{100 * row.near:.2f} %"]] if row.near > row.success else []),
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
    title = f"{result.policy}: {row.episodes} fresh episodes of {result.task.id}, seed {result.seed}, physics=rk4"
    print_table(title, ["", ""], facts)
    weak = [entry for entry in result.bins() if entry["episodes"] >= _FULL_BIN and entry["success"] < 1]
    rows = [
        {
            "range with the least success": entry["measure"],
            "": f"{entry['low']:.4g} to {entry['high']:.4g}",
            "episodes": f"{entry['episodes']}",
            "success": f"{entry['success']:.1%}",
            "failures": f"{entry['failures']}",
            "mean cost": f"{entry['cost_mean']:.1f}",
        }
        for entry in sorted(weak, key=lambda entry: entry["success"])[:_SHOWN_BINS]
    ]
    if rows:
        print_table("", [*rows[0]], [[*row.values()] for row in rows])
    rows = [[str(entry["episode"]), entry["replay"], entry["failed"] or "–", f"{entry['cost']:.1f}"] for entry in worst]
    print_table("", ["worst", "look at it with", "failed", "cost"], rows)
