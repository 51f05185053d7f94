"""`evaluate(policy, task)`: the leaderboard row of anything that acts, on the certified episodes of a task.

Importing this module is light: torch is imported for policy files, CasADi for experts that plan, SciPy for intervals.
"""

import math
import numbers
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from ballbot_gym import certified, seeding
from ballbot_gym.env import BallbotEnv
from ballbot_gym.identity import problem_parts
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.registry import name_of
from ballbot_gym.robots import PAPER
from ballbot_gym.rollout import ActionController, Controller, PlanError, rollout
from ballbot_gym.tasks import Task
from ballbot_train.console import late_bar
from ballbot_train.evaluation import optima, recordings
from ballbot_train.evaluation.controllers import is_file, make_controller, policy_digest
from ballbot_train.evaluation.results import Result, Row, leaderboard, read_results, summarize, write_leaderboard
from ballbot_train.executors import Workers
from ballbot_train.policy_files import PolicyError
from ballbot_train.provenance import provenance


def as_controller(policy: Any, task: Task, params: BallbotParams) -> Controller:
    """Anything that acts, as a Controller.

    Args:
        policy: a Controller; a Stable-Baselines3 model that was trained in the env's own spaces, whose VecNormalize is
            applied where it was trained with one; a function from observation (no,) float32 to action (2,) in [−1, 1]; or a
            name or file for `make_controller`.
        task: what it is to do.
        params: the robot that it believes to control.

    Raises:
        TypeError: it is none of these.
        ValueError, PolicyError: as `make_controller`; or the model was trained in other spaces than the env's.
    """
    if isinstance(policy, str | Path):
        return make_controller(str(policy), task, params)
    if callable(getattr(policy, "reset", None)) and callable(getattr(policy, "act", None)):
        return policy
    if callable(getattr(policy, "predict", None)):
        predictor = Predictor(policy, task, params)
        return ActionController(task, params, predictor, predictor.history)
    if callable(policy):
        function = cast(Callable[[np.ndarray], np.ndarray], policy)
        return ActionController(task, params, lambda observation, begins: function(observation))
    raise TypeError(
        f"{policy!r} is no policy: give a Controller, a model with predict, a function of the observation, a name or a file"
    )


class Predictor:
    """An SB3 model's deterministic actions (..., 2) for observations (..., no) of an episode, or of one episode per env.

    It keeps the recurrent state, and normalizes observations as in training.
    """

    def __init__(self, model: Any, task: Task, params: BallbotParams):
        self._model, self._state, self.history = model, None, 0
        if hasattr(model, "observation_space"):
            from ballbot_train.saved_models import check_spaces, history_of  # it imports torch

            self.history = history_of(model, task, params)
            check_spaces(type(model).__name__, model, task, params)
        normalization = getattr(model, "get_vec_normalize_env", lambda: None)()
        # only on-policy algorithms leave this empty where there was no VecNormalize
        if normalization is None and hasattr(model, "gae_lambda") and model._last_original_obs is not None:
            raise PolicyError(
                f"{type(model).__name__} was trained with VecNormalize and has none now; load the model with it: "
                f'{type(model).__name__}.load("model.zip", env=VecNormalize.load("vecnormalize.pkl", venv))'
            )
        self._seen = (lambda observation: observation) if normalization is None else normalization.normalize_obs

    def __call__(self, observation: np.ndarray, begins: bool) -> np.ndarray:
        action, self._state = self._model.predict(
            self._seen(observation),
            state=None if begins else self._state,
            episode_start=np.full(len(np.atleast_2d(observation)), begins),
            deterministic=True,
        )
        return action


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
) -> Row:
    """The leaderboard row of anything that acts.

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

    Raises:
        TypeError, ValueError: no such policy, task, physics or episodes; or a randomization with an actuator that lags, under
            which no optimum is known.
        PlanError: an episode has no optimum that can be found.
    """
    env = BallbotEnv(task, physics=physics, randomization=randomization, robot=robot)
    try:
        indices = range(checked_episodes(episodes))
        controller = as_controller(policy, env.task, env.params)
        env = shown_to(controller, env)
        known = optima.known(env.task, env.params, indices, workers, env.randomization)
        file = str(Path(policy).absolute()) if isinstance(policy, str | Path) and is_file(str(policy)) else ""
        held = None if out is None else _Held.of(Path(out))
        on = name_of(env.task) or type(env.task).__name__.lower()
        named = name or _name(policy, file, on, held), on
        motions: list[recordings.Recording] = []
        with late_bar("episodes", len(indices)) as advance:
            results = run_episodes(env, controller, *named, indices, 0, known, motions, advance)
        row = summarize(results)
        if out is not None and held is not None:
            ran = {"physics": env.physics, "randomization": repr(env.randomization), "robot": repr(env.params)}
            digest = policy_digest(str(policy), env.task, env.params) if isinstance(policy, str | Path) else ""
            key, problem = f"{on}/{named[0]}", {on: problem_parts(env.task, env.params)}
            more = {
                "problems": problem,
                "policies": {key: digest} if digest else {},
                "files": {key: file} if file else {},
            }
            results, facts = held.joined(Path(out), ran, more, results)
            write_leaderboard(leaderboard(results), results, provenance() | facts, Path(out))
            if env.params.wheels is None and not env.randomization.active:
                who = env.physics, named[0], digest
                recordings.write_in(Path(out), motions, env.task, named[1], env.params, *who)
        return row
    finally:
        env.close()


@dataclass(frozen=True)
class _Held:
    """What a folder of results holds before a row is added: its facts, and its episodes."""

    about: Mapping[str, Any]
    results: Sequence[Result]

    @classmethod
    def of(cls, out: Path) -> "_Held":
        return cls(*(read_results(out) if (out / "leaderboard.json").exists() else ({}, [])))

    def file(self, task: str, name: str) -> str | None:
        """The policy file of a row; None where there is no such row, or nobody knows its file."""
        return self.about.get("files", {}).get(f"{task}/{name}")

    def joined(
        self, out: Path, ran: dict[str, Any], more: dict[str, dict[str, Any]], new: Sequence[Result]
    ) -> tuple[list[Result], dict[str, Any]]:
        """The results with those of a new row, and the facts of all of them. A row of the same policy is replaced.

        Args:
            out: the folder.
            ran: facts that are the same for all rows.
            more: facts by task, or by task and name, of the new row.
            new: the episodes of the new row.

        Raises:
            ValueError: the folder is of another engine, robot or randomization; of another problem of this name; or a row
                of another policy has this name.
        """
        task, name = new[0].task, new[0].controller
        if self.results:
            from ballbot_train import jobs  # it needs the library of locks

            jobs.check_same({key: self.about.get(key) for key in ran}, ran, out, "results")
            problems = {key: value for key, value in self.about.get("problems", {}).items() if key == task}
            jobs.check_same({"problems": problems}, {"problems": more["problems"] if problems else {}}, out, "results")
        row = [result for result in self.results if (result.task, result.controller) == (task, name)]
        costs = {result.episode: result.cost for result in row}
        held, file = self.file(task, name), more["files"].get(f"{task}/{name}")
        same = all(math.isclose(each.cost, costs.get(each.episode, each.cost), rel_tol=1e-6) for each in new)
        if row and not (held == file if held and file else same):
            raise ValueError(
                f"{out} holds a row {name!r} on {task} of another policy, or of this one as it was; give this one another "
                "name, or another out"
            )
        facts = {key: {**self.about.get(key, {}), **value} for key, value in more.items()}
        return [*(result for result in self.results if result not in row), *new], ran | facts


def shown_to(controller: Controller, env: BallbotEnv) -> BallbotEnv:
    """An env of the same world that shows what a controller takes: sensors, if it `senses`."""
    if not getattr(controller, "senses", False):
        return env
    env.close()
    return BallbotEnv(env.task, env.physics, params=env.params, randomization=env.randomization, observation="sensors")


def checked_episodes(episodes: int) -> int:
    """A number of certified episodes; raises a ValueError where there are not so many."""
    if isinstance(episodes, bool) or not isinstance(episodes, numbers.Integral):
        raise TypeError(f"episodes must be a number of episodes, not {episodes!r}")
    if not 1 <= episodes <= certified.EPISODES:
        raise ValueError(f"episodes must be 1 to {certified.EPISODES}, not {episodes}")
    return int(episodes)


def _name(policy: Any, file: str, task: str, held: _Held | None) -> str:
    """The policy's own name: of a file the folder and the file, and folders above where a row of another file has that."""
    if not isinstance(policy, str | Path):
        return getattr(policy, "__name__", type(policy).__name__.lower())
    if not file:
        return str(policy)
    parts = Path(policy).absolute().parts if len(Path(policy).parts) > 1 else Path(policy).parts
    names = [
        str(Path(*parts[-n:])) for n in range(min(2, len(parts)), len(parts) + 1)
    ]  # a run's folder tells its policy
    free = (name for name in names if held is None or held.file(task, name) in (None, file))
    return next(free, names[-1])


def run_episodes(
    env: BallbotEnv,
    controller: Controller,
    name: str,
    task: str,
    episodes: Iterable[int],
    seed: int = 0,
    known: certified.EvaluationSet | None = None,
    motions: list[recordings.Recording] | None = None,
    advance: Callable[[int], None] = lambda count: None,
) -> list[Result]:
    """Runs certified episodes under any controller; one that finds no plan has failed the episode. torch computes on one
    thread meanwhile.

    Args:
        env: what to run in.
        controller: what acts.
        name: of the controller, in the results.
        task: the task's name, in the results.
        episodes: their indices.
        seed: of what the env's randomization draws; no two seeds share what an episode draws.
        known: the optima; default, those of the env's task, robot and randomization.
        motions: gets what was done in each episode.
        advance: is called with 1 after each episode.

    Raises:
        PlanError: an episode has no optimum that can be found.
    """
    indices, results = list(episodes), []
    if known is None:
        known = optima.known(env.task, env.params, indices, randomization=env.randomization)
    for i in indices:
        run = None
        try:
            with _one_thread():
                run = rollout(env, controller, seed=seeding.of_episode(seed, i), options=known.options(i))
        except PlanError as error:
            measures: dict[str, Any] = {"cost": env.task.survival_pay, "note": str(error)}
            measures |= {"success": False, "failure": True}
        else:
            measures = {
                "cost": run.cost,
                "success": run.success,
                "failure": run.failure,
                "peak_tilt": math.degrees(run.peak_tilt),
                "settle_time": run.settle_time,
                "duration": run.trajectory.duration,
                "plan_seconds": run.reset_seconds,
                "step_seconds": run.act_seconds,
                "effort": float(np.hypot(*run.trajectory.u.T).mean()),
            }
        if motions is not None:
            motions.append(recordings.of_episode(None if run is None else run.trajectory, env.params))
        results.append(Result(task, name, i, env.physics, optimum=float(known.costs[i]), **measures))
        advance(1)
    return results


@contextmanager
def _one_thread() -> Iterator[None]:
    """torch, if it is imported, computes on one thread within the block: policies are too small for a second one, and threads
    that wait for each other at every control step make an episode ten times slower.
    """
    torch: Any = sys.modules.get("torch")
    if torch is None:
        yield
        return
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
