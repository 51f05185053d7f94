"""Searches settings of a learner with Optuna: `python examples/tune.py --task orbit --trials 40`.

Every trial runs `ballbot train` with the settings that Optuna proposes, once per seed. The mean validation cost of the seeds
is minimized, so the certified episodes decide nothing. A trial whose cost is above the median of the earlier ones after a
seed is pruned. The same command continues a search that was interrupted, and
`optuna-dashboard sqlite:///runs/tune/study.db` shows it.

It needs `pip install "ballbot-gym[tune]"`. For another learner, or other settings, change `proposed`.
"""

import csv
import subprocess
import sys
from pathlib import Path

import optuna
import tyro

LEARNER = "ppo"


def proposed(trial: optuna.Trial) -> dict[str, object]:
    """The options of `ballbot train` that a trial tries."""
    return {
        "learning-rate": trial.suggest_float("learning-rate", 1e-4, 5e-3, log=True),
        "gamma": trial.suggest_categorical("gamma", (0.98, 0.985, 0.99, 0.995, 0.998)),
        "gae-lambda": trial.suggest_float("gae-lambda", 0.9, 0.99),
        "std": trial.suggest_float("std", 0.1, 0.8, log=True),
        "num-steps": trial.suggest_categorical("num-steps", (24, 48, 96, 128)),
    }


def cost_of(folder: Path) -> float:
    """The validation cost of the policy that a run chose."""
    rows = csv.DictReader((folder / "evaluations.csv").read_text(encoding="utf-8").splitlines())
    return min(float(row["validation_cost"]) for row in rows)


def main(
    task: str = "orbit", trials: int = 40, seeds: int = 2, options: str = "", out: Path = Path("runs/tune")
) -> None:
    """Searches, and prints the best settings.

    Args:
        task: name of a task.
        trials: number of trials in all.
        seeds: trainings per trial.
        options: of every training, such as "--iterations 100".
        out: folder of the study and the trainings.
    """

    def objective(trial: optuna.Trial) -> float:
        words = [f"--{name}={value}" for name, value in proposed(trial).items()]
        total = 0.0
        for seed in range(seeds):
            run = out / f"trial-{trial.number}" / f"seed-{seed}"
            command = [sys.executable, "-m", "ballbot_train.cli", "train", LEARNER, "--task", task, "--seed", str(seed)]
            subprocess.run([*command, *words, *options.split(), "--out", str(run)], check=True)
            total += cost_of(run)
            trial.report(total / (seed + 1), seed)
            if seed + 1 < seeds and trial.should_prune():
                raise optuna.TrialPruned
        return total / seeds

    out.mkdir(parents=True, exist_ok=True)
    storage, pruner = f"sqlite:///{out.absolute()}/study.db", optuna.pruners.MedianPruner()
    study = optuna.create_study(storage=storage, study_name="tune", pruner=pruner, load_if_exists=True)
    ended = [trial for trial in study.trials if trial.state.is_finished()]
    study.optimize(objective, n_trials=max(0, trials - len(ended)), catch=subprocess.CalledProcessError)
    print(f"the best, trial {study.best_trial.number}, costs {study.best_value:.3f}: {study.best_params}")


if __name__ == "__main__":
    tyro.cli(main)
