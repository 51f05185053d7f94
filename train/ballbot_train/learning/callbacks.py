"""`RegretCallback`: the regret of a Stable-Baselines3 model while it trains."""

import io
import pickle
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from ballbot_gym import files
from ballbot_gym.env import make_task
from ballbot_gym.robot import PAPER, named_robot
from ballbot_gym.tasks import Task
from ballbot_train.evaluation.results import success_text
from ballbot_train.learning import VALIDATION_EPISODES
from ballbot_train.learning.training import score_and_validate
from ballbot_train.policy.saved_models import mark

BEST_MODEL, BEST_STATISTICS = "best_model.zip", "best_model.vecnormalize.pkl"


class RegretCallback(BaseCallback):
    """Measures the model's regret at regular intervals, as `EvalCallback` measures returns, and saves the best model.

    An evaluation is the same as in `ballbot train`, runs in the batched closed-form model, and takes about a second. It
    reports the regret on the 200 certified episodes. The best model is the one with the lowest mean cost on a fixed set of
    other episodes. The policy acts without noise, and observations are normalized as in training if that uses VecNormalize.
    The figures go to the logger of Stable-Baselines3, so TensorBoard shows them, and W&B with
    `wandb.init(sync_tensorboard=True)`.
    """

    def __init__(
        self,
        task: str | Task,
        eval_freq: int = 10_000,
        save_path: str | Path | None = None,
        validation_episodes: int = VALIDATION_EPISODES,
        robot: str = PAPER,
        verbose: int = 0,
    ):
        """Makes the callback.

        Args:
            task: a name in `TASKS`, or a Task that has a certified set. The model is measured on this task, even if training
                uses an easier one.
            eval_freq: control steps of each env between two evaluations. One is made at the end of training as well.
            save_path: folder of best_model.zip, of best_model.vecnormalize.pkl if the model uses VecNormalize, and of
                evaluations.csv; None: nothing is written.
            validation_episodes: number of other episodes on which the best model is chosen.
            robot: a name in `ROBOTS`.
            verbose: 1 prints a line for each evaluation.

        Raises:
            ValueError: no such task or robot, or a number below 1.
        """
        super().__init__(verbose)
        for name, number in (("eval_freq", eval_freq), ("validation_episodes", validation_episodes)):
            if number < 1:
                raise ValueError(f"{name} must be at least 1, not {number}")
        self.task = make_task(task, robot)
        self.eval_freq, self.validation_episodes = eval_freq, validation_episodes
        self.save_path = None if save_path is None else Path(save_path)
        self.evaluations: list[dict[str, float]] = []
        """Every evaluation's figures, by name."""
        self.best: dict[str, float] | None = None
        """Those of the best model."""
        self._robot = robot

    def evaluate(self) -> dict[str, float]:
        """Measures the present model; returns the figures by name. Raises a PolicyError if its spaces are not the task's."""
        return score_and_validate(self.model, self.task, self._robot, self.validation_episodes)

    def _init_callback(self) -> None:
        mark(self.model.observation_space, self.task, named_robot(self._robot))

    def _on_step(self) -> bool:
        if self.n_calls % self.eval_freq == 0:
            self._evaluate()
        return True

    def _on_training_end(self) -> None:
        if self.n_calls % self.eval_freq:
            self._evaluate()

    def _evaluate(self) -> None:
        figures: dict[str, Any] = {"timesteps": self.num_timesteps, **self.evaluate()}
        self.evaluations.append(figures)
        for name, value in figures.items():
            if name != "timesteps":
                self.logger.record(name, value)
        self.logger.dump(self.num_timesteps)
        if self.verbose:
            success = success_text(figures["certified/success"], figures["certified/near"])
            print(
                f"{self.num_timesteps} steps: regret {figures['certified/regret_mean']:.2%} (worst "
                f"{figures['certified/regret_worst']:.2%}), success {success}"
            )
        self.best = min(self.evaluations, key=_order)
        if self.save_path is not None:
            self._write(self.save_path, self.best is figures)

    def _write(self, folder: Path, is_best: bool) -> None:
        files.write_csv(folder / "evaluations.csv", self.evaluations)
        if is_best:
            model = io.BytesIO()
            self.model.save(model)
            files.write(folder / BEST_MODEL, model.getvalue())
            statistics = self.model.get_vec_normalize_env()
            if statistics is not None:  # as VecNormalize.load reads it
                files.write(folder / BEST_STATISTICS, pickle.dumps(statistics))


def _order(figures: dict[str, float]) -> tuple[float, float]:
    """The best is the least, as in `ballbot train`."""
    return figures["validation/cost"], figures["validation/mean_cost"]
