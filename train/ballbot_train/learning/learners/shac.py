"""Short-horizon actor-critic: the policy follows the exact gradient of cost through windows of the batched model.

Each iteration rolls a window of control steps out from where the last one ended. Its loss is the window's cost and, at its
end, what a learnt critic says is still to come; the gradient runs through physics and policy (Xu et al., Accelerated Policy
Learning with Parallel Differentiable Simulation, 2022). Every episode's loss is divided by what the critic expects it to
cost from its start, because regret is relative too.

Two things in the tasks have no gradient and get one here: margins, by a penalty on coming closer than `clearance`; and the
first exit, by letting an episode end softly, a share of it at each step the deeper it is in the goal.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from ballbot_baselines.lqr import equilibrium_gain
from ballbot_gym.batch import BallbotBatch, BatchState
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_train.policy import PolicyNetwork, PolicySpec


@dataclass(frozen=True)
class ShacConfig:
    """Settings of `Shac`."""

    iterations: int = 4000
    evaluations: int = 20
    envs: int = 512
    window: int = 50
    """Control steps through which the gradient runs."""
    restart: float = 0.4
    """Share of the envs that start a new episode after each window: the first second costs most."""
    hidden: tuple[int, ...] = (128, 128)
    odd: bool = False
    """Whether opposite observations get opposite actions, as is right where the goal is the origin and nothing in the way."""
    learning_rate: float = 3e-3
    """Of policy and critic at the start; falls along a half cosine to `final_rate` of it."""
    start_rate: float = 5e-4
    """In place of `learning_rate` where there is a policy to start from."""
    critic_first: int = 40
    """Iterations for which only the critic learns where there is a policy to start from."""
    final_rate: float = 0.01
    least_cost: float = 0.5
    """An episode counts as if it cost at least this much."""
    discount: float = 1.0
    """Per control step; below 1 where the cost never ends."""
    critic_steps: int = 4
    """Gradient steps of the critic per iteration; with 0 it stays what it begins as, at an equilibrium task LQR's cost."""
    critic_stride: int = 4
    """Of a window's steps, the critic learns from one in so many."""
    critic_follow: float = 0.2
    """Share by which the target critic moves to the critic after each iteration."""
    max_gradient: float = 1.0
    """Norm to which the policy's gradient is clipped."""
    failure_price: float = 1000.0
    """What a failure costs in training, whenever it comes."""
    clearance: float = 0.0
    """How far from the margins the penalty begins, in the margins' units."""
    margin_price: float = 0.0
    """Of the squared distance by which the clearance is missed."""
    exit_softness: float = 0.0
    """Of the first exit, in units of the goal's excess; 0 ends no episode softly."""
    compile: bool = True
    """Whether a control step is compiled, which takes half a minute once."""


_SOFTPLUS_ONE = math.log(math.e - 1)  # where softplus is 1
_ENDLESS = 10**6  # control steps: longer than any episode in training

TUNED: dict[str, ShacConfig] = {
    "stabilize": ShacConfig(odd=True),
    "turn": ShacConfig(exit_softness=0.3),
    "orbit": ShacConfig(discount=0.998),
    "weave": ShacConfig(
        iterations=10_000, evaluations=25, restart=0.25, hidden=(256, 256), clearance=0.1, margin_price=3000.0
    ),
}
"""By task."""


class _Record(NamedTuple):
    """What one step of a window leaves for the critic."""

    observation: torch.Tensor
    """(B, no) before the step."""
    cost: torch.Tensor
    """(B,) of the step."""
    exited: torch.Tensor
    """(B,) bool: ended in the goal."""
    failed: torch.Tensor
    """(B,) bool."""


class Critic(torch.nn.Module):
    """Cost still to come: observations (B, no) to (B,), in multiples of what LQR would pay at an equilibrium task."""

    def __init__(self, task: Task, params: BallbotParams, hidden: tuple[int, ...]):
        super().__init__()
        layers: list[torch.nn.Module] = []
        size = len(task.observation_scale)
        for width in hidden:
            layers += [torch.nn.Linear(size, width), torch.nn.Tanh()]
            size = width
        last = torch.nn.Linear(size, 1)
        torch.nn.init.zeros_(last.weight)
        torch.nn.init.zeros_(last.bias)
        self.mlp = torch.nn.Sequential(*layers, last)
        gain = equilibrium_gain(task, params)
        self.register_buffer("p", None if gain is None else torch.tensor(gain[1], dtype=torch.float32))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        scale = 10.0
        if self.p is not None:
            error = observation[..., :8]
            scale = ((error @ self.p) * error).sum(-1) + 1e-3
        return torch.nn.functional.softplus(self.mlp(observation)[..., 0] + _SOFTPLUS_ONE) * scale


class Shac:
    """The learner; see `training.Learner`."""

    def __init__(self, task: Task, params: BallbotParams, config: ShacConfig, seed: int = 0):
        torch.manual_seed(seed)  # for the networks' first weights
        self._random = torch.Generator().manual_seed(seed)
        self.config, self.iteration, self._started = config, 0, False
        self.iterations, self.evaluations = config.iterations, config.evaluations
        self.task = replace(task, duration=_ENDLESS * task.control_dt)  # windows end episodes, the task does not
        self._network = PolicyNetwork(PolicySpec.of(task, hidden=config.hidden, odd=config.odd))
        for part in self._network.linear.parameters():
            torch.nn.init.zeros_(part)
        if (gain := equilibrium_gain(task, params)) is not None:
            with torch.no_grad():
                self._network.linear.weight[:, :8] = torch.tensor(gain[0])
        self.critic = Critic(task, params, config.hidden)
        self.target = Critic(task, params, config.hidden)
        self.target.load_state_dict(self.critic.state_dict())
        self._policy_optimizer = torch.optim.Adam(self._network.parameters(), config.learning_rate, betas=(0.7, 0.95))
        self._critic_optimizer = torch.optim.Adam(self.critic.parameters(), config.learning_rate, betas=(0.7, 0.95))
        self._batch = BallbotBatch(self.task, config.envs, compile=False, params=params)
        self._start = self._batch.reset(seed=seed)  # (B, no) what the running episodes started from
        step = self._one_step
        self._step = torch.compile(step, fullgraph=True, dynamic=False) if config.compile else step

    @property
    def network(self) -> PolicyNetwork:
        return self._network

    def begin(self, network: PolicyNetwork) -> None:
        """Takes a policy's weights to start from, in place of LQR's or none.

        Raises:
            ValueError: its network is built otherwise.
        """
        if network.spec != self._network.spec:
            raise ValueError(
                f"a policy of {network.spec} cannot start one of {self._network.spec}; --set hidden or odd"
            )
        self._network.load_state_dict(network.state_dict())
        self._started = True

    def iterate(self) -> dict[str, float]:
        config = self.config
        rate = (config.start_rate if self._started else config.learning_rate) * self._annealed()
        self._policy_optimizer.param_groups[0]["lr"] = rate
        self._critic_optimizer.param_groups[0]["lr"] = config.learning_rate * self._annealed()
        with torch.no_grad():
            weight = 1 / self.target(self._start).clamp(min=config.least_cost)
        state = BatchState(*(part.detach() for part in self._batch.state))
        start = self._start
        loss, alive, discount = torch.zeros(config.envs), torch.ones(config.envs), torch.ones(config.envs)
        log: list[_Record] = []
        for _ in range(config.window):
            state, start, alive, discount, loss, record = self._step(state, start, alive, discount, loss)
            log.append(record)
        last = self._batch.observe(state)
        loss = weight * (loss + discount * alive * self.target(last))
        self._policy_optimizer.zero_grad()
        loss.mean().backward()
        norm = torch.nn.utils.clip_grad_norm_(self._network.parameters(), config.max_gradient)
        if torch.isfinite(norm) and not (self._started and self.iteration < config.critic_first):
            self._policy_optimizer.step()
        critic_loss = self._learn_values(log, last.detach())
        self._batch.state = BatchState(*(part.detach() for part in state))
        old = torch.rand(config.envs, generator=self._random) < config.restart
        fresh = self._batch.reset(mask=old)
        self._start = torch.where(old[:, None], fresh, start.detach())
        self.iteration += 1
        failures = sum(float(record.failed.sum()) for record in log)
        ends = failures + sum(float(record.exited.sum()) for record in log) + float(old.sum())
        return {
            "loss/policy": float(loss.detach().mean()),
            "loss/critic": critic_loss,
            "train/gradient": float(norm),
            "train/failure_rate": failures / max(1.0, ends),
            "train/learning_rate": rate,
        }

    def state_dict(self) -> dict[str, Any]:
        return {
            "iteration": self.iteration,
            "network": self._network.state_dict(),
            "critic": self.critic.state_dict(),
            "target": self.target.state_dict(),
            "policy_optimizer": self._policy_optimizer.state_dict(),
            "critic_optimizer": self._critic_optimizer.state_dict(),
            "batch": list(self._batch.state),
            "start": self._start,
            "random": self._random.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.iteration = state["iteration"]
        self._network.load_state_dict(state["network"])
        self.critic.load_state_dict(state["critic"])
        self.target.load_state_dict(state["target"])
        self._policy_optimizer.load_state_dict(state["policy_optimizer"])
        self._critic_optimizer.load_state_dict(state["critic_optimizer"])
        self._batch.state, self._start = BatchState(*state["batch"]), state["start"]
        self._random.set_state(state["random"])

    def _annealed(self) -> float:
        share = self.iteration / self.config.iterations
        return self.config.final_rate + (1 - self.config.final_rate) * (1 + math.cos(math.pi * share)) / 2

    def _one_step(
        self,
        state: BatchState,
        start: torch.Tensor,
        alive: torch.Tensor,
        discount: torch.Tensor,
        loss: torch.Tensor,
    ) -> tuple[Any, ...]:
        """One control step of every env; compiled."""
        config, task = self.config, self.task
        observation = self._batch.observe(state)
        new, result = self._batch.transition(state, self._network(observation))
        x, c = result.final_x.unbind(0), state.c.unbind(0)
        cost = task.cost(state.x.unbind(0), result.force.unbind(0), c) * task.control_dt
        cost = cost + config.failure_price * result.failure
        shaped = cost
        if config.margin_price:
            for margin in task.margins(x, c):
                shaped = shaped + config.margin_price * task.control_dt * (config.clearance - margin).clamp(min=0) ** 2
        loss = loss + discount * alive * shaped
        if config.exit_softness:
            alive = alive * torch.sigmoid(torch.stack(task.goal(x, c)).amax(0) / config.exit_softness)
        discount = discount * config.discount
        done = result.terminated
        alive, discount = torch.where(done, 1.0, alive), torch.where(done, 1.0, discount)
        start = torch.where(done[:, None], result.observation, start)
        record = _Record(observation.detach(), cost.detach(), result.success, result.failure)
        return new, start, alive, discount, loss, record

    def _learn_values(self, log: list["_Record"], last: torch.Tensor) -> float:
        """Fits the critic to what the window cost from each of its steps on; returns the loss.

        Physics and policy are deterministic, so the longest return is the best: there is no variance to trade for bias.
        """
        config = self.config
        with torch.no_grad():
            ahead, wanted = self.target(last), []
            for record in reversed(log):
                ahead = record.cost + config.discount * torch.where(record.exited | record.failed, 0.0, ahead)
                wanted.append(ahead)
            stride = min(config.critic_stride, len(log))
            chosen = slice(int(torch.randint(stride, (), generator=self._random)), None, stride)
            wanted = torch.cat(wanted[::-1][chosen])
            observations = torch.cat([record.observation for record in log[chosen]])
        total = 0.0
        order = torch.randperm(len(wanted), generator=self._random)
        for part in order.chunk(config.critic_steps) if config.critic_steps else ():
            value = self.critic(observations[part])
            # relative errors: what costs little must be known as well as what costs much
            loss = torch.nn.functional.smooth_l1_loss(value.clamp(min=1e-6).log(), wanted[part].clamp(min=1e-6).log())
            self._critic_optimizer.zero_grad()
            loss.backward()
            self._critic_optimizer.step()
            total += float(loss.detach())
        with torch.no_grad():
            for kept, learnt in zip(self.target.parameters(), self.critic.parameters(), strict=True):
                kept.lerp_(learnt, config.critic_follow)
        return total / max(1, config.critic_steps)


def make(task: Task, params: BallbotParams, config: ShacConfig, seed: int, demos: Path | None) -> Shac:
    """The learner at its beginning; it uses no demonstrations."""
    return Shac(task, params, config, seed)
