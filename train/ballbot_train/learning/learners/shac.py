"""The policy follows the exact gradient of the cost, which runs through the batched model and the policy.

`Shac` is short-horizon actor-critic (Xu et al., "Accelerated policy learning with parallel differentiable simulation",
2022). Each iteration rolls out a window of `horizon` control steps, from where the last window ended. The loss is the cost of
the window plus the cost that a learnt critic expects after it, divided by the cost that the critic expects from the episode's
start, because regret is relative.

`WholeEpisodes`, where `horizon` is 0, is analytic policy gradient (Freeman et al., "Brax", 2021, call it so). Each iteration
draws episodes and runs them. There is no critic, whose errors would be followed as well, so it takes a good policy nearer to
the optimum than the other learners do. The logarithm of an episode's cost is lowered.

Two parts of a task have no gradient and get one here. A penalty on coming closer to a margin than `margin_clearance` stands
for failures, and one on a ball that nearly slips where friction is limited. In whole episodes a first exit lies at the
control step at which the cost so far, plus a penalty on what the state still lacks of the goal, is least, and a ball that
slips goes on as if it gripped. An episode of full length, or with noise, pays in its last half second for what it lacks of
the goal, because the cost hardly tells rest at the goal from rest near it.
"""

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import torch

from ballbot_baselines.feedback.lqr import equilibrium_gain
from ballbot_gym import dynamics
from ballbot_gym.batch import COMPILE_OPTIONS, BallbotBatch, BatchState
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.seeding import spawned
from ballbot_gym.tasks import Task
from ballbot_train.learning import schedules
from ballbot_train.learning.actors import RoutedSymmetry, actor_for, average_of
from ballbot_train.learning.routing import fit_routes
from ballbot_train.learning.state import load_state, state_of
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


TUNED: dict[str, ShacConfig] = {
    "": ShacConfig(),
    "stabilize": ShacConfig(symmetry="odd"),
    "turn": ShacConfig(horizon=0),
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

_MIN_COST = 0.5  # cheaper episodes are weighted as if they cost this much
_FAILURE_PENALTY = 1000.0  # cost of a failure in training, whenever it comes. It has no gradient
_GRIP_CLEARANCE, _GRIP_PENALTY = 0.05, 10000.0  # as of the margins, for `dynamics.limits` of robots that can slip
_COMPILE_FROM = 50  # iterations; compiling a control step takes half a minute

_WARMUP_ITERATIONS = 40  # of the critic alone, if training starts from a policy
_CRITIC_GRADIENT_STEPS, _CRITIC_STRIDE = 4, 4  # per iteration; of the control steps of a window from which it learns
_TAU = 0.2  # share by which the target critic moves to the critic after each iteration
_SOFTPLUS_ONE = math.log(math.e - 1)  # where softplus is 1
_ENDLESS = 10**6  # control steps: longer than any episode in training
_HARD_AMONG = 16  # episodes that are drawn for each hard one

_AVERAGED_ITERATIONS = 20  # over which the policy of whole episodes is a running average
# of ending outside of the goal, less this depth, in units of the goal functions
_GOAL_PENALTY, _GOAL_CLEARANCE = 30.0, 0.1
_RESTING = 25  # last control steps that may lack the goal, of episodes of full length or with noise
# slope of the logarithm of an episode's cost with a state: steeper ones, of robots that fall, are cut. Near a friction limit
# slopes of 10 are common, and with cuts there the gradient led uphill
_STEEPEST, _STEEPEST_WITH_GRIP = 10.0, 100.0
_PATIENCE = 5  # control steps for which episodes go on when all have reached the goal


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


class _ExactGradient:
    """What both learners do; see `training.Learner`."""

    _STATE: tuple[str, ...]
    """What later iterations depend on."""
    _BETAS: tuple[float, float]
    """Of Adam."""
    _FINAL_LEARNING_RATE_FRACTION: float
    """It falls along half a cosine."""
    _MAX_GRAD_NORM: float
    _DEEP: float
    """Shortfall of a clearance from which its penalty grows linearly."""
    _one_step: Callable[..., Any]
    """One control step of every env; compiled."""

    def __init__(
        self,
        task: Task,
        params: BallbotParams,
        config: ShacConfig,
        seed: int = 0,
        start: PolicyNetwork | None = None,
        randomization: Randomization | None = None,
        history: int = 0,
        informed: bool = False,
    ):
        """As of `Algorithm.make`."""
        torch.manual_seed(seed)  # for the networks' first weights
        self.config, self.iteration, self._own, self._seed, self._warm = config, 0, task, seed, start is not None
        self.iterations, self.evaluations = config.iterations, config.evaluations
        self._trained = actor_for(task, params, config, history, informed, start)
        self._optimizer = torch.optim.Adam(self._trained.parameters(), config.learning_rate, betas=self._BETAS)
        # no window ends an episode
        self.task = replace(task, duration=_ENDLESS * task.control_dt if config.horizon else config.episode_seconds)
        wheels, long = params.wheels is not None, config.iterations >= _COMPILE_FROM
        self._world: dict[str, Any] = {"params": params, "randomization": randomization, "history": history}
        self._batch = BallbotBatch(self.task, config.num_envs, compile=wheels and long, **self._world)
        self._start = self._batch.reset(seed=spawned(seed))  # (B, no) first observations of the running episodes
        self._step = self._one_step
        if long and not wheels:  # else the batch compiles its part
            self._step = torch.compile(self._step, fullgraph=True, dynamic=False, options=COMPILE_OPTIONS)

    @property
    def network(self) -> PolicyNetwork:
        return self._trained

    def state_dict(self) -> dict[str, Any]:
        return state_of(self, self._STATE)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        load_state(self, self._STATE, state)

    @property
    def _state(self) -> BatchState:
        return cast(BatchState, self._batch.state)  # reset in __init__

    def _teach_routes(self) -> None:
        """Before the first iteration; a policy to start from knows its routes."""
        if self._trained.routes is not None and self.iteration == 0 and not self._warm:
            fit_routes(self._trained.routes, self._own, self._batch.params, self._seed)

    def _annealed(self, rate: float) -> float:
        """A learning rate in the present iteration."""
        return schedules.cosine(rate, self._FINAL_LEARNING_RATE_FRACTION, self.iteration / self.config.iterations)

    def _descend(self, loss: torch.Tensor, waits: bool = False) -> dict[str, float]:
        """Moves the policy, unless it waits, against the gradient of the loss (); returns figures to log."""
        rate = self._optimizer.param_groups[0]["lr"] = self._annealed(self.config.learning_rate)
        self._optimizer.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self._trained.parameters(), self._MAX_GRAD_NORM)
        if torch.isfinite(norm) and not waits:
            self._optimizer.step()
        return {"loss/policy": loss.item(), "train/gradient": norm.item(), "train/learning_rate": rate}

    def _control_step(self, state: BatchState, price: float = 0.0) -> tuple[Any, ...]:
        """One control step of every env; price: of a failure.

        Returns:
            What the policy saw (B, no), the state after the step, what else the batch says of it, its cost (B,), the same
            with the penalties on nearness to margins and on a ball that slips or nearly does, and the goal functions (n, B).
        """
        config, task, dt = self.config, self.task, self.task.control_dt
        observation = self._batch.observe(state)
        action = self._trained.knowing(observation, state, self._batch.randomization)
        new, result = self._batch.transition(state, action)
        before, force, x = (part.unbind(0) for part in (state.x, result.force, result.final_x))
        time = state.steps * dt
        shaped = cost = task.cost(before, force, task.at(state.c.unbind(0), time)) * dt + price * result.failure
        c = task.at(state.c.unbind(0), time + dt)
        if config.margin_penalty:
            for margin in task.margins(x, c):
                shortfall = (config.margin_clearance - margin).clamp(min=0)
                squared = shortfall**2 - (shortfall - self._DEEP).clamp(min=0) ** 2
                shaped = shaped + config.margin_penalty * dt * squared
        limits = dynamics.limits(self._batch.model(state.drawn.unbind(0)), before, force, hold=dt)
        shortfalls = [(_GRIP_CLEARANCE - limit).clamp(min=0) for limit in limits]
        shaped = shaped + sum(_GRIP_PENALTY * dt * shortfall**2 for shortfall in shortfalls)
        return observation, new, result, cost, shaped, torch.stack(task.goal(x, c))


class Shac(_ExactGradient):
    """The learner in windows, with a critic."""

    _STATE = (
        *("iteration", "_trained", "critic", "target", "_optimizer", "_critic_optimizer"),
        *("_batch", "_drawn", "_start", "_random"),
    )
    _BETAS, _FINAL_LEARNING_RATE_FRACTION, _MAX_GRAD_NORM, _DEEP = (0.7, 0.95), 0.01, 1.0, 0.15

    def __init__(self, task: Task, params: BallbotParams, config: ShacConfig, seed: int = 0, *given: Any, **world: Any):
        super().__init__(task, params, config, seed, *given, **world)
        self._random = torch.Generator().manual_seed(seed)
        self.critic = Critic(task, params, self._trained, config.hidden)
        self.target = copy.deepcopy(self.critic)
        self._critic_optimizer = torch.optim.Adam(
            self.critic.parameters(), config.critic_learning_rate, betas=self._BETAS
        )
        hard = round(config.hard_fraction * config.reset_fraction * config.num_envs)  # new episodes of an iteration
        self._drawn = None
        if hard:
            self._drawn = BallbotBatch(self.task, _HARD_AMONG * hard, compile=False, **self._world)
            self._drawn.reset(seed=spawned(seed) + config.num_envs)

    def iterate(self) -> dict[str, float]:
        config = self.config
        self._teach_routes()
        with torch.no_grad():
            weight = 1 / self.target(self._start).clamp(min=_MIN_COST)
        state, start = BatchState(*(part.detach() for part in self._state)), self._start
        loss, discount = torch.zeros(config.num_envs), torch.ones(config.num_envs)
        log = []
        for _ in range(config.horizon):
            state, start, discount, loss, *record = self._step(state, start, discount, loss)
            log.append(record)
        last = self._batch.observe(state)
        loss = weight * (loss + discount * self.target(last))
        figures = self._descend(loss.mean(), self._warm and self.iteration < _WARMUP_ITERATIONS)
        observations, costs, ended, failed = zip(*log, strict=True)
        critic_loss = self._learn_values(observations, costs, ended, last.detach())
        self._batch.state = BatchState(*(part.detach() for part in state))
        anew = torch.rand(config.num_envs, generator=self._random) < config.reset_fraction
        self._start = torch.where(anew[:, None], self._new_episodes(anew), start.detach())
        self.iteration += 1
        failures, ends = (torch.stack(part).sum().item() for part in (failed, ended))
        failure_rate = failures / max(1.0, ends + float(anew.sum()))
        return {**figures, "loss/critic": critic_loss, "train/failure_rate": failure_rate}

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

    def _one_step(
        self, state: BatchState, start: torch.Tensor, discount: torch.Tensor, loss: torch.Tensor
    ) -> tuple[Any, ...]:
        """Returns the arguments after the step, what the policy saw (B, no), the step's cost (B,), whether an episode ended
        (B,), and whether by a failure (B,).
        """
        observation, new, result, cost, shaped, _ = self._control_step(state, _FAILURE_PENALTY)
        loss = loss + discount * shaped
        done = result.terminated
        discount = torch.where(done, 1.0, discount * self.config.gamma)
        start = torch.where(done[:, None], result.observation, start)
        return new, start, discount, loss, observation.detach(), cost.detach(), done, result.failure

    def _learn_values(
        self,
        observations: tuple[torch.Tensor, ...],
        costs: tuple[torch.Tensor, ...],
        ended: tuple[torch.Tensor, ...],
        last: torch.Tensor,
    ) -> float:
        """Fits the critic to the cost of the window from each of its steps on; returns the loss. `last` was seen after it.

        Physics and policy are deterministic, so the longest return has least bias and no variance.
        """
        config = self.config
        self._critic_optimizer.param_groups[0]["lr"] = self._annealed(config.critic_learning_rate)
        with torch.no_grad():
            ahead, wanted = self.target(last), []
            for cost, done in zip(reversed(costs), reversed(ended), strict=True):
                ahead = cost + config.gamma * torch.where(done, 0.0, ahead)
                wanted.append(ahead)
            stride = min(_CRITIC_STRIDE, len(costs))
            chosen = slice(int(torch.randint(stride, (), generator=self._random)), None, stride)
            wanted = torch.cat(wanted[::-1][chosen])
            seen = torch.cat(observations[chosen])
        total = 0.0
        order = torch.randperm(len(wanted), generator=self._random)
        for part in order.chunk(_CRITIC_GRADIENT_STEPS):
            value = self.critic(seen[part])
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


class WholeEpisodes(_ExactGradient):
    """The learner through whole episodes."""

    _STATE = ("iteration", "_trained", "_average", "_optimizer", "_batch")
    _BETAS, _FINAL_LEARNING_RATE_FRACTION = (0.9, 0.99), 0.02
    _MAX_GRAD_NORM = 0.3  # the gradient is larger in nearly every iteration
    _DEEP = math.inf

    def __init__(self, *given: Any, **world: Any):
        super().__init__(*given, **world)
        self._average = average_of(self._trained, _AVERAGED_ITERATIONS)

    @property
    def network(self) -> PolicyNetwork:
        """A running average of the policy over its last iterations."""
        return cast(PolicyNetwork, self._average.module)

    def iterate(self) -> dict[str, float]:
        self._teach_routes()
        costs, ended_well = self._episodes()
        figures = self._descend(costs.clamp(min=_MIN_COST).log().mean())
        self._average.update_parameters(self._trained)
        self.iteration += 1
        return {**figures, "train/failure_rate": 1 - ended_well.double().mean().item()}

    def _episodes(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Runs new episodes; returns their costs (B,), which have gradients, and whether they ended well (B,)."""
        config, task = self.config, self.task
        self._batch.reset()
        state, start = self._state, self._state.x
        total = torch.zeros(config.num_envs)
        alive, reached = torch.ones(config.num_envs, dtype=torch.bool), torch.zeros(config.num_envs, dtype=torch.bool)
        standing = alive  # an episode that has reached the goal goes on for a while, and may fail then
        noisy = self._batch.randomization.is_noisy
        rests = not task.first_exit and (noisy or task.steps >= self._own.steps)
        ends, patience = [], _PATIENCE
        last = torch.full_like(total, _FAILURE_PENALTY)
        for k in range(task.steps):
            end, cost, lacking, inside, failed, actuator, past = self._step(state)
            total = total + torch.where(alive & standing, cost, 0.0)
            if rests and k >= task.steps - _RESTING:
                total = total + torch.where(alive, _GOAL_PENALTY / _RESTING * lacking, 0.0)
            alive, standing = alive & ~(failed & ~reached), standing & ~failed
            if task.first_exit:
                ended = total + _GOAL_PENALTY * lacking
                ends.append(torch.where(alive & standing, ended, math.inf))
                last = torch.where(alive & standing, ended, last)
                reached = reached | (alive & inside)
                patience -= bool((reached | ~alive).all())
                if not patience:
                    break
            # where an episode has failed, the model goes on from its start, which leads to no infinite numbers
            x = torch.where(alive & standing, end, start)
            if self._batch.randomization.active and x.requires_grad:
                x.register_hook(self._tamed)
            state = state._replace(x=x, actuator=actuator, past=past, steps=state.steps + 1)
        if not task.first_exit:
            return total + _FAILURE_PENALTY * ~alive, alive
        # one that fails ends where it failed, and not at its best moment before
        return torch.where(alive, torch.stack(ends).amin(0), last), reached

    def _tamed(self, slope: torch.Tensor) -> torch.Tensor:
        """The slope (8, B) of the mean of B episodes' losses with their states, in no episode steeper than the steepest."""
        steepest = _STEEPEST_WITH_GRIP if self._batch.params.grips else _STEEPEST
        most = steepest / slope.shape[1]
        return torch.nan_to_num(slope * (most / slope.norm(dim=0)).clamp(max=1.0), 0.0, 0.0, 0.0)

    def _one_step(self, state: BatchState) -> tuple[torch.Tensor, ...]:
        """Returns states (8, B) at its end, its cost (B,) with penalties, what the states lack of the goal and its clearance
        (B,), in units of the goal functions, whether they are in the goal (B,), and failed (B,), then `actuator` and `past`.
        A ball that slips goes on as if it gripped: the penalty on slipping has a gradient then.
        """
        _, new, result, _, cost, goal = self._control_step(state)
        lacking = (goal + _GOAL_CLEARANCE).clamp(min=0).sum(0)
        failed = result.failure & (result.violated != len(self.task.limit_names))  # that number is grip's
        return result.final_x, cost, lacking, (goal <= 0).all(0), failed, new.actuator, new.past


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
    if config.margin_clearance and not config.margin_penalty:
        raise ValueError("margin_clearance needs margin_penalty above 0")
    return (Shac if config.horizon else WholeEpisodes)(task, params, config, seed, start, **world)
