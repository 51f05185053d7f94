"""What PPO and SAC share: stages of training, the envs they train on, imitation, and their actors as policies."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import NStepReplayBuffer, RolloutBuffer
from stable_baselines3.common.logger import Logger
from torch import nn

from ballbot_gym.robot import Robot
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.symmetry import REACH, Frame
from ballbot_gym.vector import BallbotVectorEnv
from ballbot_gym.vector.batch import BallbotBatch, BatchState
from ballbot_train.evaluation.fresh import make_envs
from ballbot_train.learning.actors import Symmetry, average_of
from ballbot_train.learning.critics import cost_to_go
from ballbot_train.learning.curricula import CurriculumBatch
from ballbot_train.learning.datasets import Demos, _seen_in
from ballbot_train.learning.fitting import Fit, Samples
from ballbot_train.learning.sb3 import BallbotVecEnv
from ballbot_train.learning.settings import MOST, MOST_ENVS, Settings, number
from ballbot_train.learning.state import load_state, state_of
from ballbot_train.policy.network import PolicyNetwork


@dataclass(frozen=True)
class ModelFreeConfig(Settings):
    """Settings that PPO and SAC share."""

    iterations: int = number(400, 1, MOST)
    """Iterations of `num_envs * num_steps` env steps."""
    evaluations: int = number(20, 1, MOST)
    """Evaluations, at equal distances."""
    num_envs: int = number(512, 1, MOST_ENVS)
    """Envs that are stepped together."""
    num_steps: int = number(96, 1, 10**6)
    """Control steps of each env per iteration."""
    episode_seconds: float = number(8.0, 0)
    """Duration in training, s. The rest is bootstrapped."""
    short_episodes: tuple[float, float] = number((0.0, 0.6), 0)
    """Share of the episodes that is cut, and after how many s."""
    gamma: float = number(0.99, 0, 1)
    """Discount per control step of 0.02 s."""
    final_gamma: float = number(0.995, 0, 1)
    """Discount at the end; 1 less it falls geometrically."""
    hidden: tuple[int, ...] = number((64, 64), 1, 2**14)
    """Units of hidden layers."""
    symmetry: Symmetry = "none"
    """What the actor keeps of the task's symmetry."""
    learning_rate: float = number(2e-3, above=0)
    """Learning rate; it falls linearly."""
    final_learning_rate_fraction: float = number(0.05, 0)
    """That at the end, as a fraction."""
    batch_size: int = number(3072, 1, MOST)
    """Env steps per gradient step."""
    std: float = number(0.2, above=0)
    """Standard deviation of actions in ±1 at the start."""

    def check(self) -> None:
        super().check()
        self.check_memory(self.num_envs, self.num_steps)


_REWARD_SCALE = 0.02  # of rewards that pay for living
_COST_SCALE = 0.05  # of those that are minus the cost alone, which are smaller
_AVERAGED_ITERATIONS = 10  # over which the policy is a running average of the actor
_CLONE_ITERATIONS, _CLONE_STEPS, _CLONE_BATCH, _CLONE_RATE = 60, 300, 1024, 2e-3  # the rate falls linearly to 0
_WAITING_PROGRESS = 0.2  # share of their course at which schedules wait until training backwards has come to the task
_SETTLED_LEARNING_RATE = 7e-4  # when it has come there, from where it falls to the same end
_WARMUP_ITERATIONS = 15  # of the critic alone, after a warm start: an untrained one would spoil the actor


Bootstrap = Callable[[np.ndarray], np.ndarray]
"""From last observations (n, no) to their discounted values (n,)."""

_STATE = ("iteration", "_average", "_imitation", "_settled", "_env", "_random")


class ModelFree(ABC):
    """What PPO and SAC have in common; see `training.Learner`.

    With demonstrations there are three stages. First the actor imitates the expert's actions (behaviour cloning). Then the
    critic alone is trained, because the gradient of an untrained critic would undo the imitation. Then actor and critic are
    trained by reinforcement learning. In this stage the gradient of an imitation loss is added to every step of the actor,
    with a weight that falls to 0. A policy to start from takes the place of the first stage, and there is nothing to imitate.

    On a task that ends at its goal, after a warm start or backwards, the reward is minus the cost: living would pay for
    missing the goal.

    A resumed run does exactly what it would have done; only the success rate of the last hundred episodes restarts.
    """

    _imitation_weight: float
    """Of the imitation loss, the mean squared difference of the actions, at the start."""

    def __init__(
        self,
        task: Task,
        params: Robot,
        config: ModelFreeConfig,
        demos: Demos | None,
        warm: bool,
        frame: Frame | None = None,
        reach: float = REACH,
        control_dt: float | None = None,
        backwards: bool = False,
        **world: Any,
    ):
        """Args:
        demos: to imitate.
        warm: whether training starts from them or from a policy.
        frame: in which the envs show observations and take actions; demos must be of it already.
        reach: factor of the actions in the frame.
        control_dt: how long each force is held in training, s; default, as in the task.
        backwards: see `CurriculumBatch`.
        world: randomization and history, see `BallbotBatch`.

        Raises:
            ValueError: the task does not have what the settings ask for, or a discount factor is none.
        """
        for name in ("gamma", "final_gamma"):
            if not 0 < getattr(config, name) < 1:
                raise ValueError(f"{name} must be between 0 and 1, not {getattr(config, name):g}")
        self.iteration, self._settings, self._task, self._warm = 0, config, task, warm
        self._demos = None if demos is None else Samples.of(demos.observations, demos.actions)
        self._trained = task if control_dt is None else replace(task, control_dt=control_dt)
        self._pay = not (backwards or (warm and task.first_exit))
        self._reward_scale = _REWARD_SCALE if self._pay else _COST_SCALE
        self._gamma = self._per_step(config.gamma)
        self._settled: float | None = None  # share of the iterations after which the curriculum was over
        self._clone_iterations = 0 if demos is None else _CLONE_ITERATIONS
        self.iterations, self.evaluations = config.iterations + self._clone_iterations, config.evaluations
        shorter = replace(self._trained, duration=config.episode_seconds)
        self._curriculum = None
        if not self._pay:
            self._curriculum = CurriculumBatch(
                shorter, config.num_envs, params, self._gamma, self._trained, backwards, **world
            )
        self._env = _TrainingEnv(
            self._curriculum or make_envs(config.num_envs, shorter, not world, params=params, **world),
            self._reward_scale,
            frame,
            reach,
            config.short_episodes,
        )

    def _set_model(
        self,
        model: BaseAlgorithm,
        actor: PolicyNetwork,
        start: PolicyNetwork | None,
        optimizers: Sequence[torch.optim.Optimizer],
        buffer: RolloutBuffer | NStepReplayBuffer,
        value_biases: Sequence[torch.Tensor],
    ) -> None:
        """Takes SB3's model and parts of it.

        Args:
            model: PPO or SAC.
            actor: the network of the mean action.
            start: of the actor's shape, whose weights it takes.
            optimizers: the actor's first.
            buffer: of what the actor met.
            value_biases: of the outputs of all critics.
        """
        self._model: Any = model  # PPO or SAC, which both have a gamma
        self._actor, self._optimizers, self._buffer, self._value_biases = actor, optimizers, buffer, value_biases
        if start is not None:
            actor.load_state_dict(start.state_dict())
        with torch.no_grad():
            for bias in value_biases:
                bias.fill_(self._value_of_living(self._gamma))
        self._average = average_of(actor, _AVERAGED_ITERATIONS)
        model.set_logger(Logger(folder=None, output_formats=[]))
        model._last_obs = self._env.reset()
        model._last_episode_starts = np.ones(self._settings.num_envs, bool)
        self._imitation = None if self._demos is None else Fit(actor, self._act)
        optimizers[0].register_step_pre_hook(self._add_imitation)
        self._random = _global_random()

    def _per_step(self, gamma: float) -> float:
        """The discount factor for a control step in training, from that for a control step of the task."""
        return gamma ** (self._trained.control_dt / self._task.control_dt)

    def _value_of_living(self, gamma: float) -> float:
        """Value of living indefinitely without cost: the discounted sum of scaled rewards. Without a discount, that of living
        for the task's duration. 0 where living does not pay.

        Critics start from it, because the values of good policies are near it and far from 0.
        """
        paid = self._reward_scale * self._trained.survival_reward * self._trained.control_dt if self._pay else 0.0
        return paid / (1 - gamma) if gamma < 1 else paid * self._trained.steps

    @property
    def _value_without_costs(self) -> float:
        """What the critics learn of a state without any cost from then on."""
        return self._value_of_living(self._model.gamma)

    def _weigh(self, _critics: nn.Module, _inputs: Any, values: Any) -> None:
        """A forward hook of critics: divides gradients that flow back into their values (n, 1), a tensor or several, by the
        cost to go, as the lowest say it. The mean of all n factors is 1.
        """
        several = (values,) if isinstance(values, torch.Tensor) else values
        if not several[0].requires_grad:
            return
        lowest = torch.stack([value.detach() for value in several]).amin(0)
        weights = cost_to_go(lowest, self._value_without_costs) ** -1
        weights /= weights.mean()
        for value in several:
            value.register_hook(lambda gradient: gradient * weights)

    @property
    def network(self) -> PolicyNetwork:
        """The running average of the actor; while it is cloned, the actor."""
        cloned = self.iteration <= self._clone_iterations
        return self._actor if cloned else cast(PolicyNetwork, self._average.module)

    @abstractmethod
    def _act(self, seen: torch.Tensor) -> torch.Tensor:
        """The mean actions (n, 2) of the actor for observations (n, no), both as the envs show them."""

    def _raise_gamma(self, gamma: float) -> None:
        """Sets the discount factor, and moves all values by the change of the value of living indefinitely."""
        more = self._value_of_living(gamma) - self._value_of_living(self._model.gamma)
        with torch.no_grad():
            for bias in self._value_biases:
                bias.add_(more)
        self._take_gamma(gamma)

    def _take_gamma(self, gamma: float) -> None:
        """Gives the discount factor to all that have a copy of it."""
        self._model.gamma = self._buffer.gamma = gamma
        if self._curriculum:
            self._curriculum.gamma = gamma

    @property
    def preparation(self) -> int:
        """Iterations that imitate demonstrations, and of the critic alone."""
        return self._clone_iterations + (_WARMUP_ITERATIONS if self._warm else 0)

    @property
    def difficulty(self) -> dict[str, float]:
        """How far the curriculum has come."""
        return self._curriculum.difficulty if self._curriculum else {}

    def iterate(self) -> dict[str, float]:
        # Stable-Baselines3 uses the global generators, and others may have used them since the last iteration
        torch.set_rng_state(self._random["torch"])
        np.random.set_state(self._random["numpy"])
        figures = self._clone() if self.iteration < self._clone_iterations else self._improve()
        self._random = _global_random()
        self.iteration += 1
        return figures

    def state_dict(self) -> dict[str, Any]:
        model = self._model
        return {
            **state_of(self, _STATE),
            "policy": model.policy.state_dict(),
            "optimizers": [optimizer.state_dict() for optimizer in self._optimizers],
            "env_steps": model.num_timesteps,
            "gamma": model.gamma,
            "observations": torch.as_tensor(model._last_obs),
            "starts": torch.as_tensor(model._last_episode_starts),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        model = self._model
        load_state(self, _STATE, state)
        model.policy.load_state_dict(state["policy"])
        for optimizer, old in zip(self._optimizers, state["optimizers"], strict=True):
            optimizer.load_state_dict(old)
        model.num_timesteps = state["env_steps"]
        self._take_gamma(state["gamma"])
        model._last_obs, model._last_episode_starts = state["observations"].numpy(), state["starts"].numpy()

    @property
    def _share_done(self) -> float:
        """Share of the iterations of reinforcement learning that are done."""
        return (self.iteration - self._clone_iterations) / self._settings.iterations

    @property
    def _progress(self) -> float:
        """Share of their course that the schedules are through. They wait until a curriculum is over, because learning needs
        the initial noise until then.
        """
        if self._settled is None:
            return min(self._share_done, _WAITING_PROGRESS)
        begun = min(self._settled, _WAITING_PROGRESS)
        return begun + (1 - begun) * self._since_settled

    @property
    def _since_settled(self) -> float:
        """Share that is done of the iterations since the curriculum was over."""
        return 0.0 if self._settled is None else (self._share_done - self._settled) / (1 - self._settled)

    @property
    def _learning_rate(self) -> float:
        """The learning rate now. Large steps find the way backwards, and small ones then bring costs down."""
        rate, fraction = self._settings.learning_rate, self._settings.final_learning_rate_fraction
        if self._settled is not None and self.difficulty:
            settled = _SETTLED_LEARNING_RATE
            return _linear(settled, fraction * rate / settled, self._since_settled)
        return _linear(rate, fraction, self._progress)

    @property
    def _critic_only(self) -> bool:
        return self.iteration < self.preparation

    def _clone(self) -> dict[str, float]:
        """One iteration of behaviour cloning."""
        assert self._imitation is not None
        assert self._demos is not None
        rng = np.random.default_rng(int(torch.randint(2**31, ())))
        rate = _linear(_CLONE_RATE, 0.0, self.iteration / self._clone_iterations)
        return {"loss/cloning": self._imitation.run(self._demos, _CLONE_STEPS, _CLONE_BATCH, rate, rng)}

    def _improve(self) -> dict[str, float]:
        """One iteration of reinforcement learning."""
        settings, model = self._settings, self._model
        if self._settled is None and (self._curriculum is None or self._curriculum.is_settled):
            self._settled = self._share_done
        # 1 less the discount factor falls geometrically
        short, shortest = 1 - settings.gamma, 1 - settings.final_gamma
        self._raise_gamma(self._per_step(1 - short * (shortest / short) ** self._progress))
        self._actor.requires_grad_(not self._critic_only)
        # SB3 takes None as "never" for its own printing
        model.learn(settings.num_envs * settings.num_steps, log_interval=cast(int, None), reset_num_timesteps=False)
        self._actor.requires_grad_(True)
        self._average.update_parameters(self._actor)
        reached = {f"curriculum/{name}": value for name, value in self.difficulty.items()}
        return {
            **model.logger.name_to_value,
            "train/env_steps": model.num_timesteps,
            "train/gamma": model.gamma,
            **reached,
        }

    def _add_imitation(self, *_: object) -> None:
        """Adds the gradient of the imitation loss, in demonstrated states that are drawn, to that of a step of the actor."""
        if self._demos is not None and not self._critic_only:
            drawn = torch.randint(len(self._demos), (_CLONE_BATCH,))
            actions = self._act(self._demos.observations[drawn])
            loss = nn.functional.mse_loss(actions, self._demos.actions[drawn])
            (self._imitation_weight * (1 - self._progress) * loss).backward()


class _TrainingEnv(BallbotVecEnv):
    """Envs for learning, with scaled rewards.

    Their episodes may be shorter than the task's, and the optimal policy stays the same. An episode that runs out of time is
    truncated, and the learners bootstrap from the value of its last state; so shorter episodes only leave out rest, which
    teaches little. A share of them may be cut soon after the start, so that more of the samples are of starts, where most of
    a good policy's regret arises.
    """

    def __init__(
        self,
        envs: BallbotVectorEnv | CurriculumBatch,
        reward_scale: float,
        frame: Frame | None = None,
        reach: float = REACH,
        short_episodes: tuple[float, float] = (0.0, 0.6),
    ):
        """Takes the envs.

        Args:
            envs: the envs, or those of a curriculum.
            reward_scale: factor of every reward.
            frame: in which observations are shown and actions taken; default, the task's own.
            reach: factor of the actions in the frame.
            short_episodes: share of the episodes that is cut, and how long these last, s.

        Raises:
            ValueError: short episodes of a task that pays at its goal for the time that is left.
        """
        if isinstance(envs, CurriculumBatch):
            batch, world = envs, {"randomization": envs.randomization, "history": envs.history}
            envs = BallbotVectorEnv(
                batch.num_envs, batch.own_task, params=batch.params, compile=False, engine="torch", **world
            )
            envs.batch = batch
        super().__init__(envs)
        self.batch: Any = envs.batch
        self._in_torch = isinstance(self.batch, BallbotBatch)
        share, seconds = short_episodes
        if not (0 <= share <= 1 and seconds > 0):
            raise ValueError(f"short_episodes must be a share of 0 to 1 and seconds above 0, not {short_episodes}")
        if share and envs.task.first_exit:
            raise ValueError(
                f"{envs.task.id} pays at its goal for the time that is left, so the share of short_episodes must be 0"
            )
        self._short_share = share
        self._short_steps = envs.task.steps - max(1, round(seconds / envs.task.control_dt))
        self._scale = np.float32(reward_scale)
        self.bootstrap: Bootstrap | None = None
        """If set, `step_wait` adds what it returns, and SB3 does not call the critic once for each episode."""
        self._frame, self._reach, self._axes = frame, reach, np.zeros(0)
        if frame is not None:
            self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (frame.size,), np.float32)

    def reset(self) -> np.ndarray:
        """Starts an episode in every env, with step counts that differ so that the episodes never end together."""
        observation = super().reset()
        self._set_steps(np.arange(self.num_envs) * self.env.task.steps // self.num_envs)
        return self._seen(observation)

    def _set_steps(self, steps: np.ndarray) -> None:
        """Sets the clocks (num_envs,) of the episodes, which no observation shows."""
        batch = self.batch
        batch.state = batch.state._replace(steps=torch.from_numpy(steps) if self._in_torch else steps)

    def step_async(self, actions: np.ndarray) -> None:
        super().step_async(actions if self._frame is None else _to_world(self._axes, self._reach * actions))

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        observation, reward, done, infos = super().step_wait()
        reward = self._scale * reward
        if self._short_share:
            short = done & (np.random.random(self.num_envs) < self._short_share)
            steps = np.asarray(self.batch.state.steps)
            self._set_steps(np.where(short, np.maximum(steps, self._short_steps), steps))
        ended = np.flatnonzero(done).tolist()
        if self._frame is not None and ended:
            last, _ = _seen_in(self._frame, np.stack([infos[i]["terminal_observation"] for i in ended]))
            for i, seen in zip(ended, last, strict=True):
                infos[i]["terminal_observation"] = seen
        if self.bootstrap is not None:
            self._add_last_values(self.bootstrap, reward, infos)
        return self._seen(observation), reward, done, infos

    @staticmethod
    def _add_last_values(bootstrap: Bootstrap, reward: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """Adds the value of the last observation to the reward of all episodes that ran out of time, in one call."""
        truncated = [i for i, info in enumerate(infos) if info.get("TimeLimit.truncated")]
        if truncated:
            reward[truncated] += bootstrap(np.stack([infos[i]["terminal_observation"] for i in truncated]))
        for i in truncated:
            infos[i]["TimeLimit.truncated"] = False  # so that SB3 does not add it again

    def state_dict(self) -> dict[str, Any]:
        """State of every env: tensors and plain values."""
        state = {name: torch.as_tensor(part) for name, part in self.batch.state._asdict().items()}
        curriculum = self.batch.curriculum_state() if isinstance(self.batch, CurriculumBatch) else {}
        return {"batch": state, "curriculum": curriculum}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes back to a state."""
        parts: Any = state["batch"]
        if not self._in_torch:
            parts = {name: part.numpy() for name, part in parts.items()}
        self.batch.state = BatchState(**parts)
        if isinstance(self.batch, CurriculumBatch):
            self.batch.load_curriculum_state(state["curriculum"])
        self._seen(np.asarray(self.batch.observe(self.batch.state)))

    def _seen(self, observation: np.ndarray) -> np.ndarray:
        """What the learner sees of observations (num_envs, no); notes where the frame's axes are."""
        if self._frame is None:
            return observation
        features, self._axes = _seen_in(self._frame, observation)
        return features


def _linear(start: float, final_fraction: float, progress: float) -> float:
    """Falls from `start` to `final_fraction * start` along a straight line, as `progress` goes from 0 to 1."""
    return start * (1 - (1 - final_fraction) * progress)


def _global_random() -> dict[str, Any]:
    """The state of the global generators of torch and NumPy: tensors and plain values."""
    kind, words, *rest = cast(Any, np.random.get_state())
    return {"torch": torch.get_rng_state(), "numpy": [kind, words.tolist(), *rest]}


def _to_world(axes: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Actions (n, 2) in the frame whose directions are the columns of axes (n, 2, 2), as actions of the world.

    Actions of the frame in ±`REACH` include all of the world's, and the others are clipped, as `PolicyNetwork` does. So a
    small error of an action is small in both.
    """
    return np.clip(np.einsum("nij,nj->ni", axes, actions), -1.0, 1.0)
