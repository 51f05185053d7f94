"""Hyperparameters by search: Optuna's tree-structured Parzen estimator over a learner's settings, on several seeds each.

A trial trains one learner per seed, all with the same settings and number of env steps. They learn in turns, from one
evaluation to the next. What is minimized is the cost of the validation episodes, of each seed's best policy so far, averaged
over the seeds. All policies meet the same validation episodes, so a mean cost is the regret, in units of cost, plus a
constant. So trials are ordered and pruned by their regret, and the certified episodes decide nothing. What the last policies
do on those is written down beside it.

This cost is the average of two means. One is the cost as it is, which tells near misses apart. In the other an episode
without success counts as failing at once; a training chooses its best policy by it.

A search is a folder:

| file | holds |
|---|---|
| config.json | learner, task, seeds and budget; the folder belongs to one search |
| study.db | Optuna's study "tune", in SQLite: every trial. `optuna-dashboard` and `optuna trials` show it |
| best.json | all settings of the best trial, and what each seed reached |
| ppo.yml or sac.yml | settings of the four ids in the format of rl-zoo3 |

A search that is killed goes on where it stopped; trials that were running begin anew. Trials run in this process, in several,
or on a Ray cluster. The study stays with this process: workers get the trials that have come to their end, by which they
prune, and say what theirs reached.
"""

import json
import math
import sqlite3
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym import files
from ballbot_gym.env import make_task
from ballbot_gym.identity import named_problem
from ballbot_gym.lazy import imports_of
from ballbot_gym.robots import PAPER, named_robot, robot_setting
from ballbot_gym.tasks import TASKS
from ballbot_train import executors, jobs
from ballbot_train.console import progress_bars
from ballbot_train.executors import Workers
from ballbot_train.learning import training
from ballbot_train.learning.learners import LEARNERS, ppo, sac

with imports_of("ballbot tune", "tune"):
    import optuna
    import sqlalchemy.exc  # Optuna's, as is yaml
    import sqlalchemy.pool
    import yaml

_STARTUP_TRIALS = 8  # drawn at random before the estimator proposes, and before any trial is pruned
_STUDY = "study.db"
_State = optuna.trial.TrialState
_Space = dict[str, optuna.distributions.BaseDistribution]


def _range(low: float, high: float, log: bool = True) -> optuna.distributions.FloatDistribution:
    """Numbers between two ends, drawn by their logarithm or evenly."""
    return optuna.distributions.FloatDistribution(low, high, log=log)


_choice = optuna.distributions.CategoricalDistribution

_OF_BOTH: _Space = {
    "learning_rate": _range(1e-4, 5e-3),
    "final_learning_rate_fraction": _range(0.005, 0.5),
    "gamma": _choice((0.98, 0.985, 0.99, 0.995, 0.998)),
    "std": _range(0.1, 0.8),
    "hidden": _choice(("[64, 64]", "[128, 128]", "[256, 256]")),  # Optuna keeps no tuples
}

SPACES: dict[str, _Space] = {
    "ppo": {
        "num_steps": _choice((24, 48, 64, 96, 128, 256)),
        "batch_size": _choice((512, 1024, 2048, 3072)),
        "gae_lambda": _range(0.9, 0.99, log=False),
        "final_std": _range(0.005, 0.1),
        **_OF_BOTH,
    },
    "sac": {
        "gradient_steps": _choice((4, 8, 16)),
        "batch_size": _choice((128, 256, 512)),
        "target_entropy": _range(-8.0, -1.0, log=False),
        **_OF_BOTH,
    },
}
"""What is searched, by name of learner. Every other setting stays as it is tuned for the task."""


@dataclass(frozen=True)
class Search:
    """What decides the results of a search."""

    learner: str
    """Name in `SPACES`."""
    task: str
    """Name of a task."""
    seeds: tuple[int, ...]
    """Of the trainings of a trial."""
    env_steps: int
    """Of each training."""
    evaluations: int
    """Of each training, at equal distances. Trials are pruned at these."""
    robot: str = PAPER
    """Name of a robot."""


def run(
    search: Search,
    trials: int,
    out: Path,
    workers: int | Workers = 1,
) -> dict[str, Any]:
    """Searches until so many trials have ended, goes on with what is there, and writes all files.

    Args:
        search: what is searched.
        trials: how many, pruned and failed ones included.
        out: folder of the search.
        workers: a number of processes, or `Workers`; each runs a trial at a time. With one process the same
            search proposes the same trials. With more, proposals depend on which trials have ended before.

    Returns:
        The contents of best.json.

    Raises:
        ValueError: the learner has no space, the folder belongs to another search or is in use, its study is damaged or
            cannot be written, or no trial came to its end.
    """
    if search.learner not in SPACES:
        raise ValueError(f"there is no search space for {search.learner}; there is one for {', '.join(SPACES)}")
    workers = Workers.of(workers)  # refused before anything is written
    jobs.claim(out, asdict(search) | {"problem": named_problem(search.task, search.robot)}, "config.json")
    try:
        study = open_study(search, out)
        ended = _State.COMPLETE, _State.PRUNED
        begun = sum(trial.state in ended or "error" in trial.user_attrs for trial in study.trials)  # not those killed
        named = f"{search.learner} {search.task}"

        def tasks() -> Iterator[Any]:
            for _ in range(begun, trials):
                trial = study.ask(SPACES[search.learner])
                completed = study.get_trials(states=(_State.COMPLETE,))
                yield trial, attempt, (search, settings_of(search, trial.params), completed)

        with progress_bars({named: trials}) as advance:
            advance(named, begun)
            for trial, reached in executors.completed(tasks(), workers):
                _end(study, trial, reached)
                write_best(study, search, out)
                advance(named, 1)
        return write_best(study, search, out)
    except (sqlalchemy.exc.DBAPIError, optuna.exceptions.StorageInternalError) as error:
        cause = error.__cause__ or error
        raise files.FileError(
            f"{out / _STUDY} cannot be read or written ({cause}); if there is room on the disk, the study is damaged: "
            "delete the folder"
        ) from error
    finally:
        jobs.unlock(out)


def open_study(search: Search, out: Path) -> "optuna.Study":
    """The study of a folder. Its first trial has the settings that are tuned for the task."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    # the path is no part of a URL, which a `?` in the name of a folder would end
    connect = {"creator": partial(sqlite3.connect, (out / _STUDY).absolute()), "poolclass": sqlalchemy.pool.NullPool}
    storage = optuna.storages.RDBStorage("sqlite://", engine_kwargs=connect)
    study = optuna.create_study(storage=storage, study_name="tune", direction="minimize", load_if_exists=True)
    # The sampler's numbers depend on how many trials there are, so that a search that goes on proposes new ones.
    study.sampler = optuna.samplers.TPESampler(
        seed=len(study.trials), n_startup_trials=_STARTUP_TRIALS, multivariate=False
    )
    if not study.trials:
        study.enqueue_trial(encoded(SPACES[search.learner], LEARNERS[search.learner].settings(search.task)))
    for stale in study.get_trials(states=(_State.RUNNING,)):  # of a search that was killed
        waiting = [_given(trial) for trial in study.get_trials(states=(_State.WAITING,))]
        if _given(stale) not in waiting:  # a kill may have come before the next line
            study.enqueue_trial(_given(stale))
        study.tell(stale.number, state=_State.FAIL)
    return study


def encoded(space: Mapping[str, Any], settings: Any) -> dict[str, Any]:
    """The searched settings of a learner as Optuna's parameters."""
    values = {name: getattr(settings, name) for name in space}
    return {name: json.dumps(value) if isinstance(value, tuple) else value for name, value in values.items()}


def settings_of(search: Search, chosen: Mapping[str, Any]) -> Any:
    """A learner's settings with those that were chosen, and with the search's number of env steps."""
    decoded = {name: tuple(json.loads(value)) if isinstance(value, str) else value for name, value in chosen.items()}
    settings = replace(LEARNERS[search.learner].settings(search.task), **decoded)
    iterations = max(1, round(search.env_steps / (settings.num_envs * settings.num_steps)))
    return replace(settings, evaluations=search.evaluations, iterations=iterations)


def _given(trial: "optuna.trial.FrozenTrial") -> dict[str, Any]:
    """The parameters of a trial as far as they are known: a kill may have come before all were proposed."""
    return {**trial.system_attrs.get("fixed_params", {}), **trial.params}


def attempt(search: Search, settings: Any, completed: Sequence["optuna.trial.FrozenTrial"] = ()) -> dict[str, Any]:
    """Trains with one set of settings on every seed.

    Where the median of the completed trials was better after as many evaluations, it ends early.

    Returns:
        "steps", after every evaluation the least cost so far, averaged over the seeds, and "cpu_minutes". If it came to its
        end, lists with an entry per seed: "costs", the least of the validation episodes; "success", the share of them in
        which the last policy succeeded; and "certified_regret", its mean regret on the certified episodes, where no success
        counts as failing at once. If it failed, an "error" in words.
    """
    study = optuna.create_study(pruner=optuna.pruners.MedianPruner(n_startup_trials=_STARTUP_TRIALS, n_warmup_steps=1))
    study.add_trials(completed)
    trial, began, steps = study.ask(), time.process_time(), list[float]()
    reached: dict[str, Any] = {"steps": steps}
    try:
        task, params = make_task(search.task, search.robot), named_robot(search.robot)
        learners = [LEARNERS[search.learner].make(task, params, settings, seed, None) for seed in search.seeds]
        best = [math.inf] * len(learners)
        for k in range(1, search.evaluations + 1):
            for learner in learners:
                while learner.iteration < learner.iterations * k // search.evaluations:
                    learner.iterate()
            measured = [training.score_and_validate(learner.network, task, search.robot) for learner in learners]
            costs = [(each["validation/cost"] + each["validation/mean_cost"]) / 2 for each in measured]
            best = [min(pair) for pair in zip(best, costs, strict=True)]
            steps.append(float(np.mean(best)))
            trial.report(steps[-1], k)
            if k == search.evaluations:
                reached["costs"] = best
                reached["success"] = [each["validation/success"] for each in measured]
                reached["certified_regret"] = [each["certified/cost_ratio"] - 1 for each in measured]
            elif trial.should_prune():
                break
    except (ValueError, FloatingPointError) as error:  # what torch answers to weights that are not finite
        reached["error"] = f"{error!r:.200}"
    return reached | {"cpu_minutes": (time.process_time() - began) / 60}


def _end(study: "optuna.Study", trial: "optuna.Trial", reached: dict[str, Any]) -> None:
    """Ends a trial with what it reached."""
    for step, cost in enumerate(reached.pop("steps"), 1):
        trial.report(cost, step)
    for name, value in reached.items():
        trial.set_user_attr(name, value)
    if "costs" in reached:
        study.tell(trial, float(np.mean(reached["costs"])))
    else:
        study.tell(trial, state=_State.FAIL if "error" in reached else _State.PRUNED)


def write_best(study: "optuna.Study", search: Search, out: Path) -> dict[str, Any]:
    """Writes the best that a search has found so far.

    Returns:
        The contents of best.json; empty where no trial has come to its end.
    """
    if not study.get_trials(states=(_State.COMPLETE,)):
        return {}
    trial = study.best_trial
    settings = settings_of(search, trial.params)
    best = {
        "learner": search.learner,
        "task": search.task,
        **robot_setting(search.robot),
        "trial": trial.number,
        "validation_cost": trial.value,
        "seeds": list(search.seeds),
        **{name: trial.user_attrs[name] for name in ("costs", "success", "certified_regret")},
        "settings": asdict(settings),
    }
    files.write(out / "best.json", json.dumps(best, indent=1) + "\n")
    if search.robot == PAPER:  # the ids are the paper's robot
        tuned = {task: LEARNERS[search.learner].settings(task) for task in TASKS}
        files.write(out / f"{search.learner}.yml", zoo_yaml(search.learner, tuned | {search.task: settings}))
    return best


def zoo_yaml(learner: str, settings: Mapping[str, Any]) -> str:
    """Settings of PPO or SAC by name of task as a file of hyperparameters for rl-zoo3."""
    comment = [
        f"# Hyperparameters of Stable-Baselines3's {learner.upper()} for rl-zoo3, found by `ballbot tune {learner}`:",
        "# python -m rl_zoo3.train --algo NAME --env ID --conf-file THIS --gym-packages ballbot_gym "
        "--env-kwargs physics:\"'rk4'\"",
        "# Not expressed here, because rl-zoo3 has no setting for them: critics that see products, symmetric actors,",
        "# the schedules of discount and standard deviation, scaled rewards, shorter training episodes, longer control",
        "# steps.",
    ]
    chosen = {TASKS[task].id: _zoo(learner, each) for task, each in settings.items()}
    return "\n".join([*comment, "", yaml.safe_dump(chosen, sort_keys=False, width=1000)])


def _zoo(learner: str, chosen: Any) -> dict[str, Any]:
    common = {
        "n_envs": chosen.num_envs,
        "n_timesteps": chosen.iterations * chosen.num_envs * chosen.num_steps,
        "policy": "MlpPolicy",
        "learning_rate": f"lin_{chosen.learning_rate:.3g}",
        "batch_size": chosen.batch_size,
        "gamma": chosen.gamma,
    }
    if learner == "ppo":
        return common | {
            "n_steps": chosen.num_steps,
            "n_epochs": ppo.UPDATE_EPOCHS,
            "gae_lambda": round(chosen.gae_lambda, 4),
            "clip_range": ppo.CLIP_RANGE,
            "max_grad_norm": ppo.MAX_GRAD_NORM,
            "policy_kwargs": f"dict(net_arch={list(chosen.hidden)}, log_std_init={math.log(chosen.std):.3f})",
        }
    return common | {
        "buffer_size": chosen.buffer_size,
        "n_steps": chosen.n_steps,
        "train_freq": 1,
        "gradient_steps": chosen.gradient_steps,
        "tau": sac.TAU,
        "ent_coef": f"auto_{sac.ENT_COEF}",
        "target_entropy": round(chosen.target_entropy, 3),
        "policy_kwargs": f"dict(net_arch={list(chosen.hidden)}, activation_fn=nn.SiLU)",
    }
