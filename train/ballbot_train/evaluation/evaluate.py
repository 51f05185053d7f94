"""`evaluate(policy, task)`: measures any policy or controller on the certified episodes of a task.

Importing this module is fast: torch is imported only for policy files, CasADi for experts that plan, SciPy for intervals.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from ballbot_gym import certified
from ballbot_gym.env import BallbotEnv
from ballbot_gym.registry import name_of
from ballbot_gym.robot import PAPER, Randomization, Robot, registered_name
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.identity import problem_parts
from ballbot_train.evaluation import counterparts, optima
from ballbot_train.evaluation.controllers import ControllerName, as_controller
from ballbot_train.evaluation.recordings import Recording
from ballbot_train.evaluation.results import Result, Row, leaderboard, read_results, write_results
from ballbot_train.evaluation.runner import _showing, checked_episodes, run_episodes
from ballbot_train.work.console import progress_bars
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
    robot: str | Robot = ...,
    workers: int | Workers = ...,
    out: str | Path | None = ...,
    filter: str | None = ...,
    fresh: None = None,
) -> Row: ...


@overload
def evaluate(
    policy: Any,
    task: str | Task = ...,
    *,
    fresh: int,
    name: str | None = ...,
    randomization: Randomization | str | None = ...,
    robot: str | Robot = ...,
    filter: str | None = ...,
) -> "FreshResult": ...


def evaluate(
    policy: Any,
    task: str | Task = "stabilize",
    episodes: int = certified.EPISODES,
    physics: str | None = None,
    name: str | None = None,
    randomization: Randomization | str | None = None,
    robot: str | Robot = PAPER,
    workers: int | Workers = 1,
    out: str | Path | None = None,
    filter: str | None = None,
    fresh: int | None = None,
) -> "Row | FreshResult":
    """Measures any policy or controller on certified episodes, and returns its row; or, with `fresh`, on fresh episodes.

    If the package has no optima of the task and the robot, they are computed and stored in the user's cache. On a terminal,
    a progress bar appears if the episodes take longer than two seconds.

    Args:
        policy: see `as_controller`: a Stable-Baselines3 model, a function of the observation, a Controller, the name of a
            controller ("lqr", "trajopt", "nmpc") or a policy file.
        task: a name in `TASKS`, or any Task; or the id of a counterpart of a task, such as "Pendulum-v1" where the package
            `ballbot-classic` is installed: the policy then has the observations and actions of that environment.
        episodes: number of certified episodes, from the first.
        physics: "bullet", "mujoco" or "rk4"; default, the first that is installed.
        name: name of the row; default, the policy's own.
        randomization: parameters hidden from the policy, or a name in `TRACKS`; default, none. Regret is measured against
            the optimum of each episode's own robot and delay, although the policy does not get them.
        robot: a name in `ROBOTS`, or any Robot; on fresh episodes it must be registered.
        workers: number of processes that compute optima; default, this process only. Other processes import the main script,
            as in `multiprocessing`, so the script must do its work under `if __name__ == "__main__"`.
        out: folder for the results, as `ballbot benchmark` writes them; `ballbot compare` and `ballbot submit` read them.
            Rows of other policies and tasks that the folder already contains stay.
        filter: filter in front of the policy, "adaptive", "ekf" or "adaptive-ekf": the policy acts on its estimates.
        fresh: number of fresh episodes to run instead of certified ones. The result is then that of `evaluate_fresh`, in the
            batched closed-form model.

    Raises:
        TypeError, ValueError: no such policy, task, physics or episodes; or a randomization with an actuator that lags, under
            which no optimum is known.
        PlanError: an episode has no optimum that can be found.
    """
    if fresh is not None:
        if out is not None or physics not in (None, "rk4"):
            raise ValueError(
                "fresh episodes run in the batched closed-form model, and write no folder; leave out physics and out"
            )
        return _on_fresh(policy, task, fresh, name, randomization, robot, filter)
    env = BallbotEnv(task, physics=physics, randomization=randomization, robot=robot)
    try:
        indices = range(checked_episodes(episodes))
        acting = counterparts.translated(policy, task, env.task, env.params)
        controller = as_controller(acting, env.task, env.params, filter)
        policy = acting if isinstance(policy, str | Path) else policy  # others keep their own name
        env = _showing(env, controller)
        known = optima.known(env.task, env.params, indices, workers, env.randomization)
        written = ControllerName(str(policy)) if isinstance(policy, str | Path) else None
        file = str(Path(policy).absolute()) if written is not None and written.is_file else ""
        held = None if out is None else _Held.of(Path(out))
        on = name_of(env.task) or type(env.task).__name__.lower()
        named = name or ControllerName(_name(policy, file, on, held)).behind(filter).text, on
        motions: list[Recording] = []
        with progress_bars({"episodes": len(indices)}, late=True) as advance:
            results = run_episodes(env, controller, *named, indices, 0, known, motions, partial(advance, "episodes"))
        (row,) = leaderboard(results)
        if held is not None:
            learned = None if written is None else written.file(env.task, env.params)
            held.add(env, file, "" if learned is None else learned.weights_digest(), results, motions)
        return row
    finally:
        env.close()


def _on_fresh(
    policy: Any,
    task: str | Task,
    count: int,
    name: str | None,
    randomization: Randomization | str | None,
    robot: str | Robot,
    filter: str | None,
) -> "FreshResult":
    from ballbot_train.evaluation.fresh import evaluate_fresh  # it imports torch

    if filter and not isinstance(policy, str | Path):
        raise ValueError("on fresh episodes a filter needs a policy by name or file; give one, or leave out filter")
    policy = ControllerName(str(policy)).behind(filter).text if filter else policy
    robot = robot if isinstance(robot, str) else registered_name(robot)
    return evaluate_fresh(policy, task, count, name=name, robot=robot, randomization=randomization)


@dataclass(frozen=True)
class _Held:
    """What a folder of results holds before a row is added: its facts, and its episodes."""

    out: Path
    about: Mapping[str, Any]
    results: Sequence[Result]

    @classmethod
    def of(cls, out: Path) -> "_Held":
        return cls(out, *(read_results(out) if (out / "leaderboard.json").exists() else ({}, [])))

    def file(self, task: str, name: str) -> str | None:
        """The policy file of a row; None if there is no such row, or its file was not recorded."""
        return self.about.get("files", {}).get(f"{task}/{name}")

    def add(
        self,
        env: BallbotEnv,
        file: str,
        digest: str,
        new: Sequence[Result],
        motions: Sequence[Recording],
    ) -> None:
        """Writes the folder with the episodes of a new row, and what was done in them. Errors: see `_joined`.

        Args:
            env: in which the row was run.
            file: of its policy, or "".
            digest: of the weights of its policy, or "".
            new: the episodes of the row.
            motions: what was done in them.
        """
        task, name = new[0].task, new[0].controller
        ran = {"physics": env.physics, "randomization": repr(env.randomization), "robot": env.params.record()}
        more = {
            "problems": {task: problem_parts(env.task, env.params)},
            "policies": {f"{task}/{name}": digest} if digest else {},
            "files": {f"{task}/{name}": file} if file else {},
        }
        results, facts = self._joined(ran, more, new)
        write_results(leaderboard(results), results, provenance() | facts, self.out)
        if not env.randomization.active:
            ran_in = env.task, task, env.params, env.physics
            Recording.of_run(motions, *ran_in, name, digest).write_in(self.out)

    def _joined(
        self, ran: dict[str, Any], more: dict[str, dict[str, Any]], new: Sequence[Result]
    ) -> tuple[list[Result], dict[str, Any]]:
        """The results with those of a new row, and the facts of all of them. A row of the same policy is replaced.

        Args:
            ran: facts that are the same for all rows.
            more: facts by task, or by task and name, of the new row.
            new: the episodes of the new row.

        Raises:
            ValueError: the folder is of another engine, robot or randomization; of another problem of this name; or a row
                of another policy has this name.
        """
        out, task, name = self.out, new[0].task, new[0].controller
        if self.results:
            from ballbot_train.work import jobs  # it needs the library of locks

            jobs.check_same({key: self.about.get(key) for key in ran}, ran, out, "results")
            problems = {key: value for key, value in self.about.get("problems", {}).items() if key == task}
            jobs.check_same({"problems": problems}, {"problems": more["problems"] if problems else {}}, out, "results")
        row = [result for result in self.results if (result.task, result.controller) == (task, name)]
        costs = {result.episode: result.cost for result in row}
        held, file = self.file(task, name), more["files"].get(f"{task}/{name}")
        same = all(math.isclose(each.cost, costs.get(each.episode, each.cost), rel_tol=1e-6) for each in new)
        if row and not (held == file if held and file else same):
            raise ValueError(
                f"{out} holds a row {name!r} on {task} of another policy, or of an earlier version of this one; give this "
                "one another name, or another out"
            )
        facts = {key: {**self.about.get(key, {}), **value} for key, value in more.items()}
        return [*(result for result in self.results if result not in row), *new], ran | facts


def _name(policy: Any, file: str, task: str, held: _Held | None) -> str:
    """The policy's own name: of a file the folder and the file, and folders above where a row of another file has that."""
    if not isinstance(policy, str | Path):
        return getattr(policy, "__name__", type(policy).__name__.lower())
    if not file:
        return str(policy)
    parts = Path(policy).absolute().parts if len(Path(policy).parts) > 1 else Path(policy).parts
    names = [
        str(Path(*parts[-n:])) for n in range(min(2, len(parts)), len(parts) + 1)
    ]  # the folder of a run identifies its policy
    free = (name for name in names if held is None or held.file(task, name) in (None, file))
    return next(free, names[-1])
