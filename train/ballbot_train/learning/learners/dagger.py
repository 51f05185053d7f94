"""DAgger with the optimum as the expert: every state that the learner reaches is labelled with the optimal action there.

The first iterations gather samples. Each of them draws some episodes and plans them. The learner then starts somewhere on
these plans, or at their beginnings, and acts for a while. From the state that it reaches the optimum is searched anew. The
search starts from the rest of the episode's plan, so it passes obstacles on the same side and turns in the same way. Early
rollouts are short and start mostly on the plans. Later ones are longer and start mostly at the beginnings of the episodes
(Ross et al., "A reduction of imitation learning and structured prediction to no-regret online learning", 2011, with the
mixture β of expert and learner drawn per episode).

Every state of an optimum becomes a sample, not only its first. TVLQR labels further states at the price of a matrix product,
because its gain is the derivative of the optimal force with respect to the state. It labels `tube_samples` states drawn
around each state of an optimum, and the states of whole episodes under the learner as far as they lie within `max_distance`
of the episode's plan. Errors are weighted by one over the cost of the episode's optimum, as regret is.

With a C compiler, thousands of optima can be found at once (`batch_episodes`): half of them from the beginnings of episodes,
half from states that the learner reaches from there. They bring the feedback about them, so states around them are labelled
too.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree

from ballbot_baselines import batched
from ballbot_baselines.optimum import Backoff, find_optimum
from ballbot_baselines.trajopt import EXECUTED
from ballbot_baselines.tvlqr import tube_gains
from ballbot_gym import dynamics
from ballbot_gym.batch import BallbotBatch, BatchState
from ballbot_gym.batch_episodes import BatchEpisodes, run_episodes
from ballbot_gym.params import BallbotParams
from ballbot_gym.paths import then_stay
from ballbot_gym.randomization import Randomization
from ballbot_gym.robots import robot_name
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task
from ballbot_train.learning import schedules
from ballbot_train.learning.actors import RoutedSymmetry, spec_for, started
from ballbot_train.learning.datasets import StreamedDemos, load_demos
from ballbot_train.learning.fitting import Fit, Samples, start_as_lqr
from ballbot_train.learning.routing import fit_routes
from ballbot_train.policy import PolicyNetwork
from ballbot_train.shards import is_set

_SPREAD = np.array(
    [0.1, 0.1, 0.05, 0.05, 0.3, 0.3, 0.3, 0.3, 0.05, 0.3, 0.3]
)  # standard deviations of a tube, in a state's SI units
_SMALL = 0.3  # of the force limit
_HARD_AMONG = 16  # episodes that are drawn for each of the hard ones
_MIN_STEPS = 2  # plans with fewer remaining control steps are not used as a guess


class _Plan(NamedTuple):
    """An optimum of n control steps."""

    x: np.ndarray
    """(n+1, 8) states."""
    u: np.ndarray
    """(n, 2) N, forces."""
    gains: np.ndarray
    """(n, 2, 8) feedback about it."""
    c: np.ndarray
    """(nc,) constants of its episode."""
    cost: float


@dataclass(frozen=True)
class DaggerConfig:
    """Settings of `Dagger`."""

    iterations: int = 50
    """Number of iterations."""
    gathering_iterations: int = 35
    """First of them that gather samples; 0: clone --demos."""
    evaluations: int = 6
    """Evaluations, at equal distances."""
    episodes_per_iteration: int = 6
    """Episodes planned per gathering iteration."""
    candidate_episodes: int = 64
    """To choose from, half where it fails; 0: random."""
    max_guesses: int = 5
    """Guesses tried for an optimum."""
    rollouts_per_plan: int = 2
    """Rollouts that end where a new optimum labels."""
    max_rollout_seconds: float = 2.0
    """Longest of these in the end, s."""
    start_noise: float = 0.0
    """Noise of their starts, in units of the tube's."""
    tube_samples: int = 1
    """States around an optimum that TVLQR labels."""
    tracked_rollouts_per_plan: int = 0
    """Rollouts along a plan that TVLQR labels."""
    max_distance: float = 2.0
    """Farthest from it, in deviations of the tube."""
    batch_episodes: int = 0
    """Optima found at once in place of one by one."""
    label_seconds: float = 4.0
    """Part of an optimum that becomes samples, s."""
    backoff: Backoff = Backoff(grip=EXECUTED.grip)
    """What optima keep from their limits."""
    gradient_steps: int = 150
    """Gradient steps per iteration."""
    batch_size: int = 1024
    """Samples per gradient step."""
    learning_rate: float = 3e-3
    """Learning rate; it falls along half a cosine."""
    hidden: tuple[int, ...] = (128, 128)
    """Units of hidden layers."""
    symmetry: RoutedSymmetry = "none"
    """What the actor keeps of the task's symmetry."""


TUNED: dict[str, DaggerConfig] = {
    "": DaggerConfig(),
    "stabilize": DaggerConfig(
        iterations=30,
        gathering_iterations=20,
        evaluations=15,
        batch_episodes=4096,
        label_seconds=3.0,
        symmetry="odd",
        gradient_steps=3000,
        batch_size=2048,
    ),
    # Turn's episodes differ in one number only, so feedback about their plans is all that has to be learnt.
    "turn": DaggerConfig(
        iterations=100,
        gathering_iterations=70,
        evaluations=10,
        episodes_per_iteration=8,
        rollouts_per_plan=1,
        max_rollout_seconds=6.0,
        tracked_rollouts_per_plan=8,
        start_noise=1.0,
        tube_samples=3,
        label_seconds=6.0,
        gradient_steps=400,
        symmetry="frame",
        backoff=Backoff(goal=0.4, force=0.02, grip=EXECUTED.grip),
    ),
    "orbit": DaggerConfig(
        iterations=80,
        gathering_iterations=60,
        evaluations=8,
        episodes_per_iteration=12,
        tracked_rollouts_per_plan=4,
        max_distance=4.0,
        label_seconds=6.0,
        gradient_steps=400,
        hidden=(256, 256),
        symmetry="frame",
        backoff=Backoff(force=0.06, grip=EXECUTED.grip),  # plans at the force limit leave no force for corrections
    ),
    "weave": DaggerConfig(
        iterations=250,
        gathering_iterations=200,
        evaluations=10,
        candidate_episodes=512,
        max_guesses=3,
        tracked_rollouts_per_plan=4,
        max_rollout_seconds=3.0,
        tube_samples=2,
        label_seconds=5.0,
        gradient_steps=300,
        hidden=(256, 256),
        symmetry="routes",
        backoff=Backoff(margin=0.06, force=0.02, grip=EXECUTED.grip),
    ),
}
"""Exceptions by name of task; every other task takes the defaults."""

_BETA = 0.8  # share of rollouts that start on the plan and not at its beginning; falls to 0.2 of it
_HARD_SHARE = 0.25  # of the beginnings of optima found at once: those of many drawn that cost the learner most
_BATCH_STATES = 32  # of each of these optima that become samples, each with `tube_samples` around it
_ROBOTS = 16  # of an iteration on a track
_FINAL_LEARNING_RATE_FRACTION = 0.01
_MIN_COST = 1.0  # cheaper episodes are weighted as if their optimum cost this much


class Dagger:
    """The learner; see `training.Learner`. An iteration's random numbers depend on seed and iteration alone."""

    def __init__(
        self,
        task: Task,
        params: BallbotParams,
        config: DaggerConfig,
        seed: int = 0,
        demos: str | Path | None = None,
        start: PolicyNetwork | None = None,
        randomization: Randomization | None = None,
        history: int = 0,
    ):
        """As of `Algorithm.make`. Demonstrations are its first samples."""
        on_track, robot = randomization is not None or history > 0, robot_name(params)
        samples = _first_samples(demos, task, robot, config, seed, on_track)
        if randomization is not None and not config.batch_episodes:
            raise ValueError("on a track, optima are found at once: give --batch-episodes 512")
        if config.batch_episodes and not batched.solves(task, params):
            raise ValueError(
                f"optima of {task.id} with this robot are not found at once; give --batch-episodes 0, which plans each alone"
            )
        self.config, self.iteration, self._warm = config, 0, False
        self.iterations, self.evaluations = config.iterations, config.evaluations
        self._task, self._params, self._seed = task, params, seed
        self._randomization, self._history = randomization, history
        torch.manual_seed(seed)
        self.network = PolicyNetwork(spec_for(task, config.symmetry, config.hidden, True, history, robot))
        start_as_lqr(self.network, task, params)
        self._fit = Fit(self.network)
        none, self._spread = np.zeros((0, self.network.spec.seen)), _SPREAD[: params.state_size]
        self._streamed = samples if isinstance(samples, StreamedDemos) else None
        self._samples = samples if isinstance(samples, Samples) else Samples.of(none, np.zeros((0, params.action_size)))
        if start is not None:
            self.network.load_state_dict(started(start, self.network.spec, any_shape=False).state_dict())
            self._warm = True

    def iterate(self) -> dict[str, float]:
        config, figures, routes = self.config, {}, self.network.routes
        if routes is not None and self.iteration == 0 and not self._warm:
            fit_routes(routes, self._task, self._params, self._seed)
        rng = np.random.default_rng([self._seed, self.iteration])
        if self._streamed is not None:  # one shard after the other is in memory
            demos = self._streamed.at(self.iteration)
            self._samples = Samples.of(demos.observations, demos.actions)
        elif self.iteration < config.gathering_iterations or not len(self._samples):
            figures = self._gather(rng)
        progress = self.iteration / config.iterations
        rate = schedules.cosine(config.learning_rate, _FINAL_LEARNING_RATE_FRACTION, progress)
        loss = self._fit.run(self._samples, config.gradient_steps, config.batch_size, rate, rng)
        self.iteration += 1
        return {"loss/imitation": loss, "train/learning_rate": rate, "train/samples": len(self._samples), **figures}

    def state_dict(self) -> dict[str, Any]:
        samples = self._samples if self._streamed is None else Samples.of(np.zeros((0, 1)), np.zeros((0, 2)))
        return {
            "iteration": self.iteration,
            "samples": [samples.observations, samples.actions, samples.weights],
            **self._fit.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.iteration = state["iteration"]
        self._samples = Samples(*state["samples"])
        self._fit.load_state_dict(state)

    def _gather(self, rng: np.random.Generator) -> dict[str, float]:
        """Plans episodes, rolls the learner out, and labels the states that it reaches."""
        if self._randomization is not None:
            return self._gather_track(self._randomization, rng)
        if self.config.batch_episodes:
            return self._gather_batch(rng)
        plans = self._planned(rng)
        for plan in plans:
            self._label(plan, plan.cost, rng)
        if self.config.tracked_rollouts_per_plan and plans:
            self._track(plans, rng)
        starts = [plan for plan in plans for _ in range(self.config.rollouts_per_plan)]
        labelled = 0
        explored = self._explore(starts, rng) if starts else ()
        for plan, (x, elapsed) in zip(starts, explored, strict=True):
            found = self._plan(x, plan.c, self._onwards(plan.x[elapsed:, :2]))
            if found is not None:
                labelled += 1
                self._label(found, plan.cost, rng)
        return {"train/labelled": labelled / max(1, len(starts))}

    def _gather_batch(self, rng: np.random.Generator) -> dict[str, float]:
        """Labels states along thousands of optima and around them; half of the optima start where the learner gets to."""
        config, task = self.config, self._task
        x0, c = self._beginnings((config.batch_episodes + 1) // 2, rng)
        longest = max(1, round(self._share * config.max_rollout_seconds / task.control_dt))
        history, lasted, _ = self._roll(x0, c, longest)
        reached = history[rng.integers(lasted), np.arange(len(x0))]
        starts = np.concatenate([x0, reached])
        constants = np.tile(c, (2, 1))
        forces = None if task.first_exit else self._forces(starts, constants)
        optima = batched.find_optima(task, self._params, starts, constants, forces)
        of_episodes = np.tile(optima.costs[: len(x0)], 2)  # a state counts as its episode does
        costs = np.where(np.isnan(of_episodes), optima.costs, of_episodes)
        rows = np.repeat(np.flatnonzero(optima.solved), _BATCH_STATES)
        most = np.minimum(round(config.label_seconds / task.control_dt), optima.steps[rows])
        steps = rng.integers(most)
        x, u, gains = optima.states[rows, steps], optima.forces[rows, steps], optima.gains[rows, steps]
        near_x, near_u, of = self._around(x, u, gains, rng)
        of = np.concatenate([rows, rows[of]])
        self._add(np.concatenate([x, near_x]), np.concatenate([u, near_u]), c[of % len(x0)], costs[of])
        return {"train/labelled": float(optima.solved.mean())}

    def _gather_track(self, randomization: Randomization, rng: np.random.Generator) -> dict[str, float]:
        """Labels what the learner sees on robots that it is not told.

        The expert is the optimum of the episode's own robot, from where that will be when a force of now arrives. Half of
        the episodes follow the expert, the others the learner: from their beginnings, and then, with new optima, from a
        state that they came to.
        """
        task, each = self._task, -(-self.config.batch_episodes // (2 * _ROBOTS))
        x, c = self._drawn(each * _ROBOTS, rng)
        draws = rng.random((_ROBOTS, len(Randomization.DRAWN)))
        drawn = np.array([randomization.draw(tuple(z), task.control_dt) for z in draws]).repeat(each, axis=0)
        batch = BallbotBatch(
            task, len(x), compile=False, params=self._params, randomization=randomization, history=self._history
        )
        given = (torch.as_tensor(part.T, dtype=batch.dtype) for part in (x, c, drawn))
        start = batch.initial_state(int(rng.integers(2**31)), None, *given)
        robots = [randomization.robot(self._params, tuple(row)) for row in drawn.tolist()]
        states, lasted, costs = self._labelled_run(batch, start, robots, rng)
        at = rng.integers(lasted).tolist()
        reached = (torch.stack([parts[k][..., i] for i, k in enumerate(at)], -1) for parts in zip(*states, strict=True))
        _, _, again = self._labelled_run(batch, BatchState(*reached), robots, rng, costs)
        return {"train/labelled": float(np.isfinite([costs, again]).mean())}

    def _labelled_run(
        self,
        batch: BallbotBatch,
        state: BatchState,
        robots: Sequence[BallbotParams],
        rng: np.random.Generator,
        weighted_as: np.ndarray | None = None,
    ) -> tuple[list[BatchState], np.ndarray, np.ndarray]:
        """Runs B episodes from a state under expert or learner, and labels what is seen near the optimum of each.

        Returns:
            The states of all control steps, how many of them each episode lasted (B,), and what the optima cost (B,).
        """
        task, limits = self._task, np.array([[robot.force_limit] for robot in robots])
        c = state.c.T.double().numpy()
        optima = self._optima_of(robots, self._ahead(batch, state), c)
        costs = optima.costs if weighted_as is None else np.where(np.isnan(weighted_as), optima.costs, weighted_as)
        steps = round(self.config.label_seconds / task.control_dt)
        expert = rng.random((len(robots), 1)) < 0.5
        states, lasted, running = [], np.zeros(len(robots), int), np.ones(len(robots), bool)
        seen, labels, weights = [], [], []
        for k in range(min(steps, task.steps)):
            states.append(state)
            lasted += running
            observation = batch.observe(state)
            off = self._ahead(batch, state) - optima.states[:, k]
            change = -np.einsum("bij,bj->bi", optima.gains[:, k], off)
            label = np.clip((optima.forces[:, k] + change) / limits, -1, 1)
            near = (np.abs(change) < _SMALL * limits).all(1) & running & optima.solved & (k < optima.steps)
            seen.append(observation[near])
            labels.append(label[near])
            weights.append(1 / np.maximum(costs[near], _MIN_COST))
            with torch.no_grad():
                actions = np.where(expert, label, self.network(observation))
            state, result = batch.transition(state, torch.as_tensor(actions))
            running &= ~(result.terminated | result.truncated).numpy()
            if not running.any():
                break
        self._samples.add(Samples.of(torch.cat(seen).numpy(), np.concatenate(labels), np.concatenate(weights)))
        return states, lasted, optima.costs

    def _optima_of(self, robots: Sequence[BallbotParams], x: np.ndarray, c: np.ndarray) -> batched.BatchOptima:
        """The optima of B episodes from states x (B, 8) with constants c (B, nc); those of one robot are neighbours."""
        found = []
        for robot, rows in itertools.groupby(range(len(robots)), robots.__getitem__):
            of = list(rows)
            found.append(vars(batched.find_optima(self._task, robot, x[of], c[of], backoff=self.config.backoff)))
        return batched.BatchOptima(**{name: np.concatenate([part[name] for part in found]) for name in found[0]})

    def _ahead(self, batch: BallbotBatch, state: BatchState) -> np.ndarray:
        """(B, 8) where the robots will be when a force of now arrives, after those that are on their way."""
        x, commands = state.x.unbind(0), state.actuator[2:].unflatten(0, (-1, 2)) if len(state.actuator) > 2 else ()
        robot = batch.model(state.drawn.unbind(0))
        for age in range(len(commands), 0, -1):
            dt = self._task.control_dt
            later = dynamics.step(robot, x, commands[age - 1].unbind(0), dt, dynamics.substeps_for(dt))
            x = tuple(torch.where(state.drawn[5] >= age, new, old) for new, old in zip(later, x, strict=True))
        return torch.stack(x, 1).double().numpy()

    def _drawn(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Initial states (count, 8) and constants (count, nc) as the task draws them."""
        x, c = zip(*(self._task.sample(rng, self._params) for _ in range(count)), strict=True)
        return np.array(x), np.array(c)

    def _beginnings(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Initial states (count, 8) and constants (count, nc); some of them are those of many that cost the learner most."""
        hard = round(_HARD_SHARE * count) if self.iteration else 0
        x, c = self._drawn(count - hard + _HARD_AMONG * hard, rng)
        if not hard:
            return x, c
        among = slice(count - hard, None)
        run = self._run(x[among], c[among], round(self.config.label_seconds / self._task.control_dt), record=False)
        costs = np.where(run.failure.numpy(), np.inf, run.cost.numpy())
        rows = np.concatenate([np.arange(count - hard), count - hard + np.argsort(costs)[-hard:]])
        return x[rows], c[rows]

    def _forces(self, x: np.ndarray, c: np.ndarray) -> np.ndarray:
        """(B, n, 2) N, of the learner in episodes from states (B, 8)."""
        history, _, _ = self._roll(x, c, self._task.steps)
        with torch.no_grad():
            actions = self.network(torch.as_tensor(self._task.observe(history[:-1], c), dtype=torch.float32))
        return self._params.force_limit * actions.transpose(0, 1).double().numpy()

    @property
    def _share(self) -> float:
        """How far the gathering has come."""
        return min(1.0, (self.iteration + 1) / self.config.gathering_iterations)

    def _around(
        self, x: np.ndarray, u: np.ndarray, gains: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`tube_samples` states around each of n states (n, 8), where the feedback (n, 2, 8) about it tells their forces.

        Returns:
            m states (m, 8), their forces (m, 2), N, and around which of the n each of them is, (m,).
        """
        shape = self.config.tube_samples, len(x)
        off = self._spread * rng.standard_normal((*shape, len(self._spread))) * rng.random((*shape, 1))
        change = -np.einsum("kij,tkj->tki", gains, off)
        # a derivative is no guide to greater changes
        small = np.abs(change).max(-1) < _SMALL * self._params.force_limit
        return (x + off)[small], (u + change)[small], np.nonzero(small)[1]

    def _planned(self, rng: np.random.Generator) -> list[_Plan]:
        """Draws episodes, up to half of them ones that the learner fails, and plans them."""
        config = self.config
        x, c = self._drawn(max(config.candidate_episodes, config.episodes_per_iteration), rng)
        first = []
        if self.iteration and config.candidate_episodes:
            history, lasted, failed = self._roll(x, c, round(config.label_seconds / self._task.control_dt))
            bad = failed | (lasted == len(history)) if self._task.first_exit else failed
            first = np.flatnonzero(bad)[: (config.episodes_per_iteration + 1) // 2].tolist()
        planned = (self._plan(x[i], c[i], self._routed(x[i], c[i])) for i in dict.fromkeys([*first, *range(len(x))]))
        found = (plan for plan in planned if plan is not None)
        return list(itertools.islice(found, config.episodes_per_iteration))

    def _plan(self, x: np.ndarray, c: np.ndarray, paths: list[np.ndarray] | None) -> _Plan | None:
        """The optimum from state x (8,), or None; guessed from ground paths (n, 2), or by the task without them."""
        config, task, params = self.config, self._task, self._params
        try:
            found = find_optimum(task, params, x, c, config.backoff, config.max_guesses, paths)
        except PlanError:
            return None
        if not found.is_optimal:
            return None
        plan = found.trajectory
        return _Plan(plan.x, plan.u, tube_gains(task, params, plan, c), c, found.cost)

    def _onwards(self, path: np.ndarray) -> list[np.ndarray] | None:
        """The rest (n, 2) of a plan's ground path as a path to guess from, or None where it is too short for one."""
        if len(path) <= _MIN_STEPS:
            return None
        return [path if self._task.first_exit else then_stay(path, self._task.steps)]

    def _routed(self, x: np.ndarray, c: np.ndarray) -> list[np.ndarray] | None:
        """The path on the sides that the learner's routes choose, or None where it has none."""
        if self.network.routes is None:
            return None
        sides = self.network.routes(torch.as_tensor(np.asarray(self._task.observe(x, c)), dtype=torch.float32))
        return [self._task.routed_path(x, c, tuple(map(int, sides.tolist())))]

    def _track(self, plans: Sequence[_Plan], rng: np.random.Generator) -> None:
        """Rolls the learner out along plans; TVLQR at the nearest point of the plan labels each state."""
        config = self.config
        tracked = [plan for plan in plans for _ in range(config.tracked_rollouts_per_plan)]
        x = np.array([plan.x[0] for plan in tracked])
        x += config.start_noise * self._spread * rng.standard_normal(x.shape)
        steps = min(max(len(plan.u) for plan in plans), round(config.label_seconds / self._task.control_dt))
        history, lasted, _ = self._roll(x, np.array([plan.c for plan in tracked]), steps)
        for i, plan in enumerate(tracked):
            met = history[: lasted[i], i]
            distance, nearest = map(np.asarray, KDTree(plan.x[:-1] / self._spread).query(met / self._spread))
            met, nearest = met[distance < config.max_distance], nearest[distance < config.max_distance]
            change = np.einsum("tij,tj->ti", plan.gains[nearest], met - plan.x[nearest])
            self._add(met, plan.u[nearest] - change, plan.c, plan.cost)

    def _explore(self, plans: Sequence[_Plan], rng: np.random.Generator) -> list[tuple[np.ndarray, int]]:
        """Rolls the learner out once from each plan.

        Returns:
            For each rollout a state (8,), and the number of control steps of the plan up to it. It is the state at a random
            time, or, if the episode ended before that time, at a random time before its end.
        """
        config, dt = self.config, self._task.control_dt
        longest = max(1, round(self._share * config.max_rollout_seconds / dt))
        on_plan = rng.random(len(plans)) < _BETA * (1 - 0.8 * self._share)
        starts = [int(rng.integers(len(plan.u))) if on else 0 for plan, on in zip(plans, on_plan, strict=True)]
        steps = rng.integers(1, longest + 1, len(plans))
        x = np.array([plan.x[start] for plan, start in zip(plans, starts, strict=True)])
        x += config.start_noise * self._spread * rng.standard_normal(x.shape)
        history, lasted, _ = self._roll(x, np.array([plan.c for plan in plans]), longest)
        reached = []
        for i, plan in enumerate(plans):
            # the states before a failure teach most, so any of them may be chosen
            k = int(steps[i] if steps[i] < lasted[i] else rng.integers(lasted[i]))
            reached.append((history[k, i], min(starts[i] + k, len(plan.u))))
        return reached

    def _roll(self, x: np.ndarray, c: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Runs B episodes under the learner from states x (B, 8) with constants c (B, nc).

        Returns:
            States (steps+1, B, 8); how many of them each episode lasted (B,), and the others have no meaning; and whether
            it failed (B,).
        """
        run = self._run(x, c, steps, record=True)
        assert run.states is not None
        history = np.concatenate([x[None], run.states.transpose(1, 2).double().numpy()])
        lasted = np.where(run.terminated.numpy(), run.steps.numpy(), steps + 1)
        return history, lasted, run.failure.numpy()

    def _run(self, x: np.ndarray, c: np.ndarray, steps: int, record: bool) -> BatchEpisodes:
        """B episodes of so many steps under the learner."""
        task = replace(self._task, duration=steps * self._task.control_dt)
        batch = BallbotBatch(task, len(x), compile=False, params=self._params)
        return run_episodes(batch, self.network, x, c, record=record)

    def _label(self, plan: _Plan, cost: float, rng: np.random.Generator) -> None:
        """Labels the states of an optimum and others drawn around them; cost: of the optimum from the episode's start."""
        n = min(len(plan.u), round(self.config.label_seconds / self._task.control_dt))
        x, u = plan.x[:n], plan.u[:n]
        near_x, near_u, _ = self._around(x, u, plan.gains[:n], rng)
        self._add(np.concatenate([x, near_x]), np.concatenate([u, near_u]), plan.c, cost)

    def _add(self, x: np.ndarray, u: np.ndarray, c: np.ndarray, cost: float | np.ndarray) -> None:
        """Adds samples of states (n, 8) and forces (n, 2), N, of episodes with constants (nc,) or (n, nc) whose optima cost
        `cost`, one number or (n,).
        """
        observations = np.asarray(self._task.seen(x, np.broadcast_to(c, (len(x), c.shape[-1]))))
        weights = np.broadcast_to(1 / np.maximum(cost, _MIN_COST), len(x))
        self._samples.add(Samples.of(observations, np.clip(u / self._params.force_limit, -1, 1), weights))


def _first_samples(
    demos: str | Path | None, task: Task, robot: str, config: DaggerConfig, seed: int, on_track: bool
) -> Samples | StreamedDemos | None:
    """Demonstrations, if there are any; raises a ValueError where they do not fit."""
    if demos is None:
        if config.gathering_iterations:
            return None
        raise ValueError('gathering_iterations 0 needs demonstrations: give --demos a dataset of "ballbot demos"')
    if on_track:
        raise ValueError(
            "demonstrations show no past and no track; leave out --demos, or --randomization and --history"
        )
    if is_set(demos):
        if config.gathering_iterations:
            raise ValueError(f"{demos} is a set of shards, which dagger only clones: give --gathering-iterations 0")
        return StreamedDemos(demos, task, seed, robot)
    loaded = load_demos(demos, task, robot)
    weights = np.full(len(loaded), 1 / max(loaded.median_cost(task), _MIN_COST))
    return Samples.of(loaded.observations, loaded.actions, weights)


make = Dagger
