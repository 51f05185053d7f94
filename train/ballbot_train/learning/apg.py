"""Analytic policy gradient: the policy follows the exact gradient of the cost of whole episodes.

The gradient runs through the batched model and the policy (Freeman et al., "Brax", 2021, describe the method). Each iteration
draws episodes, runs them, and lowers the logarithm of their costs. There is no critic whose errors would be followed as well,
so this takes a good policy nearer to the optimum than the other learners do.

Two parts of a task have no gradient and get one here. Failures become a penalty on coming closer to a margin than
`margin_clearance`, and, where friction is limited, a penalty on a ball that nearly slips. A ball that slips moves on as if it
gripped. A first exit is taken at the control step with the least sum of the cost so far and a penalty on the distance from
the goal. An episode of full length, or with noise, pays in its last half second for its distance from the goal, because the
costs of rest at the goal and of rest near it are almost equal.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import torch

from ballbot_gym.robot import Randomization, Robot
from ballbot_gym.seeding import spawned
from ballbot_gym.tasks import Task
from ballbot_gym.vector.batch import COMPILE_OPTIONS, BallbotBatch, BatchState
from ballbot_train.learning import schedules
from ballbot_train.learning.actors import RoutedSymmetry, actor_for, average_of
from ballbot_train.learning.routing import fit_routes
from ballbot_train.learning.settings import MOST, MOST_ENVS, Settings, number
from ballbot_train.learning.state import load_state, state_of
from ballbot_train.policy.network import PolicyNetwork


@dataclass(frozen=True)
class ApgConfig(Settings):
    """Settings of the learner."""

    iterations: int = number(300, 1, MOST)
    """Iterations of `num_envs` whole episodes."""
    evaluations: int = number(10, 1, MOST)
    """Evaluations, at equal distances."""
    num_envs: int = number(256, 1, MOST_ENVS)
    """Envs that are stepped together."""
    episode_seconds: float = number(4.0, 0)
    """Duration of the episodes, s."""
    learning_rate: float = number(3e-3, above=0)
    """Learning rate; it falls along half a cosine."""
    hidden: tuple[int, ...] = number((128, 128), 1, 2**14)
    """Units of hidden layers."""
    symmetry: RoutedSymmetry = "none"
    """What the actor keeps of the task's symmetry."""
    margin_clearance: float = number(0.0, 0)
    """Distance to a margin where a penalty starts."""
    margin_penalty: float = number(0.0, 0)
    """Per second and squared shortfall of it; 0: none."""

    def check(self) -> None:
        super().check()
        if self.margin_clearance and not self.margin_penalty:
            raise ValueError("margin_clearance needs margin_penalty above 0")


TUNED: dict[str, ApgConfig] = {
    "": ApgConfig(),
    "stabilize": ApgConfig(symmetry="odd"),
    # larger steps make a good policy miss the gate at first
    "turn": ApgConfig(iterations=400, num_envs=512, episode_seconds=6.0, learning_rate=1e-4),
    "weave": ApgConfig(hidden=(256, 256), symmetry="frame", margin_clearance=0.1, margin_penalty=3000.0),
}
"""Exceptions by name of task; every other task takes the defaults."""

_MIN_COST = 0.5  # cheaper episodes are weighted as if they cost this much
_FAILURE_PENALTY = 1000.0  # cost of a failure in training, whenever it comes. It has no gradient
_GRIP_CLEARANCE, _GRIP_PENALTY = 0.05, 10000.0  # same as for the margins, for `Ballbot.limits` of robots that can slip
_COMPILE_FROM = 50  # iterations; compiling a control step takes half a minute
_BETAS, _FINAL_LEARNING_RATE_FRACTION = (0.9, 0.99), 0.02  # of Adam; the rate falls along half a cosine
_MAX_GRAD_NORM = 0.3  # the gradient is larger in nearly every iteration
_AVERAGED_ITERATIONS = 20  # over which the policy is a running average
# of ending outside of the goal, less this depth, in units of the goal functions
_GOAL_PENALTY, _GOAL_CLEARANCE = 30.0, 0.1
_RESTING = 25  # last control steps that may lack the goal, of episodes of full length or with noise
# slope of the logarithm of an episode's cost with a state: steeper ones, of robots that fall, are cut. Near a friction limit
# slopes of 10 are common, and with cuts there the gradient led uphill
_STEEPEST, _STEEPEST_WITH_GRIP = 10.0, 100.0
_PATIENCE = 5  # control steps for which episodes go on when all have reached the goal
_STATE = ("iteration", "_trained", "_average", "_optimizer", "_batch")


class _Apg:
    """The learner; see `training.Learner`."""

    def __init__(
        self,
        task: Task,
        params: Robot,
        config: ApgConfig,
        seed: int = 0,
        start: PolicyNetwork | None = None,
        randomization: Randomization | None = None,
        history: int = 0,
        informed: bool = False,
    ):
        """See `Algorithm.make`."""
        torch.manual_seed(seed)  # for the networks' first weights
        self.config, self.iteration, self._own, self._seed, self._warm = config, 0, task, seed, start is not None
        self.iterations, self.evaluations = config.iterations, config.evaluations
        self.task = replace(task, duration=config.episode_seconds)
        config.check_memory(config.num_envs, self.task.steps)
        self._trained = actor_for(task, params, config, history, informed, start)
        self._average = average_of(self._trained, _AVERAGED_ITERATIONS)
        self._optimizer = torch.optim.Adam(self._trained.parameters(), config.learning_rate, betas=_BETAS)
        equations, long = params.LONG_EQUATIONS, config.iterations >= _COMPILE_FROM
        world: dict[str, Any] = {"params": params, "randomization": randomization, "history": history}
        self._batch = BallbotBatch(self.task, config.num_envs, compile=equations and long, **world)
        self._batch.reset(seed=spawned(seed))
        self._step = self._control_step
        if long and not equations:  # else the batch compiles its part
            # torch compiles this step for a few learners of a process only; earlier ones are compiled again if they go on
            torch.compiler.reset()
            self._step = torch.compile(self._step, fullgraph=True, dynamic=False, options=COMPILE_OPTIONS)

    @property
    def network(self) -> PolicyNetwork:
        """A running average of the policy over its last iterations."""
        return cast(PolicyNetwork, self._average.module)

    def state_dict(self) -> dict[str, Any]:
        return state_of(self, _STATE)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        load_state(self, _STATE, state)

    def iterate(self) -> dict[str, float]:
        routes = self._trained.routes
        if (
            routes is not None and self.iteration == 0 and not self._warm
        ):  # a policy to start from has learned its routes
            fit_routes(routes, self._own, self._batch.params, self._seed)
        costs, ended_well = self._episodes()
        figures = self._descend(costs.clamp(min=_MIN_COST).log().mean())
        self._average.update_parameters(self._trained)
        self.iteration += 1
        return {**figures, "train/failure_rate": 1 - ended_well.double().mean().item()}

    def _descend(self, loss: torch.Tensor) -> dict[str, float]:
        """Moves the policy against the gradient of the loss (); returns figures to log."""
        share = self.iteration / self.config.iterations
        rate = schedules.cosine(self.config.learning_rate, _FINAL_LEARNING_RATE_FRACTION, share)
        self._optimizer.param_groups[0]["lr"] = rate
        self._optimizer.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self._trained.parameters(), _MAX_GRAD_NORM)
        if torch.isfinite(norm):
            self._optimizer.step()
        return {"loss/policy": loss.item(), "train/gradient": norm.item(), "train/learning_rate": rate}

    def _episodes(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Runs new episodes; returns their costs (B,), which have gradients, and whether they ended well (B,)."""
        config, task = self.config, self.task
        self._batch.reset()
        state = cast(BatchState, self._batch.state)
        start = state.x
        total = torch.zeros(config.num_envs)
        alive, reached = torch.ones(config.num_envs, dtype=torch.bool), torch.zeros(config.num_envs, dtype=torch.bool)
        standing = alive  # an episode that has reached the goal continues for a while, and may still fail
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
            # failed episodes continue from their start states, so that no number becomes infinite
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

    def _control_step(self, state: BatchState) -> tuple[torch.Tensor, ...]:
        """One control step of every env. A ball that slips moves on as if it gripped, so that the penalty on slipping has a
        gradient.

        Returns:
            The states (8, B) at its end, its cost (B,) with the penalties on nearness to margins and on a ball that slips or
            nearly does, what the states lack of the goal and its clearance (B,), in units of the goal functions, whether they
            are in the goal (B,), and failed (B,), then `actuator` and `past`.
        """
        config, task, dt = self.config, self.task, self.task.control_dt
        observation = self._batch.observe(state)
        action = self._trained.knowing(observation, state, self._batch.randomization)
        new, result = self._batch.transition(state, action)
        before, force, x = (part.unbind(0) for part in (state.x, result.force, result.final_x))
        time = state.steps * dt
        cost = task.cost(before, force, task.at(state.c.unbind(0), time)) * dt
        c = task.at(state.c.unbind(0), time + dt)
        if config.margin_penalty:
            for margin in task.margins(x, c):
                cost = cost + config.margin_penalty * dt * (config.margin_clearance - margin).clamp(min=0) ** 2
        limits = self._batch.model(state.drawn.unbind(0)).limits(before, force, hold=dt)
        shortfalls = [(_GRIP_CLEARANCE - limit).clamp(min=0) for limit in limits]
        cost = cost + sum(_GRIP_PENALTY * dt * shortfall**2 for shortfall in shortfalls)
        goal = torch.stack(task.goal(x, c))
        lacking = (goal + _GOAL_CLEARANCE).clamp(min=0).sum(0)
        failed = result.failure & (result.violated != len(task.limit_names))  # that number is grip's
        return result.final_x, cost, lacking, (goal <= 0).all(0), failed, new.actuator, new.past


make = _Apg
