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

import io
import math
import os
import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch.utils.tensorboard import SummaryWriter

from ballbot_gym import certified, files
from ballbot_gym.batch import BallbotBatch, run_episodes
from ballbot_gym.env import BallbotEnv
from ballbot_gym.params import default_params
from ballbot_gym.tasks import Task
from ballbot_train import jobs
from ballbot_train.console import console, progress_bar
from ballbot_train.evaluation import evaluate
from ballbot_train.policy import PolicyController, PolicyNetwork, load_network, save_policy
from ballbot_train.provenance import provenance

_CONFIG = "config.json"
_CHECKPOINT_LIMIT = 2**34  # bytes
_CHECKPOINT_SECONDS = float(os.environ.get("BALLBOT_CHECKPOINT_SECONDS", "60"))


class Learner(Protocol):
    """A learning algorithm as a sequence of iterations, each of about a second.

    `state_dict` holds everything that a later iteration depends on. So a resumed learner does exactly what it would have
    done without the interruption.
    """

    iteration: int
    """Iterations done."""
    iterations: int
    """Iterations in all."""
    evaluations: int
    """Number of evaluations, at equal distances."""

    @property
    def network(self) -> PolicyNetwork:
        """The policy learnt so far."""
        ...

    def iterate(self) -> dict[str, float]:
        """Does one iteration; returns figures to log by name."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """The learner's state: tensors and plain values."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes back to a state."""


@runtime_checkable
class Finetunable(Protocol):
    """A learner that can start from the weights of a policy."""

    def start_from(self, network: PolicyNetwork) -> None:
        """Takes the weights of a policy; raises a ValueError for a network of another shape."""


@dataclass(frozen=True)
class Score:
    """What a policy costs on the certified episodes, in the batched closed-form model."""

    cost_ratio: float
    """Mean of cost / optimum; an episode without success costs at least as much as failing at once. The best has least."""
    regret_mean: float
    """Mean of cost / optimum − 1 over the episodes that did not fail."""
    regret_median: float
    """Median of the same."""
    success: float
    """Share of the episodes that ended in success."""
    failures: int
    """Number of episodes that failed."""


def score(network: PolicyNetwork, task: Task) -> Score:
    """Measures a policy on all certified episodes at once, much faster than in PyBullet one by one."""
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
    """Runs a learner to its end and measures the best policy in PyBullet. Ctrl-C saves and stops.

    Args:
        learner: before its first iteration.
        task: the task; it needs certified episodes.
        config: contents of config.json; a run resumes only with the same.
        out: folder of the run.
        resume: continue the run in `out`, if there is one.

    Returns:
        What the best policy measures in PyBullet.

    Raises:
        ValueError: `out` holds another run or a damaged one, it holds this run and `resume` is not given, or the learner
            has less than one iteration or evaluation to do.
        KeyboardInterrupt: after saving.
    """
    for name in ("iterations", "evaluations"):
        if getattr(learner, name) < 1:
            raise ValueError(f"{name} must be at least 1, not {getattr(learner, name)}")
    run = _Run(learner, task, config, out, resume)
    try:
        return _learn(run, learner, config)
    finally:
        jobs.unlock(out)


def _learn(run: "_Run", learner: Learner, config: Mapping[str, Any]) -> evaluate.Row:
    writer = SummaryWriter(str(run.out / "tensorboard"), purge_step=learner.iteration)
    every = max(1, learner.iterations // learner.evaluations)
    saved = time.monotonic()
    with _interruptible() as interrupted, progress_bar() as progress:
        bar = progress.add_task(config["learner"], total=learner.iterations, completed=learner.iteration)
        if learner.iteration == 0:
            run.score()  # so that there is a policy, and learning curves show the start
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
    """The folder of a run."""

    def __init__(self, learner: Learner, task: Task, config: Mapping[str, Any], out: Path, resume: bool):
        self.learner, self.task, self.config, self.out = learner, task, dict(config), out
        self.seconds, self.best, self.rows = 0.0, math.inf, []
        if (out / _CONFIG).exists() and not resume:
            raise ValueError(f"{out} already holds a run; give --resume to continue it, or another --out")
        jobs.claim(out, self.config, _CONFIG, {"about": provenance()})
        try:
            if (out / "checkpoint.pt").exists():
                self._restore()
        except BaseException:
            jobs.unlock(out)
            raise

    def _restore(self) -> None:
        """Goes back to the checkpoint; a damaged one is a ValueError."""
        path = self.out / "checkpoint.pt"
        try:
            # tensors and plain values: nothing in it is executed
            state = torch.load(io.BytesIO(files.read(path, _CHECKPOINT_LIMIT)), weights_only=True)
            self.learner.load_state_dict(state["learner"])
            best = self._restored(state["policy"])
            self.seconds, self.best, self.rows = float(state["seconds"]), float(state["best"]), list(state["rows"])
        except Exception as error:  # torch and the learners have dozens of ways to refuse a damaged state
            raise ValueError(f"{path} is damaged; give another --out or delete the folder ({error!r})") from error
        save_policy(self.out / "policy", best, self._about())
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
        """Writes the checkpoint, with the best policy in it, so that both are of the same iteration."""
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
        """Measures the best policy on the certified episodes in PyBullet, and adds the result to its JSON file."""
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
        files.write_csv(self.out / "evaluations.csv", self.rows)


@contextmanager
def _interruptible() -> Iterator[Any]:
    """Yields a function that says whether Ctrl-C was pressed. The first Ctrl-C interrupts nothing; a second one does."""
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
