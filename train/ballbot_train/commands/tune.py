"""`ballbot tune LEARNER`: a learner's hyperparameters by search, on several seeds, resumable."""

import shlex
from pathlib import Path

from ballbot_gym.robots import PAPER, file_name
from ballbot_gym.tasks import TASKS
from ballbot_train.commands.options import WorkersOption
from ballbot_train.commands.train import Run, command_with
from ballbot_train.console import RobotName, check_least, check_names, console, print_table
from ballbot_train.executors import Workers
from ballbot_train.learning.learners import LEARNERS


def tune(
    learner: str,
    /,
    task: str = "stabilize",
    trials: int = 40,
    seeds: int = 2,
    env_steps: int = 1_000_000,
    evaluations: int = 8,
    out: Path | None = None,
    workers: WorkersOption = Workers(1),
    robot: RobotName = PAPER,
) -> None:
    """Searches a learner's hyperparameters: Optuna's TPE, pruned by regret; a killed search continues when started again.

    Args:
        learner: ppo or sac.
        task: name of a task.
        trials: how many sets of settings to try in all. More than before continues a search that has ended.
        seeds: trainings per trial, with the seeds 0, 1, 2 ... What counts is their mean.
        env_steps: length of each training.
        evaluations: of each training; after each of them a trial may be pruned.
        out: folder of the search; default runs/tune/TASK-LEARNER. It holds the study (SQLite), best.json and, on the
            paper's robot, settings for rl-zoo3.
        workers: who runs trials.
        robot: name of a robot.
    """
    check_names("learner", [learner], LEARNERS)
    check_names("task", [task], TASKS)
    check_least(1, trials=trials, seeds=seeds, env_steps=env_steps, evaluations=evaluations)
    out = Path("runs") / "tune" / f"{file_name(task, robot)}-{learner}" if out is None else out

    from ballbot_train.learning import tuning  # it imports torch and Optuna

    search = tuning.Search(learner, task, tuple(range(seeds)), env_steps, evaluations, robot)
    best = tuning.run(search, trials, out, workers)
    if not best:
        raise ValueError(f"none of {trials} trials came to its end; {out / 'study.db'} says why. Give more --trials")
    settings = tuning.settings_of(search, {name: best["settings"][name] for name in tuning.SPACES[learner]})
    rows = [
        [f"{seed}", f"{cost:.3f}", f"{success:.1%}", f"{regret:.1%}"]
        for seed, cost, success, regret in zip(
            best["seeds"], best["costs"], best["success"], best["certified_regret"], strict=True
        )
    ]
    header = ["seed", "validation cost", "success", "certified regret"]
    print_table(f"the best, trial {best['trial']}, of {learner} on {task}", header, rows)
    listed = f"cd {shlex.quote(str(out))} && optuna trials --study-name tune --storage sqlite:///study.db"
    console.print(
        f"trials: {listed}\nsettings: {out / 'best.json'}\n"
        f"train with them: {command_with(learner, Run(task=task, robot=robot), settings)}",
        soft_wrap=True,
    )
