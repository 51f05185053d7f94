"""Learning algorithms by name.

A new learner is one file and one entry of `LEARNERS`, which declares what the learner can do. Its file holds

- a frozen dataclass of `Settings` whose defaults suit any task, with a docstring under every field;
- `TUNED`, settings by name of task, and by "" for any other task; `WARM`, where they differ after a warm start;
- `make(task, params, settings, seed, ...)`, which returns the learner before its first iteration (see `training.Learner`).
  What the entry declares may be passed too, by name: demos, start, randomization, history, informed.
"""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ballbot_gym.lazy import load
from ballbot_gym.robot import Robot
from ballbot_gym.tasks import Task

if TYPE_CHECKING:
    from ballbot_gym.robot import Randomization
    from ballbot_train.learning.training import Learner
    from ballbot_train.policy.network import PolicyNetwork


@dataclass(frozen=True)
class Algorithm:
    """An entry of `LEARNERS`. The learner's file, and with it torch, is imported when one of the methods is called."""

    module: str
    """The file, as for an import."""
    description: str
    """One line for the command line."""
    demonstrations: bool = False
    """Whether it learns from demonstrations."""
    start: bool = False
    """Whether it trains on from a policy."""
    tracks: bool = False
    """Whether it trains where a randomization varies the robot, the delay or the sensors."""
    history: bool = False
    """Whether it trains policies that see earlier observations and actions."""
    informed: bool = False
    """Whether it trains policies that are given each robot's parameters, and run behind a filter."""
    clock: bool = False
    """Whether it trains tasks whose cost and goal depend on the time."""

    @property
    def name(self) -> str:
        return self.module.rpartition(".")[2]

    def settings(self, task: str, warm: bool = False) -> Any:
        """The settings tuned for a task, or those of any other task.

        Args:
            task: name of a task.
            warm: whether training starts from demonstrations or a policy.

        Returns:
            A frozen dataclass; `dataclasses.replace` changes some of its fields.
        """
        table = load(f"{self.module}:TUNED")
        if warm:
            table = getattr(import_module(self.module), "WARM", table)
        return table.get(task, table[""])

    def check(
        self,
        task: Task,
        params: Robot,
        demos: object = None,
        start: object = None,
        randomization: "Randomization | None" = None,
        history: int = 0,
        informed: bool = False,
    ) -> None:
        """Raises a ValueError if the learner does not support what is asked of it; for the arguments see `make`."""
        wanted = {
            "demonstrations": demos is not None,
            "start": start is not None,
            "tracks": randomization is not None,
            "history": history > 0,
            "informed": informed,
            "clock": task.clock,
        }
        for ability in (name for name, is_wanted in wanted.items() if is_wanted and not getattr(self, name)):
            able = [name for name, other in LEARNERS.items() if getattr(other, ability)]
            raise ValueError(f"{self.name} does not support {_WORDS[ability]}; train with {' or '.join(able)}")
        if demos is not None and start is not None:
            raise ValueError("training starts from demonstrations or from a policy; give one of --demos and --start")
        if informed and (randomization is None or not randomization.varies_robot):
            raise ValueError("an informed policy needs a track on which the robot varies; give --randomization unknown")

    def make(
        self,
        task: Task,
        params: Robot,
        settings: Any,
        seed: int,
        demos: str | Path | None = None,
        start: "PolicyNetwork | None" = None,
        randomization: "Randomization | None" = None,
        history: int = 0,
        informed: bool = False,
    ) -> "Learner":
        """Makes the learner.

        Args:
            task: to learn.
            params: the robot.
            settings: see `settings`.
            seed: of everything that the learner draws. Its envs get the one that `seeding.spawned` makes of it.
            demos: folder of a dataset of demonstrations, or None.
            start: a policy to train on from, or None; it may be of another robot.
            randomization: what varies in training.
            history: how many earlier observations and actions the policy sees.
            informed: whether the policy is given each robot's parameters.

        Returns:
            The learner before its first iteration.

        Raises:
            ValueError: the learner does not support one of these, a setting is out of its range, or demonstrations or policy
                are missing, or of another task or shape.
        """
        self.check(task, params, demos, start, randomization, history, informed)
        settings.check()
        optional = {"demos": demos, "start": start, "randomization": randomization}
        optional |= {"history": history or None, "informed": informed or None}
        given = {name: value for name, value in optional.items() if value is not None}
        with load("ballbot_train.policy.weights:own_defaults")():
            return load(f"{self.module}:make")(task, params, settings, seed, **given)


_WORDS = {
    "demonstrations": "demonstrations",
    "start": "a policy to start from",
    "tracks": "tracks (--randomization)",
    "history": "a history (--history)",
    "informed": "informed policies (--informed)",
    "clock": "tasks whose cost or goal depends on the time",
}
"""What messages call the abilities of an `Algorithm`."""

_HERE = __name__.rpartition(".")[0]

LEARNERS: dict[str, Algorithm] = {
    "apg": Algorithm(
        f"{_HERE}.apg",
        "analytic policy gradient, through whole episodes",
        start=True,
        tracks=True,
        history=True,
        informed=True,
        clock=True,
    ),
    "dagger": Algorithm(
        f"{_HERE}.dagger",
        "DAgger, labelled by the optimum",
        demonstrations=True,
        start=True,
        tracks=True,
        history=True,
    ),
    "ppo": Algorithm(
        f"{_HERE}.ppo",
        "proximal policy optimization",
        demonstrations=True,
        start=True,
        tracks=True,
        history=True,
        clock=True,
    ),
    "sac": Algorithm(f"{_HERE}.sac", "soft actor-critic", demonstrations=True, start=True, clock=True),
}
