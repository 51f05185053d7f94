"""`ballbot train`: a policy by any learner."""

import shlex
import sys
import typing
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, Literal

import torch

from ballbot_gym.env import make_task
from ballbot_gym.params import default_params
from ballbot_gym.tasks import TASKS
from ballbot_train.console import check_names, console
from ballbot_train.learning import training
from ballbot_train.learning.demonstrations import command_of
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.policy import load_network, read_description


def train(
    learner: str,
    /,
    task: str = "stabilize",
    demos: Path | None = None,
    start: Path | None = None,
    seed: int = 0,
    set: dict[str, str] = {},  # noqa: B006 (the option's name; tyro's default, never changed)
    threads: int | None = None,
    out: Path | None = None,
    resume: bool = False,
) -> None:
    """Trains a policy on the batched model, and measures it in PyBullet on the certified episodes.

    Args:
        learner: name of a learner: bc, dagger, ppo, sac or shac.
        task: name of a task.
        demos: folder of a demonstration dataset, of `ballbot demos`.
        start: policy file to start from, for shac.
        seed: of everything drawn.
        set: settings by name that replace the tuned ones, e.g. --set iterations 100 hidden 64,64.
        threads: of torch; default, its own choice. Another number gives other last digits.
        out: folder of the run; default runs/train/TASK-LEARNER.
        resume: continue the run in this folder, if there is one.
    """
    check_names("learner", [learner], LEARNERS)
    check_names("task", [task], TASKS)
    algorithm, problem = LEARNERS[learner], make_task(task)
    if demos is not None and not algorithm.demonstrations:
        raise ValueError(f"{learner} uses no demonstrations")
    settings = _changed(algorithm.tuned[task], set)
    if threads is not None:
        torch.set_num_threads(threads)
    out = Path("runs") / "train" / f"{task}-{learner}" if out is None else out
    command = shlex.join(["ballbot", *[word for word in sys.argv[1:] if word != "--resume"]])
    # what made the demonstrations, or the policy to start from, belongs to what makes this one
    if demos is not None:
        command = f"{command_of(demos)} && {command}"
    if start is not None:
        command = f"{read_description(start)['training']['command']} && {command}"
    config = {
        "learner": learner,
        "task": task,
        "seed": seed,
        "demos": None if demos is None else str(demos),
        "settings": asdict(settings),
        "start": None if start is None else str(start),
        "command": command,
    }
    made = algorithm.make(problem, default_params(), settings, seed, demos)
    if start is not None:
        if not hasattr(made, "begin"):
            raise ValueError(f"{learner} cannot start from a policy")
        made.begin(load_network(start, problem))
    row = training.train(made, problem, config, out, resume)
    console.print(
        f"in PyBullet: {100 * row.success:.1f} % success, {row.falls} falls of {row.episodes}, regret "
        f"{row.regret_mean:.2%} mean, {row.regret_median:.2%} median\npolicy: {out / 'policy.json'}"
    )


def _changed(settings: Any, changes: dict[str, str]) -> Any:
    """Settings with some replaced by what was typed.

    Raises:
        ValueError: a setting of that name does not exist, or cannot take that value.
    """
    kinds = typing.get_type_hints(type(settings))
    check_names("setting", list(changes), [field.name for field in fields(settings)])
    typed = {}
    for name, text in changes.items():
        kind = kinds[name]
        try:
            if typing.get_origin(kind) is tuple:
                typed[name] = tuple(typing.get_args(kind)[0](part) for part in text.split(",") if part)
            elif kind is bool:
                typed[name] = {"true": True, "false": False}[text.lower()]
            elif typing.get_origin(kind) is Literal:
                typed[name] = {option: option for option in typing.get_args(kind)}[text]
            else:
                typed[name] = kind(text)
        except (ValueError, KeyError) as error:
            raise ValueError(
                f"setting {name} cannot be {text!r}: it is of type {getattr(kind, '__name__', kind)}"
            ) from error
    return replace(settings, **typed)
