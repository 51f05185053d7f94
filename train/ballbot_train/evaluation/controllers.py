"""Controllers by name: experts of `CONTROLLERS`, policies that come with the package, policy files and saved models; and
anything else that acts, as a controller.
"""

import inspect
import itertools
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import numpy as np

from ballbot_gym.env import make_task
from ballbot_gym.robot import PAPER, ROBOTS, Robot, named_robot, robot_name
from ballbot_gym.rollout import ActionController, Controller
from ballbot_gym.tasks import TASKS, Task
from ballbot_train.policy.files import PolicyError, PolicyFile, shipped_policies
from ballbot_train.work.console import check_names

_SENSORS = "ekf"
"""The filter for robots with wheels: it estimates the state from sensor readings."""


def _experts() -> ModuleType:
    """The package of the experts. It is imported where they are asked for by name: who evaluates a function needs none."""
    import ballbot_baselines

    return ballbot_baselines


def _filters(params: Robot) -> tuple[str, ...]:
    """The filters that may stand in front of controllers of a robot."""
    return tuple(ending[1:] for ending in _experts().FILTERS) if params.TRACK_FILTERS else (_SENSORS,)


@dataclass(frozen=True)
class ControllerName:
    """What users write for a controller, and what it means: "apg-adaptive-ekf" is "apg" behind the filter "adaptive-ekf".

    Without its filter it is the name of an expert, in `CONTROLLERS` or `VARIANTS`, the name of a policy that comes with the
    package ("apg"), or the path of a policy file, of a training run's folder, or of a model that Stable-Baselines3 saved.
    """

    text: str

    @staticmethod
    def known(task: Task, robot: str = PAPER, track: str | None = "") -> list[str]:
        """The controllers that a task has for a robot, experts first; for `track` see `shipped_policies`."""
        return [*_experts().CONTROLLERS, *shipped_policies(task, robot, track)]

    @property
    def _ending(self) -> str:
        return next((ending for ending in _experts().FILTERS if self.text.endswith(ending)), "")

    @property
    def alone(self) -> str:
        """The name without its filter."""
        return self.text.removesuffix(self._ending)

    @property
    def filter(self) -> str:
        """The filter, or ""."""
        return self._ending[1:]

    def behind(self, filter: str | None) -> "ControllerName":
        """The same controller with a filter in front of it.

        Raises:
            ValueError: there is one in front of it already.
        """
        if filter and self.filter:
            raise ValueError(
                f"{self.text} has a filter in front of it already; leave out --filter, or write {self.alone}"
            )
        return ControllerName(f"{self.text}-{filter}") if filter else self

    @property
    def is_expert(self) -> bool:
        """Whether it is an expert or a variant, and no policy."""
        return self.alone in _experts().CONTROLLERS | _experts().VARIANTS

    @property
    def is_file(self) -> bool:
        """Whether it is the path of a policy file, of a run's folder with one, or of a saved model."""
        path = Path(self.alone)
        return not self.is_expert and (bool(path.suffix) or (path.name != self.alone and PolicyFile(path).is_run))

    @property
    def _is_saved_model(self) -> bool:
        """Whether it is the path of a model that Stable-Baselines3 saved."""
        return Path(self.alone).suffix == ".zip"

    def acts_in(self, task: Task, robot: str = PAPER) -> bool:
        """Whether a task has such a controller for a robot.

        Raises:
            PolicyError: see `_is_made_for`.
        """
        if self.is_file:
            return self._is_made_for(task, robot)
        fits = not self.filter or self.filter in _filters(named_robot(robot))
        return self.text in _experts().VARIANTS or (fits and self.alone in self.known(task, robot, None))

    def _is_made_for(self, task: Task, robot: str = PAPER) -> bool:
        """Whether the policy of a file is one for a task and a robot. A saved model is judged by its spaces alone.

        Raises:
            PolicyError: the file is missing or damaged, or a saved model has observations of the task's size in other spaces.
        """
        if self._is_saved_model:
            from ballbot_train.policy.saved_models import SavedModel  # it imports torch

            return SavedModel.read(self.alone).fits(task, named_robot(robot))
        spec = PolicyFile(self.alone).read()["spec"]
        return spec["task"] == task.problem() and spec.get("robot", PAPER) == robot

    @property
    def made_for(self) -> str:
        """What the policy of a file was made for, in words.

        Raises:
            PolicyError: the file is missing or damaged.
        """
        if self._is_saved_model:
            from ballbot_train.policy.saved_models import SavedModel

            return f"a task with {SavedModel.read(self.alone).observations} observations"
        spec = PolicyFile(self.alone).read()["spec"]
        robot = spec.get("robot", PAPER)
        return spec["task"] if robot == PAPER else f"{spec['task']} of the robot {robot}"

    def task(self, given: str | None, robot: str = PAPER) -> str:
        """The name of the task that is given, or else the registered one that a policy file was made for, or stabilize.

        Raises:
            ValueError: no such task.
            PolicyError: a policy file that is missing or damaged.
        """
        if given is not None:
            check_names("task", [given], TASKS)
            return given
        if not self.is_file:
            return "stabilize"
        named = next((name for name in TASKS if self._is_made_for(make_task(name, robot), robot)), None)
        if named is None:
            raise ValueError(
                f"{self.text} was made for {self.made_for}, which is none of {', '.join(TASKS)} with its default fields for "
                f"the robot {robot}; give --task, or another --robot"
            )
        return named

    def hint(self, task: Task) -> str:
        """What to type for a policy of a task that comes with the package for other robots; "" of another name."""
        robots = [robot for robot in ROBOTS if self.text in shipped_policies(task, robot, None)]
        if not robots:
            return ""
        plural = "s" if len(robots) > 1 else ""
        return (
            f"it was made for the robot{plural} {', '.join(robots)}: `ballbot transfer --made-for {robots[0]} "
            f"--controllers {self.text} --robot YOURS` runs it on yours"
        )

    def file(self, task: Task, robot: str | Robot = PAPER) -> PolicyFile | None:
        """The policy of a task that comes with the package, or that is named by its path; None of an expert."""
        if self.is_expert:
            return None
        shipped = shipped_policies(task, robot if isinstance(robot, str) else robot_name(robot), None)
        return PolicyFile(shipped.get(self.alone, self.alone))

    def path(self, task: Task, robot: str = PAPER) -> Path:
        """The file of a policy without a filter.

        Raises:
            ValueError: it is an expert, a saved model of another library, or nothing of that name.
        """
        shipped = shipped_policies(task, robot, None)
        if self.text in shipped:
            return shipped[self.text]
        if self.text in _experts().CONTROLLERS:
            raise ValueError(
                f"{self.text} is an expert, and no policy; give a policy's .json, or one of {', '.join(shipped)}"
            )
        if not self.is_file:
            raise ValueError(
                f"unknown policy {self.text!r}; {task.id} has {', '.join(shipped)}, or give a policy's .json"
            )
        if self._is_saved_model:
            raise ValueError(
                f"{self.text} is a saved model of another library; give a policy's .json, as `ballbot train` writes it"
            )
        return Path(self.text)

    def make(self, task: Task, params: Robot) -> Controller:
        """The controller. torch is imported only for a policy.

        Args:
            task: what it is to do.
            params: the robot that it is made for.

        Raises:
            ValueError: nothing of that name.
            PolicyError: a policy file that is damaged or of another task.
        """
        if self.text in _experts().VARIANTS and params.TRACK_FILTERS:
            return _experts().VARIANTS[self.text](task, params)
        controller, filter = ControllerName(self.alone)._unfiltered(task, params), self.filter
        if getattr(controller, "estimates", None) is not None:  # it needs an estimate of the robot
            filter = filter or "adaptive"
        return _filtered(controller, filter, task, params)

    def _unfiltered(self, task: Task, params: Robot) -> Controller:
        experts = _experts().CONTROLLERS | _experts().VARIANTS
        if self.text in experts:
            return experts[self.text](task, params)
        robot = robot_name(params)
        shipped = shipped_policies(task, robot, None)
        if self.text not in shipped and not self.is_file:
            known = f"{task.id} has {', '.join(self.known(task, robot))}, or give a policy's .json"
            raise ValueError(f"unknown controller {self.text!r}; {self.hint(task) or known}")
        if self._is_saved_model:
            from ballbot_train.policy.network import PolicyController  # it imports torch
            from ballbot_train.policy.saved_models import SavedModel

            return PolicyController(task, params, SavedModel.read(self.text).actor(task, params))
        from ballbot_train.policy.network import load_policy

        return load_policy(shipped.get(self.text, self.text), task, params)


def _filtered(controller: Controller, filter: str | None, task: Task, params: Robot) -> Controller:
    """A controller with one of `_filters` in front of it, or with none."""
    if not filter:
        return controller
    if filter not in _filters(params):
        known = ", ".join(_filters(params))
        raise ValueError(f"unknown filter {filter!r}; controllers of {robot_name(params)} can have {known}")
    from ballbot_baselines.feedback.adaptive import FilteredController  # it imports CasADi

    return FilteredController(task, params, f"-{filter}", controller)


def _senses(controller: Controller) -> bool:
    """Whether a controller takes the readings of sensors, and not states."""
    return getattr(controller, "senses", False)


def as_controller(policy: Any, task: Task, params: Robot, filter: str | None = None) -> Controller:
    """Any policy or controller as a Controller.

    Args:
        policy: a Controller; a Stable-Baselines3 model that was trained in the env's own spaces, whose VecNormalize is
            applied where it was trained with one; another object with `predict(observation)`, which returns an action or a
            tuple that begins with one; a torch module from observations (B, no) to actions (B, 2); a function from
            observation (no,) float32 to action (2,) in [−1, 1]; or a name or file, see `ControllerName`.
        task: what it is to do.
        params: the robot that it is made for.
        filter: name of a filter in front of it.

    Raises:
        TypeError: it is none of these.
        ValueError, PolicyError: as `ControllerName.make`; or the model was trained in other spaces than the env's.
    """
    if isinstance(policy, str | Path):
        return ControllerName(str(policy)).behind(filter).make(task, params)
    return _filtered(_acting(policy, task, params), filter, task, params)


def _acting(policy: Any, task: Task, params: Robot) -> Controller:
    if callable(getattr(policy, "reset", None)) and callable(getattr(policy, "act", None)):
        return policy
    if callable(getattr(policy, "predict", None)):
        predictor = Predictor(policy, task, params)
        return ActionController(task, params, predictor, predictor.history)
    torch: Any = sys.modules.get("torch")
    if torch is not None and isinstance(policy, torch.nn.Module):
        return ActionController(task, params, _module_actions(policy))
    if callable(policy):
        function = cast(Callable[[np.ndarray], np.ndarray], policy)
        return ActionController(task, params, lambda observation, begins: function(observation))
    raise TypeError(
        f"{policy!r} is not a policy: give a Controller, a model with predict, a torch module or a function of the "
        "observation, a name or a file"
    )


def _module_actions(module: Any) -> Callable[[np.ndarray, bool], np.ndarray]:
    """The actions of a torch module, which takes (B, no) observations on the device and in the precision of its numbers."""
    import torch

    first = next(module.parameters(), torch.zeros(0))

    def actions(observation: np.ndarray, begins: bool) -> np.ndarray:
        seen = torch.as_tensor(np.atleast_2d(observation), dtype=first.dtype, device=first.device)
        with torch.no_grad():
            made = module(seen)
        made = (made[0] if isinstance(made, tuple) else made).cpu().numpy()
        return made if observation.ndim > 1 else made[0]

    return actions


class Predictor:
    """The deterministic actions (..., 2) of an SB3 model, or of another object with `predict`.

    Observations (..., no) are of an episode, or of one episode per env.

    It keeps the recurrent state, and normalizes observations as in training.
    """

    def __init__(self, model: Any, task: Task, params: Robot, counterpart: Any = None):
        self._model, self._state, self.history = model, None, 0
        self._takes = _keywords(model.predict)
        if hasattr(model, "observation_space"):
            from ballbot_train.policy.saved_models import check_spaces  # it imports torch

            self.history = check_spaces(type(model).__name__, model, task, params, counterpart)
        normalization = getattr(model, "get_vec_normalize_env", lambda: None)()
        # only on-policy algorithms leave this empty where there was no VecNormalize
        if normalization is None and hasattr(model, "gae_lambda") and model._last_original_obs is not None:
            raise PolicyError(
                f"{type(model).__name__} was trained with VecNormalize and has none now; load the model with it: "
                f'{type(model).__name__}.load("model.zip", env=VecNormalize.load("vecnormalize.pkl", venv))'
            )
        self._seen = (lambda observation: observation) if normalization is None else normalization.normalize_obs

    def __call__(self, observation: np.ndarray, begins: bool) -> np.ndarray:
        offered = {
            "state": None if begins else self._state,
            "episode_start": np.full(len(np.atleast_2d(observation)), begins),
            "deterministic": True,
        }
        taken = {name: value for name, value in offered.items() if self._takes is None or name in self._takes}
        made = self._model.predict(self._seen(observation), **taken)
        action, self._state = (made[0], made[1] if len(made) > 1 else None) if isinstance(made, tuple) else (made, None)
        return action


def _keywords(function: Any) -> set[str] | None:
    """The keywords that a function takes; None where it takes any, or does not say."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return None
    return None if any(each.kind is each.VAR_KEYWORD for each in parameters) else {each.name for each in parameters}


def controllers_of(
    tasks: Sequence[str],
    given: Sequence[str] = (),
    robots: Sequence[str] = (PAPER,),
    filter: str | None = None,
    tracks: bool = False,
) -> dict[str, dict[str, list[str]]]:
    """The controllers to run, by the robot that they were made for and by task.

    A policy is made for one task and one robot, and is left out for the others. So are tasks without a controller.

    Args:
        tasks: names of tasks.
        given: names of controllers; default, all that tasks and robots have, but for variants.
        robots: by name.
        filter: in front of each of those given.
        tracks: whether policies that were trained on tracks are among the default.

    Raises:
        ValueError: a name that no task has for any of the robots, a name that is given twice, a filter without names, or no
            task.
        PolicyError: a policy file that is missing or damaged.
    """
    check_names("task", tasks, TASKS, least=1)
    if filter and not given:
        raise ValueError("--filter needs to know which controllers get the filter; give --controllers too")
    given = [ControllerName(name).behind(filter).text for name in given]
    track = None if tracks or given else ""
    known = {
        robot: {task: ControllerName.known(make_task(task, robot), robot, track) for task in tasks} for robot in robots
    }
    if not given:
        return known
    if repeated := [name for name, count in Counter(given).items() if count > 1]:
        raise ValueError(f"controller {', '.join(repeated)} is given more than once; give each once")
    chosen: dict[str, dict[str, list[str]]] = {}
    for robot, task in itertools.product(robots, tasks):
        if found := [name for name in given if ControllerName(name).acts_in(make_task(task, robot), robot)]:
            chosen.setdefault(robot, {})[task] = found
    used = {name for by_task in chosen.values() for group in by_task.values() for name in group}
    unused = [name for name in given if name not in used]
    if unused:
        name = ControllerName(unused[0])
        if name.is_file:
            raise ValueError(f"{name.text} was made for {name.made_for}, which is none of {', '.join(tasks)}")
        for task in tasks:
            if hint := name.hint(make_task(task, robots[0])):
                raise ValueError(f"unknown controller {name.text} for the robot {robots[0]}; {hint}")
    check_names("controller", unused, dict.fromkeys(name for group in known[robots[0]].values() for name in group))
    return chosen


def policy_digests(
    chosen: Mapping[str, Mapping[str, Sequence[str]]],
    robot: str = PAPER,
    of: Callable[[PolicyFile], str] = PolicyFile.weights_digest,
) -> dict[str, str]:
    """A digest of every learned policy under "TASK/NAME", or "ROBOT/TASK/NAME" of policies made for another robot.

    Args:
        chosen: controllers as `controllers_of` gives them.
        robot: on which they run, by name.
        of: which digest.
    """
    return {
        f"{task}/{name}" if made_for == robot else f"{made_for}/{task}/{name}": of(file)
        for made_for, by_task in chosen.items()
        for task, group in by_task.items()
        for name in group
        if (file := ControllerName(name).file(make_task(task, made_for), made_for)) is not None
    }
