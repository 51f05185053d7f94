"""Analytic policy gradient: the policy follows the exact gradient of the cost of whole episodes. `shac --horizon 0` is this.

Each iteration draws episodes, runs them in the batched model under the policy, and differentiates their cost through physics
and policy (Freeman et al., "Brax", 2021, call it so). There is no critic, whose errors would be followed as well, so it takes
a good policy nearer to the optimum than the other learners do. The logarithm of an episode's cost is lowered, because regret
is relative.

Two parts of a task have no gradient and get one here. A first exit lies at the control step at which the cost so far, plus a
penalty on what the state still lacks of the goal, is least. A penalty on coming closer to a margin than `margin_clearance`
stands for failures, and one on a ball that slips or nearly does, whose episode goes on as if it gripped. An episode of full
length, or with noise, pays in its last half second for what it lacks of the goal, because the cost hardly tells rest at the
goal from rest near it.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import torch

from ballbot_gym import dynamics
from ballbot_gym.batch import COMPILE_OPTIONS, BallbotBatch, BatchState
from ballbot_gym.params import BallbotParams
from ballbot_gym.randomization import Randomization
from ballbot_gym.robots import robot_name
from ballbot_gym.seeding import spawned
from ballbot_gym.tasks import Task
from ballbot_train.learning import schedules
from ballbot_train.learning.actors import average_of, spec_for, started
from ballbot_train.learning.fitting import start_as_lqr
from ballbot_train.learning.state import load_state, state_of
from ballbot_train.policy import PolicyNetwork

if TYPE_CHECKING:
    from ballbot_train.learning.learners.shac import ShacConfig


_FINAL_LEARNING_RATE_FRACTION = 0.02  # it falls along half a cosine
_MAX_GRAD_NORM = 0.3  # the gradient is larger in nearly every iteration
_AVERAGED_ITERATIONS = 20  # over which the policy is a running average
# of ending outside of the goal, less this depth, in units of the goal functions
_GOAL_PENALTY, _GOAL_CLEARANCE = 30.0, 0.1
_FAILURE_PENALTY = 1000.0  # cost of a failure in training. It has no gradient
_GRIP_CLEARANCE, _GRIP_PENALTY = 0.05, 10000.0  # as of the margins, for `dynamics.limits` of robots that can slip
_MIN_COST = 0.5  # cheaper episodes are weighted as if they cost this much
_RESTING = 25  # last control steps that may lack the goal, of episodes of full length or with noise
# slope of the logarithm of an episode's cost with a state: steeper ones, of robots that fall, are cut. Near a friction limit
# slopes of 10 are common, and with cuts there the gradient led uphill
_STEEPEST, _STEEPEST_WITH_GRIP = 10.0, 100.0
_PATIENCE = 5  # control steps for which episodes go on when all have reached the goal
_COMPILE_FROM = 50  # iterations; compiling a control step takes half a minute
_STATE = ("iteration", "_trained", "_average", "_optimizer", "_batch")


class _Step(NamedTuple):
    """What a control step of B episodes gave."""

    x: torch.Tensor
    """(8, B) states at its end."""
    cost: torch.Tensor
    """(B,) of the step, with the penalty on margins."""
    lacking: torch.Tensor
    """(B,) what the state lacks of the goal and its clearance, in units of the goal functions."""
    inside: torch.Tensor
    """(B,) bool: in the goal."""
    failed: torch.Tensor
    """(B,) bool. A ball that slips goes on as if it gripped: the penalty on slipping has a gradient then."""
    actuator: torch.Tensor
    past: torch.Tensor
    """As of `BatchState`."""


class WholeEpisodes:
    """The learner; see `training.Learner`."""

    def __init__(
        self,
        task: Task,
        params: BallbotParams,
        config: "ShacConfig",
        seed: int = 0,
        randomization: Randomization | None = None,
        history: int = 0,
        informed: bool = False,
    ):
        torch.manual_seed(seed)  # for the network's first weights
        self.config, self.iteration = config, 0
        self.iterations, self.evaluations = config.iterations, config.evaluations
        self.task, self._own_steps = replace(task, duration=config.episode_seconds), task.steps
        world: dict[str, Any] = {"randomization": randomization, "history": history}
        self._wheels, long = params.wheels is not None, config.iterations >= _COMPILE_FROM
        self._batch = BallbotBatch(self.task, config.num_envs, compile=self._wheels and long, params=params, **world)
        self._batch.reset(seed=spawned(seed))
        network = PolicyNetwork(
            spec_for(task, config.symmetry, config.hidden, True, history, robot_name(params), informed)
        )
        start_as_lqr(network, task, params)
        self._make(network)

    def _make(self, network: PolicyNetwork) -> None:
        """Takes a policy network to be trained."""
        config = self.config
        self._trained = network
        self._average = average_of(network, _AVERAGED_ITERATIONS)
        self._optimizer = torch.optim.Adam(network.parameters(), config.learning_rate, betas=(0.9, 0.99))
        self._step = self._one_step
        if config.iterations >= _COMPILE_FROM and not self._wheels:  # else the batch compiles its part
            self._step = torch.compile(self._step, fullgraph=True, dynamic=False, options=COMPILE_OPTIONS)

    def start_from(self, network: PolicyNetwork) -> None:
        """Takes a policy of any shape, to be improved; it may have been trained on another robot and its episodes."""
        self._make(started(network, self._trained.spec))

    @property
    def network(self) -> PolicyNetwork:
        """A running average of the policy over its last iterations."""
        return cast(PolicyNetwork, self._average.module)

    def iterate(self) -> dict[str, float]:
        config = self.config
        progress = self.iteration / config.iterations
        rate = schedules.cosine(config.learning_rate, _FINAL_LEARNING_RATE_FRACTION, progress)
        self._optimizer.param_groups[0]["lr"] = rate
        costs, ended_well = self._episodes()
        loss = costs.clamp(min=_MIN_COST).log().mean()
        self._optimizer.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self._trained.parameters(), _MAX_GRAD_NORM)
        if torch.isfinite(norm):
            self._optimizer.step()
        self._average.update_parameters(self._trained)
        self.iteration += 1
        return {
            "loss/policy": loss.item(),
            "train/gradient": norm.item(),
            "train/failure_rate": 1 - ended_well.double().mean().item(),
            "train/learning_rate": rate,
        }

    def state_dict(self) -> dict[str, Any]:
        return state_of(self, _STATE)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        load_state(self, _STATE, state)

    def _episodes(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Runs new episodes; returns their costs (B,), which have gradients, and whether they ended well (B,)."""
        config, task = self.config, self.task
        self._batch.reset()
        state = cast(BatchState, self._batch.state)
        start = state.x
        total = torch.zeros(config.num_envs)
        alive, reached = torch.ones(config.num_envs, dtype=torch.bool), torch.zeros(config.num_envs, dtype=torch.bool)
        standing = alive  # an episode that has reached the goal goes on for a while, and may fail then
        noisy = self._batch.randomization.is_noisy
        rests = not task.first_exit and (noisy or task.steps >= self._own_steps)
        ends, patience = [], _PATIENCE
        last = torch.full_like(total, _FAILURE_PENALTY)
        for k in range(task.steps):
            step = self._step(state)
            total = total + torch.where(alive & standing, step.cost, 0.0)
            if rests and k >= task.steps - _RESTING:
                total = total + torch.where(alive, _GOAL_PENALTY / _RESTING * step.lacking, 0.0)
            alive, standing = alive & ~(step.failed & ~reached), standing & ~step.failed
            if task.first_exit:
                ended = total + _GOAL_PENALTY * step.lacking
                ends.append(torch.where(alive & standing, ended, math.inf))
                last = torch.where(alive & standing, ended, last)
                reached = reached | (alive & step.inside)
                patience -= bool((reached | ~alive).all())
                if not patience:
                    break
            # where an episode has failed, the model goes on from its start, which leads to no infinite numbers
            x = torch.where(alive & standing, step.x, start)
            if self._batch.randomization.active and x.requires_grad:
                x.register_hook(self._tamed)
            state = state._replace(x=x, actuator=step.actuator, past=step.past, steps=state.steps + 1)
        if not task.first_exit:
            return total + _FAILURE_PENALTY * ~alive, alive
        # one that fails ends where it failed, and not at its best moment before
        return torch.where(alive, torch.stack(ends).amin(0), last), reached

    def _tamed(self, slope: torch.Tensor) -> torch.Tensor:
        """The slope (8, B) of the mean of B episodes' losses with their states, in no episode steeper than the steepest."""
        steepest = _STEEPEST_WITH_GRIP if self._batch.params.grips else _STEEPEST
        most = steepest / slope.shape[1]
        return torch.nan_to_num(slope * (most / slope.norm(dim=0)).clamp(max=1.0), 0.0, 0.0, 0.0)

    def _one_step(self, state: BatchState) -> _Step:
        """One control step of every episode; compiled."""
        config, task = self.config, self.task
        action = self._trained.knowing(self._batch.observe(state), state, self._batch.randomization)
        new, result = self._batch.transition(state, action)
        before, force = state.x.unbind(0), result.force.unbind(0)
        x, time = result.final_x.unbind(0), state.steps * task.control_dt
        cost = task.cost(before, force, task.at(state.c.unbind(0), time)) * task.control_dt
        c = task.at(state.c.unbind(0), time + task.control_dt)
        if config.margin_penalty:
            for margin in task.margins(x, c):
                shortfall = (config.margin_clearance - margin).clamp(min=0)
                cost = cost + config.margin_penalty * task.control_dt * shortfall**2
        cost = cost + grip_penalty(self._batch.model(state.drawn.unbind(0)), before, force, task.control_dt)
        goal = torch.stack(task.goal(x, c))
        lacking = (goal + _GOAL_CLEARANCE).clamp(min=0).sum(0)
        inside = (goal <= 0).all(0)
        failed = result.failure & (result.violated != len(task.limit_names))  # that number is grip's
        return _Step(result.final_x, cost, lacking, inside, failed, new.actuator, new.past)


def grip_penalty(params: Any, x: tuple[Any, ...], force: tuple[Any, ...], dt: float) -> Any:
    """What a control step of dt, s, in which the ball slips or nearly does, costs in training, of B robots: (B,) or 0."""
    shortfalls = ((_GRIP_CLEARANCE - limit).clamp(min=0) for limit in dynamics.limits(params, x, force, hold=dt))
    return sum(_GRIP_PENALTY * dt * shortfall**2 for shortfall in shortfalls)
