"""Training runs: any learner with progress, TensorBoard, evaluation, checkpoints and resumption.

A policy is evaluated on two sets of episodes while it learns. On the validation set, which has 200 fresh episodes by default,
the best policy of the run is chosen. The certified episodes are the test set: their results are reported, and are not used to
choose a policy. So the choice does not make the reported figures too good.

The best policy has the least mean cost on the validation set. The cost is the task's own, with its price of a failure, and an
episode without success costs at least as much as an immediate failure. All policies of a run are evaluated on the same
episodes, so their costs can be compared without the optima of these episodes, which are not computed.

A run is a folder:

| file | holds |
|---|---|
| config.json | learner, task, settings, seed, demonstrations and the command that made it |
| checkpoint.pt | all that the learner needs to go on as if never stopped; tensors and plain values only |
| policy.json, policy.safetensors | the best policy so far; at the end with what it measures in PyBullet |
| evaluations.csv | a line per evaluation, with the columns below |
| tensorboard/ | the learner's figures and those evaluations |

| column of evaluations.csv | holds |
|---|---|
| iteration, seconds | of training; seconds without evaluations |
| env_steps, cpu_seconds | control steps of all envs, where the learner counts them; CPU time without evaluations |
| cost_ratio, regret_mean, _median and _worst, success, near, failures | on the certified episodes, the test set |
| validation_cost, _success, _near, _failures and _mean_cost | on the validation set |

`score_and_validate` says what these are. The best policy is that of the least validation_cost, and of the least
validation_mean_cost among equals.
"""

import io
import math
import os
import shlex
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch.utils.tensorboard import SummaryWriter

from ballbot_gym import certified, files
from ballbot_gym.env import BallbotEnv
from ballbot_gym.robot import PAPER, Randomization, named_robot
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.identity import digest, problem_parts
from ballbot_train.evaluation import fresh, runner
from ballbot_train.evaluation.controllers import ControllerName
from ballbot_train.evaluation.results import Row, leaderboard, near_share, success_text
from ballbot_train.learning import VALIDATION_EPISODES
from ballbot_train.learning.datasets import metadata_of
from ballbot_train.policy.files import PolicyFile
from ballbot_train.policy.network import PolicyNetwork
from ballbot_train.policy.weights import own_defaults, saved_by_torch
from ballbot_train.work import jobs
from ballbot_train.work.console import console, progress_bar
from ballbot_train.work.provenance import provenance

_CONFIG = "config.json"
_VALIDATION_SEED, _CERTIFIED_SEED = 0, 1
_CHECKPOINT_LIMIT = 2**34  # bytes
_CHECKPOINT_SECONDS = float(os.environ.get("BALLBOT_CHECKPOINT_SECONDS", "60"))


class Learner(Protocol):
    """A learning algorithm as a sequence of iterations, each of about a second.

    `state_dict` holds everything that a later iteration depends on. So a resumed learner does exactly what it would have
    done without the interruption.

    It may also have `preparation`, the number of its first iterations that do something else, such as imitation: a policy of
    these iterations is the best one only until there is a later one. And `difficulty`, the state of its curriculum, by name.
    """

    iteration: int
    """Iterations done."""
    iterations: int
    """Iterations in all."""
    evaluations: int
    """Number of evaluations, at equal distances."""

    @property
    def network(self) -> PolicyNetwork:
        """The policy learned so far."""
        ...

    def iterate(self) -> dict[str, float]:
        """Does one iteration; returns figures to log by name."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """The learner's state: tensors and plain values."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes back to a state."""


_COLUMNS = (
    *("iteration", "seconds", "env_steps", "cpu_seconds"),
    *("cost_ratio", "regret_mean", "regret_median", "regret_worst", "success", "near", "failures"),
    *("validation_cost", "validation_success", "validation_near", "validation_failures", "validation_mean_cost"),
)
"""Of evaluations.csv."""


def score_and_validate(
    policy: Any,
    task: Task,
    robot: str = PAPER,
    episodes: int = VALIDATION_EPISODES,
    randomization: Randomization = Randomization(),
) -> dict[str, float]:
    """Measures a policy on the certified episodes and on the validation set, which shares none with others, in one batch.

    With a randomization the optima are those of its episodes. A policy is what `fresh.run_policy` takes.

    | figure | is |
    |---|---|
    | certified/cost_ratio | mean of cost / optimum; an episode without success costs at least as much as failing at once |
    | certified/regret_mean, regret_median, regret_worst | of cost / optimum − 1 of the episodes that did not fail |
    | certified/success, failures | share of the episodes that ended in success, and number of those that failed |
    | certified/near | share of those that ended in the goal or near it, within `results.NEAR` times its tolerances |
    | validation/cost | mean cost; an episode without success costs at least as much as failing at once |
    | validation/mean_cost | mean cost as it is, which ranks near misses where no episode succeeds |
    | validation/success, near, failures | as on the certified episodes |
    """
    known = certified.load(task, robot, randomization=randomization)
    count = len(known)
    x, c, robots = fresh.draw(task, range(episodes), _VALIDATION_SEED, "validation", robot, randomization)
    own = known.drawn
    if own.shape[1] != robots.shape[1]:  # the track moves no optimum
        own = fresh.draw(task, range(count), _CERTIFIED_SEED, "validation", robot, randomization)[2]
    drawn, states, constants = map(np.concatenate, ((own, robots), (known.states, x), (known.constants, c)))
    run = fresh.run_policy(policy, task, states, constants, drawn, robot, randomization)
    cost, success, failure = run.cost.double().numpy(), run.success.numpy(), run.failure.numpy()
    goal_error = run.goal_error.double().numpy()
    priced = fresh.priced(cost, success, task)
    standing = (cost[:count] / known.costs - 1)[~failure[:count]]
    mean, median, worst = (float(of(standing)) if standing.size else math.nan for of in (np.mean, np.median, np.max))
    return {
        "certified/cost_ratio": float((priced[:count] / known.costs).mean()),
        "certified/regret_mean": mean,
        "certified/regret_median": median,
        "certified/regret_worst": worst,
        "certified/success": float(success[:count].mean()),
        "certified/near": near_share(goal_error[:count], failure[:count]),
        "certified/failures": int(failure[:count].sum()),
        "validation/cost": float(priced[count:].mean()),
        "validation/success": float(success[count:].mean()),
        "validation/near": near_share(goal_error[count:], failure[count:]),
        "validation/failures": int(failure[count:].sum()),
        "validation/mean_cost": float(cost[count:].mean()),
    }


@own_defaults()
def train(
    learner: Learner,
    task: Task,
    config: Mapping[str, Any],
    out: Path,
    resume: bool = False,
    test_episodes: int = certified.EPISODES,
) -> Row:
    """Runs a learner to its end and measures the best policy in PyBullet. Ctrl-C saves and stops.

    Args:
        learner: before its first iteration.
        task: the task; it needs certified episodes.
        config: contents of config.json; a run resumes only with the same, but for the "command". Its "robot" names the
            robot, if it is not the paper's.
        out: folder of the run.
        resume: continue the run in `out`, if there is one.
        test_episodes: of the certified ones, on how many the policy is measured, from the first.

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
    run = _Run(learner, task, config, out)
    if (trained := learner.network.spec.robot) != run.robot:
        raise ValueError(f'the learner trains {trained!r}, and "robot" of config is {run.robot!r}; give both the same')
    if (out / _CONFIG).exists() and not resume:
        raise ValueError(f"{out} already holds a run; give --resume to continue it, or another --out")
    # a command names the folder, which may have been moved or copied, and every setting is compared without it
    compared = {name: value for name, value in config.items() if name != "command"}
    compared["problem"] = problem_parts(task, named_robot(run.robot))
    if config.get("start") is not None:
        compared["start_policy"] = PolicyFile(config["start"]).digest()
    if config.get("demos") is not None:
        compared["demonstrations"] = digest(metadata_of(config["demos"]))
    folder = jobs.RunFolder(out, _CONFIG)
    folder.claim(compared, {"command": config.get("command"), "about": provenance()})
    try:
        run.restore()
        run.learn()
        return run.measure(test_episodes)
    finally:
        folder.unlock()


class _Run:
    """The folder of a run."""

    def __init__(self, learner: Learner, task: Task, config: Mapping[str, Any], out: Path):
        self.learner, self.task, self.config, self.out = learner, task, dict(config), out
        self.seconds, self.cpu_seconds, self.env_steps = 0.0, 0.0, 0.0
        self.rows: list[dict[str, Any]] = []
        self.robot = self.config.get("robot", PAPER)
        self.randomization = Randomization.checked(self.config.get("randomization"))
        self.validation_episodes = self.config.get("validation_episodes", VALIDATION_EPISODES)

    def restore(self) -> None:
        """Goes back to the checkpoint, if there is one; a damaged one is a ValueError."""
        path = self.out / "checkpoint.pt"
        if not path.exists():
            return
        try:
            # tensors and plain values: nothing in it is executed
            state = saved_by_torch(files.read(path, _CHECKPOINT_LIMIT), path, _CHECKPOINT_LIMIT)
            self.learner.load_state_dict(state["learner"])
            best = PolicyNetwork(self.learner.network.spec)
            best.load_state_dict(state["policy"])
            self.seconds = float(state["seconds"])
            self.rows = [{name: row.get(name, math.nan) for name in _COLUMNS} for row in state["rows"]]
            self.cpu_seconds = float(state["cpu_seconds"])
        except MemoryError:
            raise
        except Exception as error:  # torch and the learners have dozens of ways to refuse a damaged state
            raise ValueError(f"{path} is damaged; give another --out or delete the folder ({error!r})") from error
        self._save_policy(best)
        self._write_rows()

    def learn(self) -> None:
        """Goes through the iterations that are left; Ctrl-C saves and raises a KeyboardInterrupt."""
        learner, name = self.learner, self.config["learner"]
        folder = str(self.out / "tensorboard")
        writer = SummaryWriter(folder, purge_step=learner.iteration)
        every = max(1, learner.iterations // learner.evaluations)
        saved = time.monotonic()
        console.print(f"to watch it learn: tensorboard --logdir {shlex.quote(folder)}", soft_wrap=True)
        with _interruptible() as interrupted, progress_bar() as progress:
            bar = progress.add_task(name, total=learner.iterations, completed=learner.iteration)
            if learner.iteration == 0:
                self.score()  # so that there is a policy, and learning curves show the start
            while learner.iteration < learner.iterations:
                start, cpu_start = time.monotonic(), time.process_time()
                figures = learner.iterate()
                self.seconds += time.monotonic() - start
                self.cpu_seconds += time.process_time() - cpu_start
                self.env_steps = figures.get("train/env_steps", math.nan)
                progress.update(bar, completed=learner.iteration)
                if learner.iteration % every == 0 or learner.iteration >= learner.iterations:
                    figures = figures | self.score()
                    progress.update(bar, description=f"{name} {self.best_text}")
                for figure, value in figures.items():
                    writer.add_scalar(figure, value, learner.iteration)
                if time.monotonic() - saved > _CHECKPOINT_SECONDS or interrupted():
                    self.save()
                    saved = time.monotonic()
                if interrupted():
                    raise KeyboardInterrupt
        self.save()
        writer.close()

    def score(self) -> dict[str, float]:
        """Scores the present policy on both sets, and keeps it if it is the best on the validation set.

        Returns:
            The figures by their name in TensorBoard.
        """
        network = self.learner.network
        figures = score_and_validate(network, self.task, self.robot, self.validation_episodes, self.randomization)
        row = {
            "iteration": self.learner.iteration,
            "seconds": round(self.seconds, 1),
            "env_steps": self.env_steps,
            "cpu_seconds": round(self.cpu_seconds, 1),
        }
        named = {name.removeprefix("certified/").replace("/", "_"): value for name, value in figures.items()}
        self.rows.append(row | named)
        self._write_rows()
        if self._chosen is self.rows[-1]:
            self._save_policy(network)
        return figures

    @property
    def _chosen(self) -> dict[str, Any]:
        """The evaluation whose policy is kept."""
        preparation = getattr(self.learner, "preparation", 0)
        later = [row for row in self.rows if not preparation or row["iteration"] > preparation]
        return min(later or self.rows, key=lambda row: (row["validation_cost"], row["validation_mean_cost"]))

    @property
    def best_text(self) -> str:
        """The best policy so far, for the progress bar: regret on the certified episodes, the rest on those of validation."""
        best = self._chosen
        regret = "no regret yet" if math.isnan(best["regret_mean"]) else f"{best['regret_mean']:.1%} regret"
        failures = f"{best['validation_failures']} of {self.validation_episodes} fail"
        success = success_text(best["validation_success"], best.get("validation_near", math.nan))
        return f"{regret}, {success} success, {failures}"

    def save(self) -> None:
        """Writes the checkpoint, with the best policy in it, so that both are of the same iteration."""
        state = {
            "learner": self.learner.state_dict(),
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
            "rows": self.rows,
            "policy": PolicyNetwork.load(self.out / "policy", self.task, self.robot).state_dict(),
        }
        buffer = io.BytesIO()
        torch.save(state, buffer)
        files.write(self.out / "checkpoint.pt", buffer.getvalue())

    def measure(self, count: int) -> Row:
        """Measures the best policy on the first certified episodes in PyBullet, and adds the result to its JSON file."""
        network = PolicyNetwork.load(self.out / "policy", self.task, self.robot)
        env = BallbotEnv(self.task, robot=self.robot, randomization=self.randomization)
        controller = ControllerName(str(self.out / "policy.json")).make(self.task, env.params)
        results = runner.run_episodes(env, controller, self.config["learner"], self.config["task"], range(count))
        env.close()
        (row,) = leaderboard(results)
        figures = ("episodes", "success", "falls", "regret_mean", "regret_median")
        measured = {name: getattr(row, name) for name in figures}
        self._save_policy(network, measured={"episodes_are": "certified", "physics": env.physics} | measured)
        return row

    def _save_policy(self, network: PolicyNetwork, **more: Any) -> None:
        network.spec = network.spec.on(self.task, self.robot)
        reached = getattr(self.learner, "difficulty", {})
        about = {
            "training": self.config,
            "chosen_by": {
                "episodes": f"{self.validation_episodes} fresh, for validation",
                "cost": self._chosen["validation_cost"],
            },
            "iteration": self._chosen["iteration"],
            "training_seconds": round(self.cpu_seconds, 1),
            **({"curriculum_reached": reached} if reached else {}),
        }
        network.save(self.out / "policy", about | more)

    def _write_rows(self) -> None:
        files.write_csv(self.out / "evaluations.csv", self.rows)


@contextmanager
def _interruptible() -> Iterator[Any]:
    """Yields a function that says whether the run is to stop: after Ctrl-C, or SIGTERM, as cluster schedulers send it.

    The first of them interrupts nothing; a second one does. Python delivers signals to the main thread alone, so in another
    thread nothing is caught.
    """
    pressed: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return

    def on_signal(number: int, frame: object) -> None:
        if pressed:
            raise KeyboardInterrupt
        pressed.append(number)
        again = "press Ctrl-C again" if number == signal.SIGINT else "send the signal again"
        console.print(f"saving; {again} to stop at once")

    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    # of a program in which Python is embedded we could not restore the handler
    before = {number: handler for number, handler in handlers.items() if handler is not None}
    for number in before:
        signal.signal(number, on_signal)
    try:
        yield lambda: bool(pressed)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
