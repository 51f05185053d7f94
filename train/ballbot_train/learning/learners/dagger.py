"""DAgger with the optimum as the expert: the learner drives, and where it gets to, the optimum from there is its label.

Each gathering iteration draws some episodes and plans them. Learners then start anywhere on these plans, drive for a while,
and from each state that one gets to the optimum is searched anew, beginning with the rest of its plan: so every search
stays on that plan's side of obstacles and in its kind of turn. At first learners drive briefly and start mostly on the
plans, later mostly at the beginnings of the episodes (Ross et al., "A reduction of imitation learning and structured
prediction to no-regret online learning", 2011, with the mixture β of expert and learner drawn per episode).

An optimum labels more than its first state: all its states are samples, and around each of them `tube` draws others, which
TVLQR labels, the derivative of the optimum's forces with respect to the state. TVLQR also labels, for the price of a product,
the states of `followers`, learners that drive an episode from its beginning to its end, wherever they are `near` its plan.
Errors count relative to what the episode costs, as regret does.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from ballbot_baselines.linearize import quadratic_cost
from ballbot_baselines.optimum import Backoff, Optimum, find_optimum
from ballbot_baselines.tvlqr import TvlqrController
from ballbot_gym.batch import BallbotBatch, run_episodes
from ballbot_gym.params import BallbotParams
from ballbot_gym.paths import then_stay
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks import Task
from ballbot_train.learning.demonstrations import Demos, load_demos
from ballbot_train.learning.learners.bc import Fit, Samples, annealed
from ballbot_train.policy import PolicyNetwork

_SPREAD = np.array([0.1, 0.1, 0.05, 0.05, 0.3, 0.3, 0.3, 0.3])  # standard deviations of a tube, in a state's SI units
_MET = 0.05  # below the greatest of the goal's functions, one still limits the optimum
_SMALL = 0.3  # of the force limit
_END = 2  # control steps: a plan with fewer left says nothing of where to go


@dataclass(frozen=True)
class DaggerConfig:
    """Settings of `Dagger`."""

    iterations: int = 50
    gathering: int = 35
    """Iterations that gather samples; the others only fit."""
    evaluations: int = 6
    episodes: int = 6
    """Drawn and planned per gathering iteration."""
    candidates: int = 64
    """Episodes drawn of which those are chosen, the learner's failures first; 0 chooses at random."""
    guesses: int = 5
    """Of the task, tried at most for the optimum of an episode."""
    drives: int = 2
    """Learners that drive per episode, each labelled once by an optimum."""
    longest: float = 2.0
    """s that learners drive at most; grows to this over the gathering iterations."""
    beta: float = 0.8
    """Share of the drives that start on the expert's plan instead of its beginning; falls to 0.2 of it."""
    scatter: float = 0.0
    """Disturbs where drives start, in units of the tube's spread."""
    tube: int = 1
    """States drawn around each state of an optimum."""
    followers: int = 0
    """Learners that drive each episode drawn to its end, labelled by TVLQR about its plan."""
    near: float = 2.0
    """How far from the plan, in units of the tube's spread, such a state may be."""
    kept: float = 4.0
    """s of an optimum that are labels: what follows is rest."""
    backoff: Backoff = Backoff()
    """What optima keep from their limits, for the learner's errors."""
    steps: int = 150
    """Gradient steps per iteration."""
    batch: int = 1024
    """Samples per gradient step."""
    hidden: tuple[int, ...] = (128, 128)
    learning_rate: float = 3e-3
    """At the start; falls along a half cosine to `final_rate` of it."""
    final_rate: float = 0.01
    least_cost: float = 1.0
    """An episode counts as if it cost at least this much."""


TUNED: dict[str, DaggerConfig] = {
    "stabilize": DaggerConfig(),
    # Its episodes are a family of one parameter: feedback about the plans is all there is to learn.
    "turn": DaggerConfig(
        iterations=100,
        gathering=70,
        evaluations=10,
        episodes=8,
        drives=0,
        followers=8,
        scatter=1.0,
        tube=3,
        kept=6.0,
        steps=400,
        backoff=Backoff(goal=0.5, force=0.02),
    ),
    "orbit": DaggerConfig(
        iterations=80,
        gathering=60,
        evaluations=8,
        episodes=12,
        followers=4,
        near=4.0,
        kept=6.0,
        steps=400,
        hidden=(256, 256),
        backoff=Backoff(force=0.1),  # who pushes with all he has into an orbit cannot correct it
    ),
    "weave": DaggerConfig(episodes=5, guesses=3, kept=5.0, backoff=Backoff(margin=0.05, force=0.02)),
}
"""By task."""


class Dagger:
    """The learner; see `training.Learner`. What an iteration draws depends on seed and iteration alone."""

    def __init__(
        self, task: Task, params: BallbotParams, config: DaggerConfig, seed: int = 0, samples: Samples | None = None
    ):
        """Args: samples: to begin with, as those of demonstrations; default, none."""
        self.config, self.iteration = config, 0
        self.iterations, self.evaluations = config.iterations, config.evaluations
        self._task, self._params, self._seed = task, params, seed
        self._fit = Fit(task, params, config.hidden, seed)
        none = np.zeros((0, len(task.observation_scale)))
        self._samples = Samples.of(none, np.zeros((0, 2))) if samples is None else samples

    @property
    def network(self) -> PolicyNetwork:
        return self._fit.network

    def iterate(self) -> dict[str, float]:
        config, figures = self.config, {}
        rng = np.random.default_rng([self._seed, self.iteration])
        if self.iteration < config.gathering or not len(self._samples):
            figures = self._gather(rng)
        rate = annealed(config.learning_rate, config.final_rate, self.iteration / config.iterations)
        loss = self._fit.run(self._samples, config.steps, config.batch, rate, rng)
        self.iteration += 1
        return {"loss/imitation": loss, "train/learning_rate": rate, "train/samples": len(self._samples), **figures}

    def state_dict(self) -> dict[str, Any]:
        samples = self._samples
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
        """Plans episodes, drives, and labels what was met."""
        plans = self._planned(rng)
        gains = [tube_gains(self._task, self._params, plan, c) for plan, c in plans]
        for (plan, c), k in zip(plans, gains, strict=True):
            self._samples.add(self._labelled(plan, k, c, plan.cost, rng))
        if self.config.followers and plans:
            self._follow(plans, gains, rng)
        drives = [episode for episode in plans for _ in range(self.config.drives)]
        labelled = 0
        for (plan, c), (x, elapsed) in zip(drives, self._drive(drives, rng) if drives else (), strict=True):
            found = self._optimum(x, c, plan.trajectory.x[elapsed:, :2])
            if found is not None:
                labelled += 1
                k = tube_gains(self._task, self._params, found, c)
                self._samples.add(self._labelled(found, k, c, plan.cost, rng))
        return {"train/labelled": labelled / max(1, len(drives))}

    def _planned(self, rng: np.random.Generator) -> list[tuple[Optimum, np.ndarray]]:
        """Optima and constants (nc,) of episodes drawn; half of them, where there are as many, such as the learner fails."""
        config = self.config
        drawn = [self._task.sample(rng, self._params) for _ in range(max(config.candidates, config.episodes))]
        if self.iteration and config.candidates:
            x, c = (np.array(part) for part in zip(*drawn, strict=True))
            _, over, failed = self._roll(x, c, round(config.kept / self._task.control_dt))
            bad = failed | ~over[-1] if self._task.first_exit else failed
            first = np.flatnonzero(bad)[: (config.episodes + 1) // 2].tolist()
            drawn = [drawn[i] for i in first] + [episode for i, episode in enumerate(drawn) if i not in first]
        plans = []
        for x, c in drawn:
            if len(plans) < config.episodes:
                with suppress(PlanError):
                    plans.append((find_optimum(self._task, self._params, x, c, config.backoff, config.guesses), c))
        return plans

    def _follow(
        self,
        plans: Sequence[tuple[Optimum, np.ndarray]],
        gains: Sequence[np.ndarray],
        rng: np.random.Generator,
    ) -> None:
        """Lets followers drive, and labels each of their states by TVLQR at the point of the plan nearest to it."""
        config = self.config
        followed = [episode for episode in plans for _ in range(config.followers)]
        x = np.array([plan.trajectory.x[0] for plan, _ in followed])
        x += config.scatter * _SPREAD * rng.standard_normal(x.shape)
        steps = min(max(len(plan.trajectory.u) for plan, _ in plans), round(config.kept / self._task.control_dt))
        history, over, _ = self._roll(x, np.array([c for _, c in followed]), steps)
        for i, (plan, c) in enumerate(followed):
            met = history[:, i][~over[:, i]]
            distance, nearest = KDTree(plan.trajectory.x[:-1] / _SPREAD).query(met / _SPREAD)
            met, nearest = met[distance < config.near], nearest[distance < config.near]
            off = met - plan.trajectory.x[nearest]
            forces = plan.trajectory.u[nearest] - np.einsum("tij,tj->ti", gains[i // config.followers][nearest], off)
            self._samples.add(self._samples_of(met, forces, c, plan.cost))

    def _optimum(self, x: np.ndarray, c: np.ndarray, path: np.ndarray) -> Optimum | None:
        """From state x (8,), beginning with a ground path (n, 2), or with the task's where it has come to its end."""
        task = self._task
        paths = None
        if len(path) > _END:
            paths = [path if task.first_exit else then_stay(path, task.steps)]
        try:
            return find_optimum(task, self._params, x, c, self.config.backoff, self.config.guesses, paths)
        except PlanError:
            return None

    def _drive(
        self, drives: Sequence[tuple[Optimum, np.ndarray]], rng: np.random.Generator
    ) -> list[tuple[np.ndarray, int]]:
        """Lets the learner drive from each plan.

        Returns:
            Of each drive the state (8,) that it came to, or passed where it failed or arrived before, and the control steps
            that the plan would have taken so far.
        """
        config, dt = self.config, self._task.control_dt
        share = min(1.0, (self.iteration + 1) / config.gathering)
        longest = max(1, round(share * config.longest / dt))
        on_plan = rng.random(len(drives)) < config.beta * (1 - 0.8 * share)
        starts = [
            int(rng.integers(len(plan.trajectory.u))) if on else 0
            for (plan, _), on in zip(drives, on_plan, strict=True)
        ]
        steps = rng.integers(1, longest + 1, len(drives))
        x = np.array([plan.trajectory.x[start] for (plan, _), start in zip(drives, starts, strict=True)])
        x += config.scatter * _SPREAD * rng.standard_normal(x.shape)
        history, over, _ = self._roll(x, np.array([c for _, c in drives]), longest)
        reached = []
        for i, (plan, _) in enumerate(drives):
            # a drive that failed has most to learn from how that came about
            lasted = int(np.argmax(over[:, i])) if over[-1, i] else longest + 1
            k = int(steps[i]) if steps[i] < lasted else int(rng.integers(lasted))
            reached.append((history[k, i], min(starts[i] + k, len(plan.trajectory.u))))
        return reached

    def _roll(self, x: np.ndarray, c: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lets the learner drive B episodes from states x (B, 8) with constants c (B, nc).

        Returns:
            States (steps+1, B, 8); whether the episode had ended there (steps+1, B), after which states mean nothing; and
            whether it failed (B,).
        """
        task = replace(self._task, duration=steps * self._task.control_dt)
        batch = BallbotBatch(task, len(x), compile=False, params=self._params)
        run = run_episodes(batch, self.network, x, c, record=True)
        history = np.concatenate([x[None], run.states.transpose(1, 2).double().numpy()])
        over = (np.arange(steps + 1)[:, None] >= run.steps.numpy()) & run.terminated.numpy()
        return history, over, run.failure.numpy()

    def _labelled(
        self, plan: Optimum, gains: np.ndarray, c: np.ndarray, cost: float, rng: np.random.Generator
    ) -> Samples:
        """The states of an optimum, and those drawn around them, in an episode whose own optimum costs `cost`.

        gains (n, 2, 8) are the feedback about the optimum.
        """
        config, task = self.config, self._task
        n = min(len(plan.trajectory.u), round(config.kept / task.control_dt))
        x, u = plan.trajectory.x[:n], plan.trajectory.u[:n]
        if config.tube:
            off = _SPREAD * rng.standard_normal((config.tube, n, 8)) * rng.random((config.tube, n, 1))
            change = -np.einsum("kij,tkj->tki", gains[:n], off)
            small = np.abs(change).max(-1) < _SMALL * self._params.force_limit  # beyond, a derivative says too little
            x, u = np.concatenate([x, (x + off)[small]]), np.concatenate([u, (u + change)[small]])
        return self._samples_of(x, u, c, cost)

    def _samples_of(self, x: np.ndarray, u: np.ndarray, c: np.ndarray, cost: float) -> Samples:
        """States (n, 8) labelled by forces (n, 2), in an episode whose optimum costs `cost`."""
        observations = np.asarray(self._task.observe(x, np.broadcast_to(c, (len(x), len(c)))))
        weights = np.full(len(x), 1 / max(cost, self.config.least_cost))
        return Samples.of(observations, np.clip(u / self._params.force_limit, -1, 1), weights)


def tube_gains(task: Task, params: BallbotParams, plan: Optimum, c: np.ndarray) -> np.ndarray:
    """(n, 2, 8) feedback about an optimum of n steps.

    It is TVLQR's; but where the task ends in its goal, only the goal's limits that the optimum meets count at its end. A
    goal that is to be met in full would ask for forces that the optimum from a neighbouring state does without.
    """
    trajectory = plan.trajectory
    if not task.first_exit:
        return TvlqrController.for_task(task, params, trajectory, c).gains.k
    q, r = quadratic_cost(task, trajectory.x[:-1], trajectory.u, c)
    end, h = trajectory.x[-1], 1e-5
    goal = np.array(task.goal(end, c), np.float64)
    slopes = np.array([np.subtract(task.goal(end + d, c), task.goal(end - d, c)) / (2 * h) for d in h * np.eye(8)])
    met = slopes[:, goal > goal.max() - _MET]
    dt = task.control_dt
    return TvlqrController(params, trajectory, dt, q * dt, r * dt, met @ met.T + 1e-3 * np.eye(8)).gains.k


def make(task: Task, params: BallbotParams, config: DaggerConfig, seed: int, demos: Path | None) -> Dagger:
    """The learner at its beginning; demonstrations, where there are some, are its first samples.

    Raises:
        ValueError: demonstrations of another task.
    """
    samples = None
    if demos is not None:
        loaded = load_demos(demos, task)
        weights = np.full(len(loaded), 1 / max(_median_cost(loaded, task), config.least_cost))
        samples = Samples.of(loaded.observations, loaded.actions, weights)
    return Dagger(task, params, config, seed, samples)


def _median_cost(demos: Demos, task: Task) -> float:
    """Of the episodes."""
    starts = np.flatnonzero(np.roll(demos.terminations | demos.truncations, 1))
    return float(task.survival_pay - np.median(np.add.reduceat(demos.rewards, starts, dtype=np.float64)))
