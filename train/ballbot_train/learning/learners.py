"""Learning algorithms by name, one file each.

A new learner is one file and one line in `LEARNERS`. Its file holds

- a frozen dataclass of settings whose defaults suit any task, with a docstring under every field;
- `TUNED`, settings by name of task, and by "" for any other task; `WARM`, where they differ after a warm start;
- `make(task, params, settings, seed, demos, start)`, which returns the learner before its first iteration (see
  `training.Learner`).
"""

import math
from dataclasses import dataclass, fields
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ballbot_gym.checks import MOST_ENVS
from ballbot_gym.lazy import load
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task

if TYPE_CHECKING:
    from ballbot_gym.randomization import Randomization
    from ballbot_train.learning.training import Learner
    from ballbot_train.policy.network import PolicyNetwork


@dataclass(frozen=True)
class Algorithm:
    """An entry of `LEARNERS`. The learner's file, and with it torch, is imported when one of the methods is called."""

    module: str
    """The file, as for an import."""
    description: str
    """One line for the command line."""
    demonstrations: bool
    """Whether the learner can use demonstrations."""

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

    def check(self, demos: object, start: object) -> None:
        """Raises a ValueError where demonstrations are of no use to this learner, or a policy to start from beside them."""
        if demos is not None and not self.demonstrations:
            raise ValueError(f"{self.name} uses no demonstrations")
        if demos is not None and start is not None:
            raise ValueError("training starts from demonstrations or from a policy; give one of --demos and --start")

    def make(
        self,
        task: Task,
        params: BallbotParams,
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
            settings: as of `settings`.
            seed: of everything that the learner draws. Its envs get the one that `seeding.spawned` makes of it.
            demos: folder of a dataset of demonstrations, or None.
            start: a policy to train on from, or None; it may be of another robot.
            randomization: what varies in training, for dagger, ppo and shac.
            history: how many earlier observations and actions the policy sees, for dagger, ppo and shac.
            informed: whether the policy is told each robot, for shac with horizon 0.

        Returns:
            The learner before its first iteration.

        Raises:
            ValueError: demonstrations or policy are missing, of another task or shape, or of no use to this learner.
        """
        self.check(demos, start)
        if task.clock and (self.name == "dagger" or getattr(settings, "horizon", 0)):
            raise ValueError(
                f"cost and goal of {task.id} depend on the time, which {self.name} does not know; train ppo or sac, and "
                "from such a policy shac with --horizon 0"
            )
        if params.wheels is not None and self.name in ("ppo", "sac"):
            raise ValueError(
                f"{self.name} here knows no robot with wheels; train shac or dagger, or Stable-Baselines3 on the env itself"
            )
        given: dict[str, Any] = {"demos": demos, "start": start}
        if randomization is not None or history:
            if self.name == "sac":
                raise ValueError("sac knows no randomization and no history; train dagger, ppo or shac")
            given |= {"randomization": randomization, "history": history}
        if informed:
            if self.name != "shac" or settings.horizon or randomization is None or not randomization.varies_robot:
                raise ValueError("only shac with --horizon 0 trains informed policies, with --randomization unknown")
            given["informed"] = True
        with load("ballbot_train.policy.weights:own_defaults")():
            return load(f"{self.module}:make")(task, params, settings, seed, **given)


_MAY_BE_ZERO = {"gathering_iterations", "horizon"}
_MAY_BE_NEGATIVE = {"target_entropy"}
_SHARES = {"final_gamma", "gae_lambda", "gamma", "hard_fraction", "reset_fraction"}
_POSITIVE = {"critic_learning_rate", "final_std", "learning_rate", "std"}
_MOST = 10**9  # of whole numbers
_MOST_OF = {"buffer_size": 10**8, "hidden": 2**14, "horizon": 10**5, "num_envs": MOST_ENVS, "num_steps": 10**6}
_MOST_STEPS = 10**8  # env steps of an iteration, which are all in memory


def check_settings(settings: Any) -> None:
    """Raises a ValueError that names the first of a learner's settings that makes no sense.

    Whole numbers are positive, except those that switch something off with 0. Other numbers are finite and at least 0;
    discounts and the like are at most 1.
    """
    for field in fields(settings):
        name, value = field.name, getattr(settings, field.name)
        for number in value if isinstance(value, tuple) else [value]:
            if isinstance(number, bool) or not isinstance(number, int | float):
                continue
            if isinstance(number, int):
                least, most = 0 if name in _MAY_BE_ZERO else 1, _MOST_OF.get(name, _MOST)
                if not least <= number <= most:
                    raise ValueError(f"{name} must be {least} to {most}, not {number}")
            elif name in _SHARES and not 0 <= number <= 1:
                raise ValueError(f"{name} must be 0 to 1, not {number}")
            elif name in _POSITIVE and not 0 < number < math.inf:
                raise ValueError(f"{name} must be finite and positive, not {number}")
            elif not math.isfinite(number) or (number < 0 and name not in _MAY_BE_NEGATIVE):
                raise ValueError(f"{name} must be finite and at least 0, not {number}")
    envs = getattr(settings, "num_envs", 1)
    steps = getattr(settings, "num_steps", getattr(settings, "horizon", 1))
    if envs * steps > _MOST_STEPS:
        raise ValueError(
            f"{envs} envs of {steps} steps are {envs * steps} env steps per iteration, and at most {_MOST_STEPS} are kept in "
            "memory; take fewer of either"
        )


_HERE = __name__.rpartition(".")[0]

LEARNERS: dict[str, Algorithm] = {
    "dagger": Algorithm(f"{_HERE}.dagger", "DAgger, labelled by the optimum", demonstrations=True),
    "ppo": Algorithm(f"{_HERE}.ppo", "proximal policy optimization", demonstrations=True),
    "sac": Algorithm(f"{_HERE}.sac", "soft actor-critic", demonstrations=True),
    "shac": Algorithm(f"{_HERE}.shac", "short-horizon actor-critic", demonstrations=False),
}
