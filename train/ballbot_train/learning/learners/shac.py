"""Short-horizon actor-critic: the policy follows the exact gradient of the cost through windows of the batched model.

Each iteration rolls out a window of `horizon` control steps, from where the last window ended. The loss is the cost of the
window plus the cost that a learnt critic expects after it. Its gradient runs through physics and policy (Xu et al.,
"Accelerated policy learning with parallel differentiable simulation", 2022). Every episode's loss is divided by the cost that
the critic expects from the episode's start, because regret is relative too.

Two parts of a task have no gradient and get one here. A penalty on coming closer to a margin than `margin_clearance` stands
for failures, and one on a ball that nearly slips where friction is limited. For the first exit, an episode ends gradually: at
each step a share of it ends that grows with the depth in the goal.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import torch

from ballbot_baselines.lqr import equilibrium_gain
from ballbot_gym.batch import COMPILE_OPTIONS, BallbotBatch, BatchState
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.robots import robot_name
from ballbot_gym.seeding import spawned
from ballbot_gym.tasks import Task
from ballbot_train.learning import schedules
from ballbot_train.learning.actors import RoutedSymmetry, spec_for, started
from ballbot_train.learning.fitting import start_as_lqr
from ballbot_train.learning.routing import fit_routes
from ballbot_train.learning.state import load_state, state_of
from ballbot_train.learning.whole_episodes import WholeEpisodes, grip_penalty
from ballbot_train.policy import PolicyNetwork
from ballbot_train.weights import linear_layers


@dataclass(frozen=True)
class ShacConfig:
    """Settings of `Shac` and of `WholeEpisodes`, which takes over where `horizon` is 0."""

    iterations: int = 4000
    """Iterations of a window or of whole episodes."""
    evaluations: int = 20
    """Evaluations, at equal distances."""
    num_envs: int = 512
    """Envs that are stepped together."""
    horizon: int = 50
    """Control steps of a window; 0: whole episodes, to refine."""
    episode_seconds: float = 4.0
    """Duration of whole episodes, s."""
    learning_rate: float = 3e-3
    """Learning rate of the policy."""
    critic_learning_rate: float = 3e-3
    """Learning rate of the critic."""
    gamma: float = 1.0
    """Discount; below 1 where cost never ends."""
    hidden: tuple[int, ...] = (128, 128)
    """Units of hidden layers."""
    symmetry: RoutedSymmetry = "none"
    """What the actor keeps of the task's symmetry."""
    reset_fraction: float = 0.4
    """Share of the envs that start anew after a window."""
    hard_fraction: float = 0.0
    """Share of those that start where high cost is expected."""
    margin_clearance: float = 0.0
    """Distance to a margin where a penalty starts."""
    margin_penalty: float = 0.0
    """Per second and squared shortfall of it; 0: none."""
    one_way: bool = False
    """Weave stays on the sides where it started; not from scratch."""
    exit_softness: float = 0.0
    """Width of a gradual end, in units of the goal."""


TUNED: dict[str, ShacConfig] = {
    "": ShacConfig(),
    "stabilize": ShacConfig(symmetry="odd"),
    "turn": ShacConfig(exit_softness=0.3),
    "orbit": ShacConfig(gamma=0.998),
    "weave": ShacConfig(
        iterations=6000,
        evaluations=30,
        hidden=(256, 256),
        symmetry="frame",
        reset_fraction=0.25,
        margin_clearance=0.1,
        margin_penalty=3000.0,
    ),
}
"""Exceptions by name of task; every other task takes the defaults."""

_FINAL_LEARNING_RATE_FRACTION = 0.01  # it falls along half a cosine
_WARMUP_ITERATIONS = 40  # of the critic alone, if training starts from a policy
_CRITIC_GRADIENT_STEPS, _CRITIC_STRIDE = 4, 4  # per iteration; of the control steps of a window from which it learns
_TAU = 0.2  # share by which the target critic moves to the critic after each iteration
_MAX_GRAD_NORM = 1.0  # of the policy
_MIN_COST = 0.5  # cheaper episodes are weighted as if they cost this much
_FAILURE_PENALTY = 1000.0  # cost of a failure in training, whenever it comes
_COMPILE_FROM = 50  # iterations; compiling a control step takes half a minute
_SOFTPLUS_ONE = math.log(math.e - 1)  # where softplus is 1
_DEEP = 0.15  # shortfall of a clearance from which its penalty grows linearly
_ENDLESS = 10**6  # control steps: longer than any episode in training
_HARD_AMONG = 16  # episodes that are drawn for each hard one
_STATE = (
    *("iteration", "network", "critic", "target", "_policy_optimizer", "_critic_optimizer"),
    *("_batch", "_drawn", "_start", "_random"),
)


class _Record(NamedTuple):
    """What the critic learns from in one step of a window."""

    observation: torch.Tensor
    """(B, no) before the step."""
    cost: torch.Tensor
    """(B,) of the step."""
    exited: torch.Tensor
    """(B,) bool: ended in the goal."""
    failed: torch.Tensor
    """(B,) bool."""


class Critic(torch.nn.Module):
    """Expected cost from observations (B, no), (B,); on a task that ends at rest a multiple of LQR's cost.

    Where the policy sees the task's frame, the critic does too.
    """

    def __init__(self, task: Task, params: BallbotParams, policy: PolicyNetwork, hidden: tuple[int, ...]):
        super().__init__()
        self._shown = policy.shown
        past = policy.spec.seen - policy.spec.observations
        self.mlp = linear_layers((policy.present + past, *hidden, 1), torch.nn.Tanh)
        for part in self.mlp[-1].parameters():
            torch.nn.init.zeros_(part)
        gain = equilibrium_gain(task, params)
        self.p: torch.Tensor | None
        self.register_buffer("p", None if gain is None else torch.tensor(gain[1], dtype=torch.float32))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        scale = 10.0
        if self.p is not None:
            error = observation[..., : len(self.p)]
            scale = ((error @ self.p) * error).sum(-1) + 1e-3
        return torch.nn.functional.softplus(self.mlp(self._shown(observation))[..., 0] + _SOFTPLUS_ONE) * scale


class Shac:
    """The learner; see `training.Learner`."""

    def __init__(
        self,
        task: Task,
        params: BallbotParams,
        config: ShacConfig,
        seed: int = 0,
        randomization: Randomization | None = None,
        history: int = 0,
    ):
        torch.manual_seed(seed)  # for the networks' first weights
        world: dict[str, Any] = {"params": params, "randomization": randomization, "history": history}
        self._random = torch.Generator().manual_seed(seed)
        self.config, self.iteration, self._finetuning, self._seed = config, 0, False, seed
        self.iterations, self.evaluations = config.iterations, config.evaluations
        self._own = task
        self.task = replace(task, duration=_ENDLESS * task.control_dt)  # episodes never run out of time in training
        self.network = PolicyNetwork(spec_for(task, config.symmetry, config.hidden, True, history, robot_name(params)))
        start_as_lqr(self.network, task, params)
        self.critic = Critic(task, params, self.network, config.hidden)
        self.target = Critic(task, params, self.network, config.hidden)
        self.target.load_state_dict(self.critic.state_dict())
        self._policy_optimizer = torch.optim.Adam(self.network.parameters(), config.learning_rate, betas=(0.7, 0.95))
        rate = config.critic_learning_rate
        self._critic_optimizer = torch.optim.Adam(self.critic.parameters(), rate, betas=(0.7, 0.95))
        wheels, long = params.wheels is not None, config.iterations >= _COMPILE_FROM
        self._batch = BallbotBatch(self.task, config.num_envs, compile=wheels and long, **world)
        self._start = self._batch.reset(seed=spawned(seed))  # (B, no) first observations of the running episodes
        hard = round(config.hard_fraction * config.reset_fraction * config.num_envs)  # new episodes of an iteration
        self._drawn = BallbotBatch(self.task, _HARD_AMONG * hard, compile=False, **world) if hard else None
        if self._drawn is not None:
            self._drawn.reset(seed=spawned(seed) + config.num_envs)
        self._step = self._one_step
        if long and not wheels:  # else the batch compiles its part
            self._step = torch.compile(self._step, fullgraph=True, dynamic=False, options=COMPILE_OPTIONS)

    def start_from(self, network: PolicyNetwork) -> None:
        """Takes the weights of a policy, to be improved; it may have been trained on another robot and its episodes.

        Raises:
            ValueError: its network differs in shape from this one.
        """
        self.network.load_state_dict(started(network, self.network.spec, any_shape=False).state_dict())
        self._finetuning = True

    def iterate(self) -> dict[str, float]:
        config = self.config
        if self.network.routes is not None and self.iteration == 0 and not self._finetuning:
            fit_routes(self.network.routes, self._own, self._batch.params, self._seed)
        rate = self._annealed(config.learning_rate)
        self._policy_optimizer.param_groups[0]["lr"] = rate
        self._critic_optimizer.param_groups[0]["lr"] = self._annealed(config.critic_learning_rate)
        with torch.no_grad():
            weight = 1 / self.target(self._start).clamp(min=_MIN_COST)
        state = BatchState(*(part.detach() for part in self._state))
        start = self._start
        loss, alive, discount = torch.zeros(config.num_envs), torch.ones(config.num_envs), torch.ones(config.num_envs)
        log: list[_Record] = []
        for _ in range(config.horizon):
            state, start, alive, discount, loss, record = self._step(state, start, alive, discount, loss)
            log.append(record)
        last = self._batch.observe(state)
        loss = weight * (loss + discount * alive * self.target(last))
        self._policy_optimizer.zero_grad()
        loss.mean().backward()
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), _MAX_GRAD_NORM)
        if torch.isfinite(norm) and not (self._finetuning and self.iteration < _WARMUP_ITERATIONS):
            self._policy_optimizer.step()
        critic_loss = self._learn_values(log, last.detach())
        self._batch.state = BatchState(*(part.detach() for part in state))
        old = torch.rand(config.num_envs, generator=self._random) < config.reset_fraction
        self._start = torch.where(old[:, None], self._new_episodes(old), start.detach())
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
        return state_of(self, _STATE)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        load_state(self, _STATE, state)

    @property
    def _state(self) -> BatchState:
        return cast(BatchState, self._batch.state)  # reset in __init__

    def _new_episodes(self, which: torch.Tensor) -> torch.Tensor:
        """Starts new episodes in some envs (B,); returns the observations (B, no) of all. Some are hard ones."""
        observations = self._batch.reset(mask=which)
        if self._drawn is None:
            return observations
        seen = self._drawn.reset()
        drawn = cast(BatchState, self._drawn.state)
        with torch.no_grad():
            hardest = self.target(seen).topk(self._drawn.num_envs // _HARD_AMONG).indices
        places = which.nonzero()[:, 0][: len(hardest)]
        hardest = hardest[: len(places)]
        x, c = self._state.x.clone(), self._state.c.clone()
        x[:, places], c[:, places] = drawn.x[:, hardest], drawn.c[:, hardest]
        self._batch.state = self._state._replace(x=x, c=c)
        return self._batch.observe(self._state)

    def _annealed(self, rate: float) -> float:
        """A learning rate in the present iteration."""
        progress = self.iteration / self.config.iterations
        return schedules.cosine(rate, _FINAL_LEARNING_RATE_FRACTION, progress)

    def _one_step(
        self, state: BatchState, start: torch.Tensor, alive: torch.Tensor, discount: torch.Tensor, loss: torch.Tensor
    ) -> tuple[Any, ...]:
        """One control step of every env; compiled."""
        config, task = self.config, self.task
        observation = self._batch.observe(state)
        new, result = self._batch.transition(state, self.network(observation))
        before, force = state.x.unbind(0), result.force.unbind(0)
        x, c = result.final_x.unbind(0), state.c.unbind(0)
        cost = task.cost(before, force, c) * task.control_dt
        cost = cost + _FAILURE_PENALTY * result.failure
        shaped = cost
        if config.margin_penalty:
            routes = self.network.routes if config.one_way else None
            sides = () if routes is None else routes.sides(observation.unbind(-1))
            for margin in task.one_way_margins(x, c, sides) if config.one_way else task.margins(x, c):
                shortfall = (config.margin_clearance - margin).clamp(min=0)
                squared = shortfall**2 - (shortfall - _DEEP).clamp(min=0) ** 2
                shaped = shaped + config.margin_penalty * task.control_dt * squared
        shaped = shaped + grip_penalty(self._batch.model(state.drawn.unbind(0)), before, force, task.control_dt)
        loss = loss + discount * alive * shaped
        if config.exit_softness:
            alive = alive * torch.sigmoid(torch.stack(task.goal(x, c)).amax(0) / config.exit_softness)
        discount = discount * config.gamma
        done = result.terminated
        alive, discount = torch.where(done, 1.0, alive), torch.where(done, 1.0, discount)
        start = torch.where(done[:, None], result.observation, start)
        record = _Record(observation.detach(), cost.detach(), result.success, result.failure)
        return new, start, alive, discount, loss, record

    def _learn_values(self, log: list["_Record"], last: torch.Tensor) -> float:
        """Fits the critic to the cost of the window from each of its steps on; returns the loss.

        Physics and policy are deterministic, so the longest return has least bias and no variance.
        """
        config = self.config
        with torch.no_grad():
            ahead, wanted = self.target(last), []
            for record in reversed(log):
                ahead = record.cost + config.gamma * torch.where(record.exited | record.failed, 0.0, ahead)
                wanted.append(ahead)
            stride = min(_CRITIC_STRIDE, len(log))
            chosen = slice(int(torch.randint(stride, (), generator=self._random)), None, stride)
            wanted = torch.cat(wanted[::-1][chosen])
            observations = torch.cat([record.observation for record in log[chosen]])
        total = 0.0
        order = torch.randperm(len(wanted), generator=self._random)
        for part in order.chunk(_CRITIC_GRADIENT_STEPS):
            value = self.critic(observations[part])
            # relative errors: small costs matter as much as great ones
            loss = torch.nn.functional.smooth_l1_loss(value.clamp(min=1e-6).log(), wanted[part].clamp(min=1e-6).log())
            self._critic_optimizer.zero_grad()
            loss.backward()
            self._critic_optimizer.step()
            total += float(loss.detach())
        with torch.no_grad():
            for kept, learnt in zip(self.target.parameters(), self.critic.parameters(), strict=True):
                kept.lerp_(learnt, _TAU)
        return total / _CRITIC_GRADIENT_STEPS


def make(
    task: Task,
    params: BallbotParams,
    config: ShacConfig,
    seed: int,
    demos: None = None,
    start: PolicyNetwork | None = None,
    **world: Any,
) -> Shac | WholeEpisodes:
    """As of `Algorithm.make`, without demonstrations."""
    for name in ("margin_clearance", "one_way"):
        if getattr(config, name) and not config.margin_penalty:
            raise ValueError(f"{name} needs margin_penalty above 0")
    learner = (Shac if config.horizon else WholeEpisodes)(task, params, config, seed, **world)
    if start is not None:
        learner.start_from(start)
    return learner
