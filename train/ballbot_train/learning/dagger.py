"""DAgger with the optimum as the expert: every state that the learner reaches is labelled with the optimal action there.

The first iterations gather samples. Each of them draws episodes and finds their optima, thousands at once where that is
possible. Half of the episodes then follow the expert, with noise, and half the learner. From one state of each of them the
optimum is searched again, and the episode runs again from there (Ross et al., "A reduction of imitation learning and
structured prediction to no-regret online learning", 2011, with the mixture β of expert and learner drawn per episode).

The feedback about an optimum is the derivative of the optimal force with respect to the state. It labels every state that an
episode reaches near its optimum, and the states around it too: every batch draws new ones, whose labels differ by −K δ. This
fits the slope of the policy together with its value, as in Czarnecki et al., "Sobolev training for neural networks" (2017).
There are two exceptions, whose states label themselves alone, with errors divided by the cost of the episode's optimum, as in
the regret. If a goal ends the episode, the derivative is steep before the goal, and policies that were fitted to it missed
the goal more often. If observations depend on the past, on noise or on delayed forces, they are not known for other states.

Where a learner decides first on which sides it passes obstacles, the optima are those that pass them on these sides.

A share of the episodes begins where the learner fails or pays most, because failures are at the edge of what can be recovered
from. Where these show within seconds, very many starts are tried, because failures become rare, and the hardest of them again
in later iterations. In slaloms those starts are the hardest from which the learner touches an obstacle or comes nearest to
one. On a track the expert has access to each episode's robot. The learner gets observations alone.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ballbot_baselines import Backoff, Optimum, find_optima
from ballbot_baselines.feedback.lqr import equilibrium_gain
from ballbot_baselines.feedback.trajopt import EXECUTED
from ballbot_gym.robot import Randomization, Robot, registered_name
from ballbot_gym.tasks import Task
from ballbot_gym.vector.batch import BallbotBatch, BatchState
from ballbot_train.evaluation import fresh
from ballbot_train.learning import schedules
from ballbot_train.learning.actors import RoutedSymmetry, actor_for
from ballbot_train.learning.datasets import load_demos
from ballbot_train.learning.fitting import Fit, Samples
from ballbot_train.learning.routing import fit_routes
from ballbot_train.learning.settings import MOST, Settings, number
from ballbot_train.policy.network import PolicyNetwork


@dataclass(frozen=True)
class DaggerConfig(Settings):
    """Settings of `Dagger`."""

    iterations: int = number(60, 1, MOST)
    """Number of iterations."""
    gathering_iterations: int = number(40, 0, MOST)
    """First of them that gather samples; 0: clone --demos."""
    evaluations: int = number(10, 1, MOST)
    """Evaluations, at equal distances."""
    episodes_per_iteration: int = number(512, 1, MOST)
    """Episodes of a gathering iteration, of two optima each."""
    backoff: Backoff = Backoff(grip=EXECUTED.grip)
    """What optima keep from their limits."""
    gradient_steps: int = number(1500, 1, MOST)
    """Gradient steps per iteration."""
    batch_size: int = number(1024, 1, MOST)
    """Samples per gradient step."""
    learning_rate: float = number(3e-3, above=0)
    """Learning rate; it falls along half a cosine."""
    hidden: tuple[int, ...] = number((128, 128), 1, 2**14)
    """Units of hidden layers."""
    symmetry: RoutedSymmetry = "none"
    """What the actor keeps of the task's symmetry."""


# few samples suffice that label the states around them too
_FEW = DaggerConfig(iterations=20, evaluations=5, batch_size=256, learning_rate=1e-2, hidden=(64, 64))
TUNED: dict[str, DaggerConfig] = {
    "": DaggerConfig(),
    "stabilize": replace(_FEW, gathering_iterations=8, gradient_steps=1000, symmetry="odd"),
    "turn": DaggerConfig(symmetry="frame", backoff=Backoff(goal=0.4, grip=EXECUTED.grip)),
    "orbit": replace(_FEW, gathering_iterations=3, symmetry="centred"),
    "weave": replace(
        _FEW,
        gathering_iterations=8,
        episodes_per_iteration=256,
        gradient_steps=2500,
        learning_rate=5e-3,
        hidden=(128, 128),
        symmetry="routes",
        backoff=Backoff(margin=0.06, grip=EXECUTED.grip),
    ),
}
"""Exceptions by name of task; every other task takes the defaults."""

_SECONDS = 5.0  # of an optimum that become samples
_STATES = 32  # of each optimum that become samples, on average
_AROUND = {"m": 0.05, "rad": 0.05, "m/s": 0.15, "rad/s": 0.15}
"""Largest standard deviations of the states around a sample, by the unit of a component; others stay."""
# of the expert's actions, and where the ball may slip: each episode draws the deviation of its noise from 0 to this
_NOISE, _NOISE_IN_GRIP = 0.2, 0.05
_SMALL = 0.3  # of the force limit: a derivative is no guide to greater changes
_WINDOW = 0.5  # s, for which a state may be ahead of its optimum or behind it
# the scale of a distance in each component of a state, SI units
_SPREAD = np.array([0.1, 0.1, 0.05, 0.05, 0.3, 0.3, 0.3, 0.3, 0.05, 0.3, 0.3])
_SAME_WAY = 1.5  # m between two ways that are the same
# of an iteration's episodes; how many are drawn for each of these, and for how many seconds at most these are tried; of the
# hardest so far, for each of these in each iteration, how many are tried again
_HARD, _HARD_OF_MANY, _HARD_SLALOMS = (0.25, 16, math.inf, 0), (0.5, 256, 2.0, 4), (0.5, 128, 3.4, 4)
_TOGETHER = 4096  # starts that are tried at once
_LARGE = 0.1  # error of an action
_ROBOTS = 16  # of an iteration on a track
_FINAL_LEARNING_RATE_FRACTION = 0.01
_MIN_COST = 1.0  # cheaper episodes are weighted as if their optimum cost this much


@dataclass(frozen=True)
class _Optima:
    """Optima of B episodes of at most n control steps as arrays.

    | field | shape | meaning |
    |---|---|---|
    | costs | (B,) | NaN where none was found |
    | solved | (B,) bool | whether one was found |
    | steps | (B,) | control steps, fewer than n where a goal is reached |
    | states | (B, n+1, 8) | after its end an episode's last state is repeated |
    | forces | (B, n, 2) | N |
    | gains | (B, n, 2, 8) | as in `Optimum` |
    """

    costs: np.ndarray
    solved: np.ndarray
    steps: np.ndarray
    states: np.ndarray
    forces: np.ndarray
    gains: np.ndarray

    @classmethod
    def none(cls, count: int, n: int, states: int, forces: int) -> "_Optima":
        """Of `count` episodes, none of them solved."""
        x, u, k = np.zeros((count, n + 1, states)), np.zeros((count, n, forces)), np.zeros((count, n, forces, states))
        return cls(np.full(count, np.nan), np.zeros(count, bool), np.full(count, n), x, u, k)

    def put(self, i: int, optimum: Optimum | None) -> None:
        """Sets the optimum of one episode, if it was found."""
        if optimum is not None and optimum.is_optimal:
            plan, n = optimum.trajectory, len(optimum.trajectory.u)
            self.costs[i], self.solved[i], self.steps[i] = optimum.cost, True, n
            self.states[i] = plan.x[np.minimum(np.arange(self.states.shape[1]), n)]
            self.forces[i, :n], self.gains[i, :n] = plan.u, optimum.gains


@dataclass
class _Labels(Samples):
    """Samples. Those near optima label the states around them too.

    | field | shape | meaning |
    |---|---|---|
    | states | (n, 8) float32 | SI units; NaN where a sample labels its own observation alone |
    | constants | (n, nc) float32 | of the episodes |
    | gains | (n, 2, 8) float32 | K: the action at states + δ is actions − K δ |
    """

    states: torch.Tensor
    constants: torch.Tensor
    gains: torch.Tensor
    around: np.ndarray
    """(8,) standard deviations of δ at most, SI units."""
    observe: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
    """From states (m, 8) and constants (m, nc) to observations (m, no)."""
    prepare: Callable[[torch.Tensor], torch.Tensor]
    """`PolicyNetwork.prepared` of observations (m, no)."""

    def draw(self, count: int, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        rows = torch.as_tensor(rng.integers(len(self), size=count))
        observations, actions, states = self.observations[rows], self.actions[rows], self.states[rows]
        known = states[:, 0].isfinite()[:, None]
        if known.any():
            share = rng.random((count, 1), dtype=np.float32) * self.around
            off = torch.as_tensor(share * rng.standard_normal(share.shape, dtype=np.float32))
            change = (self.gains[rows] * off[:, None]).sum(2)
            less = _SMALL / change.abs().amax(1, keepdim=True).clamp(min=_SMALL)
            actions = (actions - less * change).clamp(-1, 1).where(known, actions)
            observations = self.observe(states + less * off, self.constants[rows]).where(known, observations)
        return self.prepare(observations), actions, self.weights[rows]


class Dagger:
    """The learner; see `training.Learner`. An iteration's random numbers depend on seed and iteration alone."""

    def __init__(
        self,
        task: Task,
        params: Robot,
        config: DaggerConfig,
        seed: int = 0,
        demos: str | Path | None = None,
        start: PolicyNetwork | None = None,
        randomization: Randomization | None = None,
        history: int = 0,
    ):
        """See `Algorithm.make`. Demonstrations are its first samples."""
        on_track, robot = randomization is not None or history > 0, registered_name(params)
        shown = _demonstrations(demos, task, robot, config, on_track)
        self.config, self.iteration, self._warm = config, 0, start is not None
        self.iterations, self.evaluations = config.iterations, config.evaluations
        self._task, self._params, self._seed = task, params, seed
        self._randomization, self._history = randomization or Randomization(), history
        torch.manual_seed(seed)
        varied = self._randomization
        present = not (history or varied.varies_actuator or varied.is_noisy)
        self._around = present and not task.first_exit
        """Whether samples label the states around them too; see the top of this file."""
        alone = self._around and task.routed_frame is None
        # a robot that is to come to rest shows within seconds whether it can
        rests = self._around and equilibrium_gain(task, params) is not None
        self._hard = (_HARD_OF_MANY if alone else _HARD_SLALOMS) if rests else _HARD
        self._tried = np.zeros((0, params.state_size)), np.zeros((0, len(task.constant_names)))
        """Initial states and constants of the hardest starts of earlier iterations."""
        # slopes are fitted best by smooth layers, and labels at the limits by a clip; with routes, it touched more obstacles
        activation, squash = "silu" if self._around else "tanh", "clip" if alone else "tanh"
        self.network = actor_for(task, params, config, history, False, start, activation, squash)
        # where the optimum jumps between neighbouring starts, a mean of both sides is worse than either
        self._fit = Fit(self.network, self.network.acting, _LARGE if rests else math.inf)
        empty = np.zeros((0, self.network.spec.seen)), np.zeros((0, params.action_size)), np.zeros(0)
        self._samples = self._samples_of(*(shown or empty))

    def iterate(self) -> dict[str, float]:
        config, figures, routes = self.config, {}, self.network.routes
        if routes is not None and self.iteration == 0 and not self._warm:
            fit_routes(routes, self._task, self._params, self._seed)
        rng = np.random.default_rng([self._seed, self.iteration])
        if self.iteration < config.gathering_iterations or not len(self._samples):
            figures = self._gather(rng)
        if not len(self._samples):
            raise ValueError(
                f"there is nothing to learn from: no optimum was found in {config.episodes_per_iteration} episodes of "
                f"{self._task.id} with the robot {registered_name(self._params)}; train with ppo or apg, or try more episodes"
            )
        progress = self.iteration / config.iterations
        rate = schedules.cosine(config.learning_rate, _FINAL_LEARNING_RATE_FRACTION, progress)
        loss = self._fit.run(self._samples, config.gradient_steps, config.batch_size, rate, rng)
        self.iteration += 1
        return {"loss/imitation": loss, "train/learning_rate": rate, "train/samples": len(self._samples), **figures}

    def state_dict(self) -> dict[str, Any]:
        tried = [torch.as_tensor(part) for part in self._tried]
        return {
            "iteration": self.iteration,
            "samples": self._samples.tensors(),
            "tried": tried,
            **self._fit.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.iteration, self._tried = state["iteration"], tuple(part.numpy() for part in state["tried"])
        for name, tensor in state["samples"].items():
            setattr(self._samples, name, tensor)
        self._fit.load_state_dict(state)

    def _gather(self, rng: np.random.Generator) -> dict[str, float]:
        """Labels the states of episodes: from their beginnings, and then, with new optima, from one that each came to."""
        task, randomization, robots, drawn = self._task, self._randomization, [self._params], np.zeros((1, 0))
        if randomization.varies_episodes:
            draws = rng.random((_ROBOTS, randomization.most_draws))
            drawn = np.array([randomization.draw(tuple(z), task.control_dt) for z in draws])
            robots = [randomization.robot(self._params, tuple(row)) for row in drawn.tolist()]
        each = -(-self.config.episodes_per_iteration // len(robots))
        robots, drawn = [robot for robot in robots for _ in range(each)], drawn.repeat(each, axis=0)
        x, c = self._beginnings(len(robots), rng)
        batch = BallbotBatch(
            task, len(robots), compile=False, params=self._params, randomization=randomization, history=self._history
        )
        given = (torch.as_tensor(part.T, dtype=batch.dtype) for part in (x, c, drawn))
        start = batch.initial_state(int(rng.integers(2**31)), None, *given)
        states, lasted, optima = self._labelled_run(batch, start, robots, rng)
        at = rng.integers(lasted)
        reached = (
            torch.stack([parts[k][..., i] for i, k in enumerate(at.tolist())], -1)
            for parts in zip(*states, strict=True)
        )
        _, _, again = self._labelled_run(batch, BatchState(*reached), robots, rng, (optima, at))
        return {"train/labelled": float(np.mean([optima.solved, again.solved]))}

    def _beginnings(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Initial states (count, 8) and constants (count, nc). As far as there are some, a share are the hardest
        of many: those in which the learner does not succeed, and then those that cost it most; or, where it has routes, those
        in which it comes nearest to an obstacle.
        """
        share, among, seconds, again = self._hard
        hard = round(share * count) if self.iteration else 0
        some = count - hard
        draws = (self._task.sample(rng, self._params) for _ in range(some + among * hard))
        x, c = map(np.array, zip(*draws, strict=True))
        if not hard:
            return x, c
        x, c = (np.concatenate([drawn, earlier]) for drawn, earlier in zip((x, c), self._tried, strict=True))
        order = some + self._hardest(x[some:], c[some:], seconds)
        # so few fail that an iteration's own draws do not show what the learner has unlearned
        kept = order[: again * hard * self.iteration]
        self._tried = x[kept], c[kept]
        rows = np.append(np.arange(some), order[:hard])
        rng.shuffle(rows)
        return x[rows], c[rows]

    def _hardest(self, x: np.ndarray, c: np.ndarray, seconds: float) -> np.ndarray:
        """(B,) the order of starts x (B, 8) with constants c (B, nc), the hardest first, by what the learner does there."""
        task, robot = self._task, registered_name(self._params)
        shorter = task.control_dt * math.ceil(min(seconds, task.duration) / task.control_dt)
        whole = shorter >= task.duration
        tried = task if whole else replace(task, duration=shorter)
        bad, ease, slalom = [], [], self.network.routes is not None
        for first in range(0, len(x), _TOGETHER):
            some = slice(first, first + _TOGETHER)
            drawn = np.zeros((len(x[some]), 0))
            ran = fresh.run_policy(self.network, tried, x[some], c[some], drawn, robot, margins=slalom)
            bad.append(~ran.success if whole else ran.failure)
            # what a slalom costs depends on its length above all
            ease.append(ran.margin if slalom else -ran.cost)
        return np.lexsort((torch.cat(ease).numpy(), ~torch.cat(bad).numpy()))

    def _labelled_run(
        self,
        batch: BallbotBatch,
        state: BatchState,
        robots: Sequence[Robot],
        rng: np.random.Generator,
        before: tuple[_Optima, np.ndarray] | None = None,
    ) -> tuple[list[BatchState], np.ndarray, _Optima]:
        """Runs B episodes from a state under expert or learner, and labels what is seen near the optimum of each.

        Args:
            before: the optima from the beginnings of the episodes, and how many control steps these have lasted, (B,).

        Returns:
            The states of all control steps, how many of them each episode lasted (B,), and the optima.
        """
        task, limits = self._task, np.array([[robot.force_limit] for robot in robots])
        c = state.c.T.double().numpy()
        x, sides = self._ahead(batch, state), self._sides(batch.observe(state))
        optima = self._optima_of(robots, x, c, sides)
        usable, costs = optima.solved, optima.costs
        if before is not None:
            costs = np.where(before[0].solved, before[0].costs, costs)
            usable = usable & _goes_on(optima, *before)
        steps = max(1, round(_SECONDS / task.control_dt))
        expert = rng.random((len(robots), 1)) < 0.5
        noise = (_NOISE_IN_GRIP if self._params.grips else _NOISE) * rng.random((len(robots), 1))
        states, lasted, running = [], np.zeros(len(robots), int), np.ones(len(robots), bool)
        found: list[_Labels] = []
        for k in range(min(steps, task.steps)):
            states.append(state)
            lasted += running
            observation = batch.observe(state)
            x = self._ahead(batch, state)
            label, near, gains = self._labels(optima, x, k, limits)
            # where samples label the states around them, the early ones matter most: these differ most from each other
            share = 0.5 * _STATES / math.sqrt(steps * (k + 0.5)) if self._around else _STATES / steps
            near &= running & usable & (rng.random(len(near)) < share)
            around = (x[near], c[near], gains[near]) if self._around else None
            weights = np.ones(near.sum()) if self._around else 1 / np.maximum(costs[near], _MIN_COST)
            found.append(self._samples_of(observation[near].numpy(), label[near], weights, around))
            with torch.no_grad():
                actions = np.where(expert, label + noise * rng.standard_normal(label.shape), self.network(observation))
            state, result = batch.transition(state, torch.as_tensor(actions))
            running &= ~(result.terminated | result.truncated).numpy()
            if not running.any():
                break
        self._samples.add(*found)
        return states, lasted, optima

    def _labels(
        self, optima: _Optima, x: np.ndarray, k: int, limits: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The optimal actions (B, 2) in states x (B, 8) about control step k, whether each state is near its optimum, and
        the feedback (B, 2, 8) of actions there.

        A policy does not know the time. So what counts is the nearest state of the optimum, which may be some steps away.
        """
        rows, window = np.arange(len(x)), round(_WINDOW / self._task.control_dt)
        around = np.arange(max(0, k - window), min(optima.forces.shape[1], k + window + 1))
        distances = (((x[:, None] - optima.states[:, around]) / _SPREAD[: x.shape[1]]) ** 2).sum(2)
        distances[around >= optima.steps[:, None]] = np.inf
        at = around[distances.argmin(1)]
        change = -np.einsum("bij,bj->bi", optima.gains[rows, at], x - optima.states[rows, at])
        near = (np.abs(change) < _SMALL * limits).all(1) & np.isfinite(distances.min(1))
        gains = optima.gains[rows, at] / limits[..., None]
        return np.clip((optima.forces[rows, at] + change) / limits, -1, 1), near, gains

    def _samples_of(
        self,
        observations: np.ndarray,
        actions: np.ndarray,
        weights: np.ndarray,
        around: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    ) -> _Labels:
        """Samples; `around` holds the states, constants and gains of those that label the states around them too."""
        own, params = Samples.of(observations, actions, weights), self._params
        shapes = (params.state_size,), (len(self._task.constant_names),), (params.action_size, params.state_size)
        more = around or [np.full((len(own), *shape), np.nan) for shape in shapes]
        tensors = (torch.as_tensor(part, dtype=torch.float32) for part in more)
        scale = np.array([_AROUND.get(quantity.unit, 0.0) for quantity in params.STATE], np.float32)
        functions: Any = {"observe": self._observed, "prepare": self.network.prepared}
        return _Labels(own.observations, own.actions, own.weights, *tensors, around=scale, **functions)

    def _observed(self, states: torch.Tensor, constants: torch.Tensor) -> torch.Tensor:
        """Observations (n, no) of states (n, 8) of episodes with constants (n, nc)."""
        return torch.stack(tuple(self._task.seen(states.unbind(1), constants.unbind(1), self._params)), 1)

    def _optima_of(
        self, robots: Sequence[Robot], x: np.ndarray, c: np.ndarray, sides: list[tuple[int, ...]] | None
    ) -> _Optima:
        """The optima of B episodes from states x (B, 8) with constants c (B, nc); those of one robot are neighbours. They
        pass obstacles on the learner's sides.
        """
        found: list[Optimum | None] = []
        for robot, rows in itertools.groupby(range(len(robots)), robots.__getitem__):
            of = list(rows)
            few: dict[str, int] = {"guesses": 1} if robot.LONG_EQUATIONS else {}  # each takes seconds
            own = sides and [sides[i] for i in of]
            found += find_optima(self._task, robot, x[of], c[of], self.config.backoff, **few, sides=own)
        optima = _Optima.none(len(x), self._task.steps, x.shape[1], robots[0].action_size)
        for i, optimum in enumerate(found):
            optima.put(i, optimum)
        return optima

    def _sides(self, observation: torch.Tensor) -> list[tuple[int, ...]] | None:
        """On which sides the learner's routes pass the obstacles of B episodes; None if it has no routes."""
        if self.network.routes is None:
            return None
        return [tuple(sides) for sides in self.network.routes(observation).int().tolist()]

    def _ahead(self, batch: BallbotBatch, state: BatchState) -> np.ndarray:
        """(B, 8) where the robots will be when a force of now arrives, after those that are on their way."""
        x, commands = state.x.unbind(0), state.actuator[2:].unflatten(0, (-1, 2)) if len(state.actuator) > 2 else ()
        robot = batch.model(state.drawn.unbind(0))
        for age in range(len(commands), 0, -1):
            dt = self._task.control_dt
            later = robot.step(x, commands[age - 1].unbind(0), dt, robot.substeps(dt))
            x = tuple(torch.where(state.drawn[5] >= age, new, old) for new, old in zip(later, x, strict=True))
        return torch.stack(x, 1).double().numpy()


def _goes_on(optima: _Optima, before: _Optima, at: np.ndarray) -> np.ndarray:
    """(B,) whether optima go where earlier ones, which began `at` (B,) control steps ago, went on to go, if there were any.

    Where two ways cost about the same, a policy that changes its mind under way takes neither.
    """
    n = optima.states.shape[1]
    then = before.states[np.arange(len(at))[:, None], np.minimum(at[:, None] + np.arange(n), n - 1)]
    return (np.abs(optima.states - then)[..., :2].max((1, 2)) < _SAME_WAY) | ~before.solved


def _demonstrations(
    demos: str | Path | None, task: Task, robot: str, config: DaggerConfig, on_track: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Observations, actions and weights of demonstrations, if there are any; raises a ValueError if they do not fit."""
    if demos is None:
        if config.gathering_iterations:
            return None
        raise ValueError('gathering_iterations 0 needs demonstrations: give --demos a dataset of "ballbot demos"')
    if on_track:
        raise ValueError(
            "demonstrations have no earlier observations and no track; leave out --demos, or --randomization and --history"
        )
    loaded = load_demos(demos, task, robot)
    weights = np.full(len(loaded), 1 / max(loaded.median_cost(task), _MIN_COST))
    return loaded.observations, loaded.actions, weights


make = Dagger
