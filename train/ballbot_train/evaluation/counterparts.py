"""Environments of other packages that pose the very problem of a task: their policies, and their regret.

A task names such an environment as its `counterpart`. Both draw the same episodes for the same seed, and return + cost =
`survival_pay` in both.
"""

import hashlib
import json
from functools import lru_cache
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium
import numpy as np

from ballbot_gym import certified, files
from ballbot_gym.certified import cache
from ballbot_gym.env import BallbotEnv, make_task, robot_of
from ballbot_gym.registry import named_task
from ballbot_gym.robot import Robot
from ballbot_gym.rollout import ActionController, PlanError
from ballbot_gym.tasks import TASKS, Task
from ballbot_train.evaluation import controllers


class RegretWrapper(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """Adds the regret to the `info` of an episode's last step, with the return of the optimum from the same start.

    It wraps an environment of this package, or a `counterpart` of a task, such as Gymnasium's "Pendulum-v1" if the package
    `ballbot-classic` is installed. Put it inside of wrappers that change rewards, such as `NormalizeReward`.

    | key | meaning |
    |---|---|
    | optimum | the return of the optimum |
    | gap | optimum − return |
    | regret | cost / cost of the optimum − 1, as everywhere in this package, where return + cost is `Task.survival_pay` |

    The optima of starts that are not in the certified set are computed at the end of the episode, which takes from
    milliseconds to a few seconds, and are kept in the user's cache. Where no optimum is found, the values are NaN.
    """

    def __init__(self, env: gymnasium.Env, task: str | Task | None = None):
        """Wraps an environment.

        Args:
            env: with or without other wrappers that keep rewards.
            task: the problem; default, the task that has the id of the environment, or that id as its `counterpart`.

        Raises:
            ValueError: no task has this id.
        """
        gymnasium.utils.RecordConstructorArgs.__init__(self, task=task)
        gymnasium.Wrapper.__init__(self, env)
        bare = env.unwrapped
        if isinstance(bare, BallbotEnv):
            self._task, self._robot = bare.task, bare.params
        else:
            name = task if task is not None else getattr(env.spec, "id", None)
            self._task = make_task(named_task(name)) if not isinstance(name, Task) else name
            self._robot = robot_of(self._task)
        self._start: tuple[np.ndarray, np.ndarray] | None = None
        self._return = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        bare, self._return = self.env.unwrapped, 0.0
        if isinstance(bare, BallbotEnv):
            self._start = info["state"], info["constants"]
        else:
            self._start = self._task.counterpart_state(bare)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._return += float(reward)
        if (terminated or truncated) and self._start is not None:
            start = (np.asarray(part, np.float64).tobytes() for part in self._start)
            cost = _optimal_cost(self._task, self._robot, *start)
            best = self._task.survival_pay - cost
            gap = best - self._return
            info = {**info, "optimum": best, "gap": gap, "regret": gap / cost}
        return observation, reward, terminated, truncated, info


@lru_cache(maxsize=100_000)
def _optimal_cost(task: Task, params: Robot, x: bytes, c: bytes) -> float:
    """The cost of the optimum from state x (n,) with constants c (nc,), as bytes, from the user's cache or by `find_optimum`;
    NaN where none is found.
    """
    state, constants = np.frombuffer(x), np.frombuffer(c)
    known = _certified(task, params)
    if (cost := known.get((x, c))) is not None:
        return cost
    path = cache.folder(task, params) / "starts" / f"{hashlib.sha256(x + c).hexdigest()[:24]}.json"
    if path.exists():
        return float(files.read_json(path)["cost"])
    from ballbot_baselines import find_optimum  # it imports CasADi

    try:
        found = find_optimum(task, params, state, constants)
    except PlanError:
        return np.nan
    if not found.is_optimal:
        return np.nan
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write(path, json.dumps({"state": state.tolist(), "constants": constants.tolist(), "cost": found.cost}))
    return found.cost


@lru_cache(maxsize=8)
def _certified(task: Task, params: Robot) -> dict[tuple[bytes, bytes], float]:
    """The costs of the certified set by state and constants, if the package of the task has one."""
    try:
        found = certified.load(task, params)
    except (certified.CertificateError, ValueError):
        return {}
    rows = zip(found.states, found.constants, found.costs, strict=True)
    return {(x.tobytes(), c.tobytes()): float(cost) for x, c, cost in rows}


def translated(policy: Any, named: str | Task, task: Task, params: Robot) -> Any:
    """A policy for a counterpart as one for the task: a function of the observation whose actions are in [−1, 1].

    Args:
        policy: a model with `predict` that was trained on the counterpart, a function from its observations to its actions,
            or a model saved by Stable-Baselines3. Controllers, and other names, are returned as they are.
        named: how the task was named: by the id of its counterpart, or else the policy is returned as it is.
        task: the same as an object.
        params: its robot.

    Raises:
        ValueError: a model was trained in other spaces than those of the counterpart.
    """
    if not isinstance(named, str) or all(named != kind.counterpart for kind in TASKS.values()):
        return policy
    env = gymnasium.make(named)
    own: Any = env.observation_space, env.action_space
    high = own[1].high
    env.close()
    if isinstance(policy, str | Path):
        if Path(policy).suffix != ".zip":
            return policy
        from ballbot_train.policy.network import PolicyController  # it imports torch
        from ballbot_train.policy.saved_models import SavedModel

        return PolicyController(task, params, SavedModel.read(policy).actor(task, params, own))
    if callable(getattr(policy, "act", None)):
        return policy
    if not callable(getattr(policy, "predict", None)):
        return lambda observation: np.asarray(policy(observation), np.float64) / high
    predictor = controllers.Predictor(policy, task, params, own)
    return ActionController(task, params, lambda observation, begins: predictor(observation, begins) / high)
