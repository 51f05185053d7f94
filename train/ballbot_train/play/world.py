"""What is played: a task, a robot and the controllers that can be chosen, and what a user changes of them."""

import contextlib
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ballbot_gym import certified
from ballbot_gym.env import make_task
from ballbot_gym.randomization import Randomization
from ballbot_gym.robots import ROBOTS, named_robot
from ballbot_gym.tasks import TASKS, Task
from ballbot_train.console import check_names
from ballbot_train.evaluation.controllers import is_expert, is_made_for, is_saved_model, names
from ballbot_train.evaluation.robustness import STRESSES
from ballbot_train.policy_files import BEST, PolicyError, shipped_policies


class Span(NamedTuple):
    """What a slider allows."""

    label: str
    low: float
    high: float
    step: float


PLANT: dict[str, Span] = {
    "mass": Span("Masses, %", -50.0, 100.0, 5.0),
    "com": Span("Centre of mass, %", -30.0, 50.0, 5.0),
    "delay": Span("Delay, ms", 0.0, 120.0, 20.0),
    "lag": Span("Lag, ms", 0.0, 100.0, 5.0),
    "noise": Span("Sensor noise, ×", 0.0, 5.0, 0.25),
    "push": Span("Random pushes on the ball, N·s", 0.0, 12.0, 0.5),
}
"""What the controllers do not know, by the name of the stress in `robustness.STRESSES`. 0 is nothing."""


class World:
    """A task for a robot. Whatever is unknown or out of bounds is refused with a ValueError and changes nothing."""

    def __init__(self, task: str, robot: str):
        """A task and a robot by name."""
        check_names("task", [task], TASKS)
        check_names("robot", [robot], ROBOTS)
        self.task_name, self.robot, self.params = task, robot, named_robot(robot)
        if self.params.wheels is not None:
            raise ValueError(f"the playground knows no robot with wheels, as {robot}; watch it with ballbot replay")
        self.task: Task = make_task(task, robot)
        self.policies: list[str] = []
        self.controllers: list[str] = []
        """What can be chosen, experts first."""
        self.certified: certified.EvaluationSet | None = None
        with contextlib.suppress(certified.CertificateError):
            self.certified = certified.load(self.task, robot)
        self.offer()

    @property
    def episodes(self) -> int:
        """How many certified episodes there are."""
        return 0 if self.certified is None else len(self.certified)

    @property
    def best(self) -> str:
        """The controller to begin with: the shipped policy with the least regret, or else NMPC."""
        name = BEST.get(self.task_name, "")
        return name if name in shipped_policies(self.task, self.robot) else "nmpc"

    def offer(self, *policies: str) -> None:
        """Has more policy files be chosen, if they are made for the task and the robot."""
        self.policies = list(dict.fromkeys([*self.policies, *policies]))
        own = []
        for policy in self.policies:
            with contextlib.suppress(PolicyError):  # a file that is gone by now
                own += [policy] * is_made_for(policy, self.task, self.robot)
        known = names(self.task, self.robot)
        experts = [name for name in known if is_expert(name)]
        self.controllers = [
            *experts,
            "nmpc-offset-free",
            *(name for name in known if name not in experts),
            *own,
        ]

    def check_controllers(self, *wanted: str) -> None:
        """Refuses what no controller is called. What is in a policy file is found out when it is loaded."""
        for name in wanted:
            readable = is_saved_model(name) or Path(name).suffix in (".json", ".safetensors")
            if name not in self.controllers and not (readable and Path(name).is_file()):
                raise ValueError(
                    f"unknown controller {name!r}; {self.task.id} has {', '.join(self.controllers)}, or give a policy's "
                    ".json, or a model saved by Stable-Baselines3 (.zip)"
                )

    def certified_start(self, episode: int) -> tuple[np.ndarray, np.ndarray]:
        """The state (8,) and the constants (nc,) with which a certified episode begins."""
        if self.certified is None:
            raise ValueError(f"{self.task_name} has no certified episodes for {self.robot}; begin a random one")
        if not 0 <= episode < self.episodes:
            raise ValueError(f"episode must be 0 to {self.episodes - 1}, not {episode}")
        return self.certified.states[episode], self.certified.constants[episode]


def severity(stress: str, value: float) -> float:
    """The severity that a slider gives a stress; a ValueError for an unknown one, or a value outside of its `Span`."""
    check_names("change", [stress], PLANT)
    span = PLANT[stress]
    if not span.low <= value <= span.high:
        raise ValueError(f"{stress} must be {span.low:g} to {span.high:g}, not {value:g}")
    return span.step * round(value / span.step)


def randomization(severities: Mapping[str, float]) -> Randomization:
    """All hidden changes together: of each stress the fields that it changes."""
    changes = [STRESSES[stress].at(value) for stress, value in severities.items() if value]
    changed = {f.name: value for each in changes for f in fields(each) if (value := getattr(each, f.name)) != f.default}
    return replace(Randomization(), **changed)
