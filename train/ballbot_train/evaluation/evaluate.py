"""`evaluate(policy, task)`: the leaderboard row of anything that acts, on the certified episodes of a task.

Importing this module is light: torch is imported for policy files, CasADi for experts that plan, SciPy for intervals.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from ballbot_gym import certified
from ballbot_gym.env import BallbotEnv
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.registry import name_of
from ballbot_gym.robots import PAPER, robot_name
from ballbot_gym.tasks import Task
from ballbot_train.evaluation import optima, recordings
from ballbot_train.evaluation.controllers import as_controller, behind, policy_digest
from ballbot_train.evaluation.results import Result, Row, leaderboard, read_results, summarize, write_leaderboard
from ballbot_train.evaluation.runner import checked_episodes, run_episodes, shown_to
from ballbot_train.work.console import late_bar
from ballbot_train.work.executors import Workers
from ballbot_train.work.provenance import provenance

if TYPE_CHECKING:
    from ballbot_train.evaluation.fresh import FreshResult


@overload
def evaluate(
    policy: Any,
    task: str | Task = ...,
    episodes: int = ...,
    physics: str | None = ...,
    name: str | None = ...,
    randomization: Randomization | str | None = ...,
    robot: str | BallbotParams = ...,
    workers: int | Workers = ...,
    out: str | Path | None = ...,
    filter: str | None = ...,
    fresh: None = None,
) -> Row: ...


@overload
def evaluate(
    policy: Any,
    task: str | Task = ...,
    episodes: int = ...,
    physics: str | None = ...,
    name: str | None = ...,
    randomization: Randomization | str | None = ...,
    robot: str | BallbotParams = ...,
    workers: int | Workers = ...,
    out: str | Path | None = ...,
    filter: str | None = ...,
    *,
    fresh: int,
) -> "FreshResult": ...


def evaluate(
    policy: Any,
    task: str | Task = "stabilize",
    episodes: int = certified.EPISODES,
    physics: str | None = None,
    name: str | None = None,
    randomization: Randomization | str | None = None,
    robot: str | BallbotParams = PAPER,
    workers: int | Workers = 1,
    out: str | Path | None = None,
    filter: str | None = None,
    fresh: int | None = None,
) -> "Row | FreshResult":
    """The leaderboard row of anything that acts, on certified episodes; or, with `fresh`, what it does on fresh episodes.

    Where the package has no optima of the task and the robot, they are computed, and kept in the user's cache. On a
    terminal, a bar shows the episodes where they take longer than two seconds.

    Args:
        policy: see `as_controller`: a Stable-Baselines3 model, a function of the observation, a Controller, the name of a
            controller ("lqr", "trajopt", "nmpc") or a policy file.
        task: a name in `TASKS`, or any Task.
        episodes: how many of the certified episodes, from the first.
        physics: "bullet", "mujoco" or "rk4"; default, the first that is installed.
        name: of the row; default, the policy's own.
        randomization: what the policy is not told, or a name in `TRACKS`; default, nothing. The regret is over the optimum
            of each episode's own robot and delay, which a policy could only reach that knows them.
        robot: a name in `ROBOTS`, or any BallbotParams.
        workers: processes that compute optima; default, this one alone. Others import the main script, as `multiprocessing`
            does: what it does must be under `if __name__ == "__main__"`.
        out: folder for the results, as `ballbot benchmark` writes them; `ballbot compare` and `ballbot submit` read them.
            Rows of other policies and tasks that are there already stay.
        filter: the filter in front of the policy, "adaptive", "ekf" or "adaptive-ekf": the policy acts on what it estimates.
        fresh: instead of certified episodes, the number of fresh ones: then this is `evaluate_fresh`, in the batched
            closed-form model.

    Raises:
        TypeError, ValueError: no such policy, task, physics or episodes; or a randomization with an actuator that lags, under
            which no optimum is known.
        PlanError: an episode has no optimum that can be found.
    """
    if fresh is not None:
        from ballbot_train.evaluation.fresh import evaluate_fresh  # it imports torch

        if out is not None or physics not in (None, "rk4"):
            raise ValueError(
                "fresh episodes run in the batched closed-form model, and write no folder; leave out physics and out"
            )
        named_robot = robot if isinstance(robot, str) else robot_name(robot)
        policy = behind(str(policy), filter) if filter else policy
        return evaluate_fresh(policy, task, fresh, name=name, robot=named_robot, randomization=randomization)
    env = BallbotEnv(task, physics=physics, randomization=randomization, robot=robot)
    try:
        indices = range(checked_episodes(episodes))
        controller = as_controller(policy, env.task, env.params, filter)
        env = shown_to(controller, env)
        known = optima.known(env.task, env.params, indices, workers, env.randomization)
        named = name or behind(_name(policy), filter), name_of(env.task) or type(env.task).__name__.lower()
        motions: list[recordings.Recording] = []
        with late_bar("episodes", len(indices)) as advance:
            results = run_episodes(env, controller, *named, indices, 0, known, motions, advance)
        row = summarize(results)
        if out is not None:
            ran = {"physics": env.physics, "randomization": repr(env.randomization), "robot": repr(env.params)}
            facts = provenance() | ran
            results = [*_kept(Path(out), ran, row), *results]
            write_leaderboard(leaderboard(results), results, facts, Path(out))
            if env.params.wheels is None and not env.randomization.active:
                digest = policy_digest(str(policy), env.task, env.params) if isinstance(policy, str | Path) else ""
                who = env.physics, named[0], digest
                recordings.write_in(Path(out), motions, env.task, named[1], env.params, *who)
        return row
    finally:
        env.close()


def _kept(out: Path, ran: dict[str, Any], row: Row) -> list[Result]:
    """The results in a folder that stay when a row is written there: those of other tasks and controllers.

    Raises:
        ValueError: they are of another engine, robot or randomization, or damaged.
    """
    if not (out / "leaderboard.json").exists():
        return []
    from ballbot_train.work import jobs  # it needs the library of locks

    about, results = read_results(out)
    jobs.check_same({key: about.get(key) for key in ran}, ran, out, "results")
    return [result for result in results if (result.task, result.controller) != (row.task, row.controller)]


def _name(policy: Any) -> str:
    if isinstance(policy, str | Path):
        path = Path(policy)
        return f"{path.parent.name}/{path.name}" if path.parent.name else path.name  # a run's folder tells its policy
    return getattr(policy, "__name__", type(policy).__name__.lower())
