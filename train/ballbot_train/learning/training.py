"""Training runs: any learner with progress, TensorBoard, evaluation on certified episodes, checkpoints and resumption.

A run is a folder:

| file | holds |
|---|---|
| config.json | learner, task, settings, seed, demonstrations and the command that made it |
| checkpoint.pt | all that the learner needs to go on as if never stopped; tensors and plain values only |
| policy.json, policy.safetensors | the best policy so far; at the end with what it measures in PyBullet |
| evaluations.csv | iteration, wall time and what the policy then cost on the certified episodes |
| tensorboard/ | the learner's figures and those evaluations |
"""

import csv
import io
import json
import math
import os
import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch.utils.tensorboard import SummaryWriter

from ballbot_gym import certified, files
from ballbot_gym.batch import BallbotBatch, run_episodes
from ballbot_gym.env import BallbotEnv
from ballbot_gym.params import default_params
from ballbot_gym.tasks import Task
from ballbot_train.console import console, progress_bar
from ballbot_train.evaluation import evaluate
from ballbot_train.policy import PolicyController, PolicyNetwork, load_network, save_policy
from ballbot_train.provenance import provenance

_CHECKPOINT_SECONDS = float(os.environ.get("BALLBOT_CHECKPOINT_SECONDS", "60"))


class Learner(Protocol):
    """A learning algorithm as a sequence of iterations, each a second or so.

    Everything that a later iteration depends on is in `state_dict`, so that a resumed learner does what it would have done.
    """

    iteration: int
    """Iterations done."""
    iterations: int
    """Iterations in all."""
    evaluations: int
    """How often, at equal distances, the policy is evaluated."""

    @property
    def network(self) -> PolicyNetwork:
        """The policy learnt so far."""

    def iterate(self) -> dict[str, float]:
        """Does one iteration; returns figures to log by name."""

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain values."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes back to a state."""


@dataclass(frozen=True)
class Score:
    """What a policy costs on the certified episodes, in the batched closed-form model."""

    cost_ratio: float
    """Mean of cost / optimum, an episode without success costing at least what failing at once costs.

    The best policy has the least."""
    regret_mean: float
    """Of the episodes that did not fail."""
    regret_median: float
    success: float
    failures: int


def score(network: PolicyNetwork, task: Task) -> Score:
    """Runs all certified episodes at once, some seconds faster than PyBullet one by one."""
    episodes = certified.load(task)
    batch = BallbotBatch(task, len(episodes), compile=False)
    run = run_episodes(batch, network, episodes.states, episodes.constants)
    ratio = run.cost.numpy() / episodes.costs
    priced = np.where(run.success.numpy(), ratio, np.maximum(ratio, task.survival_pay / episodes.costs))
    standing = ratio[~run.failure.numpy()] - 1
    return Score(
        cost_ratio=float(priced.mean()),
        regret_mean=float(standing.mean()) if standing.size else math.nan,
        regret_median=float(np.median(standing)) if standing.size else math.nan,
        success=float(run.success.double().mean()),
        failures=int(run.failure.sum()),
    )


def train(learner: Learner, task: Task, config: Mapping[str, Any], out: Path, resume: bool = False) -> evaluate.Row:
    """Runs a learner to its end, or to Ctrl-C, which saves; then measures the best policy in PyBullet.

    Args:
        learner: at its beginning.
        task: what it learns; needs certified episodes.
        config: what config.json says; a run resumes only with the same.
        out: folder of the run.
        resume: continue the run in `out`, if there is one.

    Raises:
        ValueError: `out` holds another run, or one that was not to be resumed.
        KeyboardInterrupt: after saving.
    """
    run = _Run(learner, task, config, out, resume)
    writer = SummaryWriter(str(out / "tensorboard"), purge_step=learner.iteration)
    every = max(1, learner.iterations // learner.evaluations)
    saved = time.monotonic()
    with _interruptible() as interrupted, progress_bar() as progress:
        bar = progress.add_task(config["learner"], total=learner.iterations, completed=learner.iteration)
        if learner.iteration == 0:
            run.score()  # so that there is a policy, and learning curves begin where it began
        while learner.iteration < learner.iterations:
            start = time.monotonic()
            figures = learner.iterate()
            run.seconds += time.monotonic() - start
            progress.update(bar, completed=learner.iteration)
            for name, value in figures.items():
                writer.add_scalar(name, value, learner.iteration)
            if learner.iteration % every == 0 or learner.iteration >= learner.iterations:
                for name, value in asdict(run.score()).items():
                    writer.add_scalar(f"certified/{name}", value, learner.iteration)
                progress.update(bar, description=f"{config['learner']} {run.best_text}")
            if time.monotonic() - saved > _CHECKPOINT_SECONDS or interrupted():
                run.save()
                saved = time.monotonic()
            if interrupted():
                raise KeyboardInterrupt
    run.save()
    writer.close()
    return run.measure()


class _Run:
    """The folder of a run: what of it must survive."""

    def __init__(self, learner: Learner, task: Task, config: Mapping[str, Any], out: Path, resume: bool):
        self.learner, self.task, self.config, self.out = learner, task, dict(config), out
        self.seconds, self.best, self.rows = 0.0, math.inf, []
        written = out / "config.json"
        if written.exists() and not resume:
            raise ValueError(f"{out} already holds a run; give --resume to continue it, or another --out")
        if written.exists():
            old = json.loads(written.read_text())
            differing = [key for key in self.config if old.get(key) != json.loads(json.dumps(self.config[key]))]
            if differing:
                raise ValueError(f"{out} holds a run with another {', '.join(differing)}; give another --out")
        files.write(written, json.dumps(self.config | {"about": provenance()}, indent=1) + "\n")
        if (out / "checkpoint.pt").exists():
            # weights_only: tensors and plain values, nothing that runs
            state = torch.load(out / "checkpoint.pt", weights_only=True)
            learner.load_state_dict(state["learner"])
            self.seconds, self.best, self.rows = state["seconds"], state["best"], state["rows"]
            save_policy(out / "policy", self._restored(state["policy"]), self._about())
            self._write_rows()

    def score(self) -> Score:
        """Scores the present policy, and keeps it if it is the best."""
        network = self.learner.network
        result = score(network, self.task)
        self.rows.append({"iteration": self.learner.iteration, "seconds": round(self.seconds, 1), **asdict(result)})
        self._write_rows()
        if result.cost_ratio < self.best:
            self.best = result.cost_ratio
            save_policy(self.out / "policy", network, self._about())
        return result

    @property
    def best_text(self) -> str:
        """The best so far, for the progress bar."""
        best = min(self.rows, key=lambda row: row["cost_ratio"])
        return f"{100 * best['regret_mean']:.2f} % regret, {best['failures']} fail"

    def save(self) -> None:
        """Writes the checkpoint, and with it the best policy, so that both are of one moment."""
        state = {
            "learner": self.learner.state_dict(),
            "seconds": self.seconds,
            "best": self.best,
            "rows": self.rows,
            "policy": load_network(self.out / "policy", self.task).state_dict(),
        }
        buffer = io.BytesIO()
        torch.save(state, buffer)
        files.write(self.out / "checkpoint.pt", buffer.getvalue())

    def measure(self) -> evaluate.Row:
        """The best policy on the certified episodes in PyBullet; its JSON says it from now on."""
        network = load_network(self.out / "policy", self.task)
        env = BallbotEnv(self.task)
        controller = PolicyController(self.task, default_params(), network)
        episodes = range(len(certified.load(self.task)))
        results = evaluate.run_episodes(env, controller, self.config["learner"], self.config["task"], episodes)
        env.close()
        row = evaluate.summarize(results)
        measured = {
            "physics": env.physics,
            "episodes": row.episodes,
            "success": row.success,
            "falls": row.falls,
            "regret_mean": row.regret_mean,
            "regret_median": row.regret_median,
        }
        save_policy(self.out / "policy", network, self._about() | {"measured": measured})
        return row

    def _restored(self, weights: Mapping[str, torch.Tensor]) -> PolicyNetwork:
        network = PolicyNetwork(self.learner.network.spec)
        network.load_state_dict(weights)
        return network

    def _about(self) -> dict[str, Any]:
        return {
            "training": self.config,
            "iteration": self.learner.iteration,
            "training_seconds": round(self.seconds, 1),
        }

    def _write_rows(self) -> None:
        text = io.StringIO()
        writer = csv.DictWriter(text, list(self.rows[0]) if self.rows else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        files.write(self.out / "evaluations.csv", text.getvalue())


@contextmanager
def _interruptible() -> Iterator[Any]:
    """Gives a function that says whether Ctrl-C was pressed, which within ends nothing half-way; a second one does."""
    pressed: list[int] = []

    def on_signal(number: int, frame: object) -> None:
        if pressed:
            raise KeyboardInterrupt
        pressed.append(number)
        console.print("saving; press Ctrl-C again to stop at once")

    before = signal.signal(signal.SIGINT, on_signal)
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, before)
