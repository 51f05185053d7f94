"""`ballbot train LEARNER`: trains a policy. Every setting of the learner is an option; see `ballbot train LEARNER --help`."""

import argparse
import math
import shlex
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, cast

from ballbot_gym import certified
from ballbot_gym.registry import own_robot
from ballbot_gym.robot import PAPER, Randomization, file_name, named_robot, robot_setting
from ballbot_gym.tasks import TASKS
from ballbot_train.commands.options import UNNAMED
from ballbot_train.learning import VALIDATION_EPISODES
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.learning.settings import Settings, number
from ballbot_train.work.console import RobotName, check_names, console, option, physics_or_default
from ballbot_train.work.executors import Workers

_RENAMED = {
    "shac": "`shac` is now `apg`: write `ballbot train apg`, without --horizon 0; windows with a critic are gone",
}
"""What to write for a learner of an earlier version."""


@dataclass(frozen=True)
class Run(Settings):
    """Options of a run that every learner has."""

    task: str = "stabilize"
    """Name of a task."""
    out: Path | None = None
    """Folder; default runs/train/TASK-LEARNER."""
    seed: int = number(0, 0, 2**32 - 1)
    """Seed of all random numbers."""
    resume: bool = False
    """Continue the run in this folder."""
    robot: RobotName = PAPER
    """Name of a robot; default, the robot that the task names."""
    demos: str | None = None
    """Dataset of `ballbot demos`, or the URL of shards."""
    start: Path | None = None
    """Policy file from which training continues."""
    randomization: str | None = None
    """Track to train for: unknown, late, noisy or real; not for sac."""
    history: int = number(0, 0)
    """Number of earlier observations and actions that are appended to each observation."""
    informed: bool = False
    """The policy receives the true parameters of each robot in training, and the estimates of a filter afterwards."""
    threads: int = number(1, 1, 1024)
    """Threads of torch."""
    test_episodes: int = number(certified.EPISODES, 1, certified.EPISODES)
    """Number of certified episodes on which the chosen policy is measured."""
    validation_episodes: int = number(VALIDATION_EPISODES, 1, 100_000)
    """Number of fresh episodes on which policies are compared, to choose the best one of the run."""

    @property
    def warm(self) -> bool:
        """Whether training starts from demonstrations or a policy."""
        return self.demos is not None or self.start is not None


def train(learner: str, run: Run = Run(), settings: Any = None, command: str | None = None) -> None:
    """Trains a policy on the batched model, and measures it in PyBullet on the certified episodes.

    Args:
        learner: name of a learner in `LEARNERS`.
        run: the options that every learner has.
        settings: the learner's settings; default, those tuned for the task.
        command: the command that was typed, for the record; default, one with all settings.
    """
    _check_learner(learner)
    check_names("task", [run.task], TASKS)
    run = replace(run, robot=own_robot(run.task, run.robot))
    run.check()
    if run.out is None:
        run = replace(run, out=Path("runs") / "train" / f"{file_name(run.task, run.robot)}-{learner}")
    settings = LEARNERS[learner].settings(run.task, run.warm) if settings is None else settings
    settings.check()
    _train(learner, run, settings, command or _command_with(learner, run, settings))


def _train(learner: str, run: Run, settings: Any, command: str) -> None:
    """Trains, and prints what the policy reached."""
    import torch

    from ballbot_gym.engines import PHYSICS_NAMES
    from ballbot_gym.env import make_task
    from ballbot_train.evaluation import optima
    from ballbot_train.learning import training
    from ballbot_train.policy.network import PolicyNetwork

    torch.set_num_threads(run.threads)
    problem, params, out = make_task(run.task, run.robot), named_robot(run.robot), cast(Path, run.out)
    varied = Randomization.checked(run.randomization)
    given = None if run.randomization is None else varied, run.history, run.informed
    LEARNERS[learner].check(problem, params, run.demos, run.start, *given)
    config = _config(learner, run, settings, command)
    # by which it is scored while it learns
    optima.known(problem, run.robot, workers=Workers(), randomization=varied)
    start = None if run.start is None else PolicyNetwork.load(run.start, problem, robot=None)
    made = LEARNERS[learner].make(problem, params, settings, run.seed, run.demos, start, *given)
    physics = physics_or_default(None, run.robot)
    row = training.train(made, problem, config, out, run.resume, run.test_episodes)
    console.print(
        f"in {PHYSICS_NAMES[physics]}: {100 * row.success:.1f} % success, {row.falls} falls of {row.episodes}, regret "
        f"{_share(row.regret_mean)} mean, {_share(row.regret_median)} median\npolicy: {out / 'policy.json'}"
    )


def _config(learner: str, run: Run, settings: Any, command: str) -> dict[str, Any]:
    """The record of a run; it also says how the demonstrations, or the policy to start from, were made."""
    from ballbot_train.learning.datasets import command_of
    from ballbot_train.policy.files import PolicyFile

    inputs = [] if run.demos is None else [command_of(run.demos)]
    if run.start is not None:
        trained = PolicyFile(run.start).read().get("training")
        if not isinstance(trained, dict) or not isinstance(trained.get("command"), str):
            raise ValueError(
                f"{run.start} does not say by which command it was trained; give a policy of ballbot train"
            )
        inputs.append(trained["command"])
    optional = ("randomization", "history", "informed", "validation_episodes")
    return {
        "learner": learner,
        "task": run.task,
        "seed": run.seed,
        "demos": run.demos,
        "settings": asdict(settings),
        "start": None if run.start is None else str(run.start),
        "command": " && ".join([*reversed(inputs), command]),
        **({"inputs": inputs} if inputs else {}),
        **robot_setting(run.robot),
        **{name: value for name in optional if (value := getattr(run, name)) != getattr(Run, name)},
    }


def _check_learner(name: str) -> None:
    """Raises a ValueError where there is no learner of that name."""
    if name in _RENAMED:
        raise ValueError(_RENAMED[name])
    check_names("learner", [name], LEARNERS)


def _share(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.2%}"


def command_line(arguments: Sequence[str], call: Callable[[str, Run, Any, str], None] = train) -> None:
    """Runs what was typed after `ballbot train`.

    Only the file of the learner that is named is imported. Its options are the fields of its settings, and their defaults
    are the settings tuned for the task that is named, with or without demonstrations or a policy to start from.

    Args:
        arguments: the words.
        call: what is run, with the learner's name, the options of the run, the learner's settings, and the command.

    Raises:
        ValueError: the learner or the task does not exist.
    """
    import tyro

    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--task", nargs="?", default=Run.task, const=Run.task)  # tyro says what is wrong with no value
    for name in ("--demos", "--start"):
        early.add_argument(name, nargs="?", const="")
    known = early.parse_known_args(arguments)[0]
    named = arguments[0] if arguments and not arguments[0].startswith("-") else None
    if named is None:
        listed: dict[str, Callable[..., None]] = {}
        for name in LEARNERS:
            listed[name] = lambda: None
            listed[name].__doc__ = _description(name)
        tyro.extras.subcommand_cli_from_dict(
            listed,
            prog="ballbot train",
            description="Trains a policy on the batched model, and measures it in PyBullet on the certified episodes. "
            "`ballbot train LEARNER --help` lists the settings of a learner, with the defaults tuned for --task.",
            args=list(arguments),
        )
        return
    _check_learner(named)
    check_names("task", [known.task], TASKS)
    settings = LEARNERS[named].settings(known.task, {known.demos, known.start} - {None, "None"} != set())

    words = ["ballbot", "train", *(word for word in arguments if word != "--resume")]

    def command(run: Any = Run(), settings: Any = settings) -> None:
        call(named, run, settings, shlex.join(words))

    # options are --task and --num-envs, and not --run.task and --settings.num-envs
    command.__annotations__ = {"run": Annotated[Run, UNNAMED], "settings": Annotated[type(settings), UNNAMED]}
    command.__doc__ = _description(named)
    tyro.cli(command, prog=f"ballbot train {named}", args=list(arguments[1:]), compact_help=True)


def _description(learner: str) -> str:
    described = LEARNERS[learner].description
    return f"{described[:1].upper()}{described[1:]}."


def _command_with(learner: str, run: Run, settings: Any) -> str:
    """The command that makes a run with exactly these settings."""
    words = ["ballbot", "train", learner]
    for name, value in vars(run).items():
        if name in ("task", "seed") or (value != getattr(Run, name) and name != "resume"):
            words += [f"--{name.replace('_', '-')}", str(value)]
    for name, value in asdict(settings).items():
        words += option(name.replace("_", "-"), value)
    return shlex.join(words)
