"""Demonstrations: episodes of an expert with exploration, as Minari datasets.

In every control step the expert is asked for its action, and the robot executes this action plus noise. Sometimes a push, a
random force for one control step, replaces the action. The expert then plans again from the state after the push. So the
dataset contains recoveries too.

| in the dataset | is |
|---|---|
| actions (T, 2) | the executed actions; the env, reset with the episode's seed, replays the episode from them |
| infos/expert_action (T, 2) | the expert's actions in the visited states: the labels to imitate |
| infos/state (T+1, 8) | states; order and units in `Ballbot.STATE` |
| an episode's metadata | seed, expert, physics, cost, success, failure and the following |

`plans` counts the expert's plans, and `plans_failed` its searches that found none.

`load_demos` reads a dataset for learners. `write_shards` makes shards instead of a dataset.
"""

import importlib.metadata
import inspect
import json
import math
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast
from unittest.mock import patch

import gymnasium
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_dataset import parse_dataset_id

from ballbot_baselines import CONTROLLERS, Backoff
from ballbot_baselines.feedback.trajopt import EXECUTED
from ballbot_gym import certified, files, seeding
from ballbot_gym.engines import checked_physics
from ballbot_gym.env import BallbotEnv, make_task
from ballbot_gym.registry import own_robot
from ballbot_gym.robot import PAPER, Robot, named_robot
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task
from ballbot_train.evaluation.controllers import ControllerName
from ballbot_train.learning.datasets import IN_DATASET, metadata_of
from ballbot_train.policy.files import OBSERVATION_VERSION, PolicyFile, shipped_policies
from ballbot_train.work import jobs, shards
from ballbot_train.work.console import check_names
from ballbot_train.work.executors import Workers

_LONGER = ("observations", "states")  # than the others by one, of an episode
_MOST_EPISODES = 1_000_000


@dataclass(frozen=True)
class DemoConfig:
    """Settings of a dataset."""

    task: str = "stabilize"
    """Name of a task."""
    expert: str = "trajopt"
    """Name of a controller, as trajopt (a plan, tracked by TVLQR), nmpc or lqr, or of a shipped policy."""
    episodes: int = 200
    """Number of episodes."""
    physics: Literal["bullet", "mujoco", "rk4"] | None = None
    """Simulator; default, the first that is installed and simulates the robot."""
    noise: float = 0.05
    """Exploration: each episode draws the standard deviation of its noise from [0, this], in units of the force limit."""
    pushes: float = 0.5
    """Mean number per second of control steps in which a random force replaces the expert's."""
    backoff: Backoff = EXECUTED
    """What the expert's plans keep from their limits; experts that take no back-off ignore it."""
    seed: int = 0
    """Seed of the dataset."""
    robot: str = PAPER
    """Name of a robot in `ROBOTS`; default, the robot that the task names."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "robot", own_robot(self.task, self.robot))
        object.__setattr__(self, "physics", checked_physics(self.physics, named_robot(self.robot)))
        task = make_task(self.task, self.robot)
        check_names("expert", [self.expert], ControllerName.known(task, self.robot))
        if not 1 <= self.episodes <= _MOST_EPISODES:
            raise ValueError(f"episodes must be 1 to {_MOST_EPISODES}, not {self.episodes}")
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"seed must be 0 to {2**32 - 1}, not {self.seed}")
        for name in ("noise", "pushes"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be finite and at least 0, not {getattr(self, name)}")
        most = round(1 / task.control_dt)
        if self.pushes > most:
            raise ValueError(f"pushes must be at most {most} per second, one in every control step, not {self.pushes}")

    def episode_seed(self, i: int) -> int:
        """Seed with which the env is reset in episode i."""
        return seeding.of_episode(self.seed + 1, i)


class Expert:
    """A controller as a teacher: it gives its action in states of an episode that others control, and replans on request."""

    def __init__(self, name: str, task: Task, params: Robot, backoff: Backoff = EXECUTED):
        """Args: name: as in `DemoConfig`; backoff: given to a controller whose constructor takes one."""
        controller: Any = ControllerName(name).make(task, params)
        if "backoff" in inspect.signature(type(controller)).parameters:
            controller = cast(Any, CONTROLLERS[name])(task, params, backoff=backoff)
        self._task, self._params, self._controller = task, params, controller
        self.plans = self.plans_failed = 0

    def reset(self, t: float, x: np.ndarray, c: np.ndarray) -> None:
        """Starts an episode at time t, s, in state x (8,) with constants c (nc,); raises a PlanError without a plan."""
        self._c, self._start = c, t
        self._controller.reset(t, x, c)
        self.plans, self.plans_failed = 1, 0

    def replan(self, t: float, x: np.ndarray) -> None:
        """Plans again from state x (8,); keeps the old plan if there is no new one. Experts without plans do nothing."""
        controller = self._controller
        if not hasattr(controller, "plan"):
            return
        plan = controller.plan
        try:
            controller.reset(t, x, self._c)
            self.plans, self._start = self.plans + 1, t
        except PlanError:
            controller.plan = plan
            self.plans_failed += 1

    def label(self, t: float, x: np.ndarray) -> np.ndarray:
        """(2,) float32 action in [−1, 1] that the expert would take in state x (8,)."""
        plan = getattr(self._controller, "plan", None)
        ended = self._task.first_exit and plan is not None and t - self._start > plan.trajectory.duration - 1e-9
        if ended and not self.plans_failed:  # and the goal is not reached
            self.replan(t, x)
        force = self._controller.act(t, x)
        return np.clip(force / self._params.force_limit, -1, 1).astype(np.float32)

    def record(
        self,
        env: BallbotEnv,
        rng: np.random.Generator,
        noise: float,
        pushes: float,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Records an episode under noise and pushes.

        Args:
            env: the environment.
            rng: of the exploration.
            noise: as in `DemoConfig`; the episode's standard deviation is drawn from [0, noise].
            pushes: as in `DemoConfig`.
            seed: as for `env.reset`.
            options: as for `env.reset`.

        Returns:
            The arrays of a shard of this episode of T steps, and the last step's info:

            | array | shape | |
            |---|---|---|
            | observations | (T+1, no) float32 | |
            | states | (T+1, 8) | order and units in `Ballbot.STATE` |
            | labels | (T, 2) float32 | the expert's actions, in [−1, 1] |
            | actions | (T, 2) float32 | executed |
            | rewards | (T,) | |
            | terminations, truncations | (T,) bool | |

        Raises:
            PlanError: the expert has no plan from the start.
        """
        dt = env.task.control_dt
        observation, info = env.reset(seed=seed, options=options)
        self.reset(0.0, info["state"], info["constants"])
        std = noise * rng.random()
        made: dict[str, list[Any]] = {name: [] for name in IN_DATASET}
        made["observations"].append(observation)
        made["states"].append(info["state"])
        pushed = done = False
        while not done:
            t = dt * len(made["actions"])
            if pushed:
                self.replan(t, info["state"])
            label = self.label(t, info["state"])
            pushed = rng.random() < pushes * dt
            disturbed = rng.uniform(-1, 1, len(label)) if pushed else label + std * rng.standard_normal(len(label))
            action = np.clip(disturbed, -1, 1).astype(np.float32)
            observation, reward, terminated, truncated, info = env.step(action)
            done = terminated or truncated
            step = observation, info["state"], label, action, reward, terminated, truncated
            for values, value in zip(made.values(), step, strict=True):
                values.append(value)
        return {name: np.array(values) for name, values in made.items()}, info


def _content(config: DemoConfig) -> dict[str, Any]:
    """What decides a dataset behind the names that its settings give."""
    content = {"problem": certified.named_problem(config.task, config.robot)}
    if ControllerName(config.expert).is_expert:
        return content
    shipped = shipped_policies(make_task(config.task, config.robot), config.robot)
    return content | {"expert_policy": PolicyFile(shipped[config.expert]).digest()}


def write_demos(config: DemoConfig, out: Path, workers: int | Workers) -> Path:
    """Makes a dataset in parallel processes. A killed run continues when it is started again.

    Args:
        config: settings of the dataset.
        out: folder of the dataset, named by its id, NAME-vNUMBER. It appears when the dataset is complete.
        workers: a number of processes, or `Workers`.

    Returns:
        The folder.

    Raises:
        ValueError: `out` is not named as a dataset, or holds another one.
        PlanError: no episode could be started.
    """
    out = Path(out).absolute()
    try:
        parse_dataset_id(out.name)
    except (ValueError, TypeError):
        raise ValueError(f"a dataset's folder is named NAME-vNUMBER, as stabilize-trajopt-v0, not {out.name}") from None
    described = asdict(config) | _content(config)
    unfinished = out.with_name(f".{out.name}.unfinished")
    if out.exists():
        metadata = metadata_of(out)
        # older ones have no digest
        held = metadata["demos"] | {name: metadata.get(name, described[name]) for name in _content(config)}
        jobs.check_same(held, described, out, "a dataset")
        shutil.rmtree(unfinished, ignore_errors=True)  # a kill may have left it
        return out
    Workers.of(workers)
    folder = jobs.RunFolder(unfinished, "dataset.json")
    folder.claim(described)
    try:
        made = write_shards(config, str(unfinished / "set"), unfinished / "episodes", workers)
        _assemble(config, made, unfinished, out)
        shutil.rmtree(unfinished, ignore_errors=True)
    finally:
        folder.unlock()
    return out


def write_shards(
    config: DemoConfig,
    url: str,
    out: Path,
    workers: int | Workers,
    per_shard: int = shards.EPISODES,
) -> shards.Shards:
    """Makes a dataset of any size as shards, which `load_demos` reads. A killed run continues.

    Args:
        config: settings of the dataset. Its number of episodes may grow later.
        url: folder of the set, on this machine or on storage, see `shards`.
        out: folder of this machine for what is unfinished.
        workers: a number of processes, or `Workers`.
        per_shard: episodes of a shard.

    Raises:
        ValueError: `url` holds another set.
    """
    described = asdict(config)
    del described["episodes"]
    about = {
        "demos": described,
        "task": repr(make_task(config.task, config.robot)),
        "observation_version": OBSERVATION_VERSION,
        **_content(config),
    }
    named = f"{config.task} {config.expert}"
    return shards.Shards.make(url, about, config.episodes, partial(_recorded, config), out, workers, named, per_shard)


def _recorded(config: DemoConfig, episodes: Sequence[int]) -> dict[str, np.ndarray]:
    """Episodes as arrays of a shard: those of their recordings, one after another, with lengths and metadata (JSON)."""
    env = BallbotEnv(config.task, physics=config.physics, robot=config.robot)
    expert = Expert(config.expert, env.task, env.params, config.backoff)
    recorded, about = [], []
    for seed in map(config.episode_seed, episodes):
        rng = np.random.default_rng([seed, 1])  # other numbers than the env's
        try:
            recording, info = expert.record(env, rng, config.noise, config.pushes, seed)
        except PlanError:  # the expert has no plan from this start
            continue
        facts = {
            "seed": seed,
            "expert": config.expert,
            "physics": config.physics,
            "cost": env.task.survival_pay - float(recording["rewards"].sum()),
            "success": bool(info["success"]),
            "failure": bool(info["failure"]),
            "plans": expert.plans,
            "plans_failed": expert.plans_failed,
        }
        recorded.append(recording)
        about.append(json.dumps(facts))
    env.close()
    if not recorded:
        return {}
    return {
        **{name: np.concatenate([part[name] for part in recorded]) for name in IN_DATASET},
        "lengths": np.array([len(part["actions"]) for part in recorded], np.int64),
        "about": np.array(about, str),
    }


def _assemble(config: DemoConfig, made: shards.Shards, unfinished: Path, out: Path) -> None:
    """Writes the dataset under a temporary name, and renames it."""
    parts = [arrays for arrays in made if arrays]
    if not parts:
        raise PlanError(f"{config.expert} found no plan in any of {config.episodes} episodes; give another expert")
    about = [json.loads(text) for arrays in parts for text in arrays["about"].tolist()]
    root = unfinished / "datasets"
    shutil.rmtree(root, ignore_errors=True)
    task = make_task(config.task, config.robot)
    env = gymnasium.make(task.id, physics=config.physics, robot=config.robot)
    # Minari offers no other way to choose the folder
    with closing(env), patch.dict(os.environ, MINARI_DATASETS_PATH=str(root)), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*is set to None.*")  # the authors, which a run does not have
        dataset = minari.create_dataset_from_buffers(
            dataset_id=out.name,
            buffer=[each for arrays in parts for each in _buffers(arrays)],
            env=env,
            algorithm_name=config.expert,
            description=f"{config.expert} on {task.id}, with exploration; see ballbot_train.learning.demonstrations.",
            requirements=[f"ballbot-gym>={importlib.metadata.version('ballbot-gym')}"],
            data_format="hdf5",
            **_scores(task, config.robot),
        )
    dataset.storage.update_episode_metadata(about)
    dataset.storage.update_metadata(
        {
            "task": repr(task),
            "observation_version": OBSERVATION_VERSION,
            "demos": asdict(config),
            **_content(config),
        }
    )
    (root / out.name).rename(out)


def _scores(task: Task, robot: str) -> dict[str, float]:
    """Mean returns of random actions and of the optima, by which Minari normalizes scores; of the shipped tasks alone."""
    path = Path(certified.__file__).with_name("scores.json")
    return files.read_json(path).get(task.id, {}) if robot == PAPER else {}


def _buffers(arrays: Mapping[str, np.ndarray]) -> Iterator[EpisodeBuffer]:
    """The episodes of a shard's arrays."""
    end = 0
    for k, length in enumerate(arrays["lengths"].tolist()):
        start, end = end, end + length
        cut: dict[str, Any] = {  # Minari's annotations say lists
            name: arrays[name][start + k : end + k + 1] if name in _LONGER else arrays[name][start:end]
            for name in IN_DATASET
        }
        infos = {"expert_action": cut.pop("labels"), "state": cut.pop("states")}
        yield EpisodeBuffer(seed=json.loads(arrays["about"][k])["seed"], infos=infos, **cut)
