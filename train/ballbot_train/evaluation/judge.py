"""Whether a recorded motion breaks a rule, and what it cost: every step must be the engine's, and errors must not add up."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym import certified
from ballbot_gym.engines import make_simulator
from ballbot_gym.robot import Robot
from ballbot_gym.step import limit_names, outcome
from ballbot_gym.tasks import Task
from ballbot_train.evaluation import recordings

TOLERANCE = 1e-6
"""Largest difference of a recorded state from the one that follows, m, rad and per second, where the state is all that
decides. Rounding to the grids makes at most 1.2e-7 of it. As a force it is 1e-4 N."""
CONTACT_TOLERANCE = 1e-4
"""The same where an engine simulates the contact of a rolling ball; as a force 0.01 N. Each step then starts with a ball that
rolls without slipping, which honest motions in grip keep within 1e-5. A ball that slips has a spin that none holds."""
SLIP_TOLERANCE = 1e-3
"""Largest slip of a rolling ball after a step, m/s. Honest motions in grip keep within 5e-5."""
STEERED = 1e-4
"""The part of an episode's cost that the errors of all its steps may have changed, see `_check_errors`. Honest motions
keep within 1e-5."""

SUCCESS, MISSED, NO_PLAN = "success", "missed", "no plan"
_SLIPS = "Balls that slip cannot be verified; record with physics rk4, where slipping is a failure"


class SubmissionError(ValueError):
    """A submission that is refused; the message says where and why."""


class Steps:
    """All control steps of a recording in turn: episode and number (from 1) of each, the states around it and its action."""

    def __init__(self, recording: recordings.Recording, path: str | Path):
        self.path, self.lengths = path, recording.lengths
        rows = recording.lengths + (recording.lengths > 0)
        self.first = np.cumsum(rows) - rows
        self.episode = np.repeat(np.arange(len(rows)), recording.lengths)
        self.step = np.arange(len(self.episode)) - (np.cumsum(self.lengths) - self.lengths)[self.episode] + 1
        before = self.first[self.episode] + self.step - 1
        self.states, self.before, self.after = recording.states, recording.states[before], recording.states[before + 1]
        self.action = recording.actions

    def refuse(self, where: np.ndarray, why: Any) -> None:
        """Refuses the recording if a condition holds of any step; `why` gives the reason of the first."""
        if where.any():
            i = int(np.argmax(where))
            raise SubmissionError(f"{self.path}: episode {self.episode[i]}, step {self.step[i]}: {why(i)}")

    def judged(
        self, physics: str, task: Task, robot: Robot, known: certified.EvaluationSet
    ) -> tuple[list[float], list[str]]:
        """Cost and end of every episode.

        Raises:
            SubmissionError: the recording breaks a rule.
        """
        self._check_starts(known)
        longest = self.lengths[self.episode] > task.steps
        self.refuse(longest, lambda i: f"the episode is longer than its {task.steps} control steps")
        self.refuse(
            np.abs(self.action).max(1) > 1, lambda i: f"the action {self.action[i].tolist()} is beyond its limit of 1"
        )
        force = robot.force_limit * self.action
        simulated = robot.CONTACT and physics != "rk4"
        tolerance = CONTACT_TOLERANCE if simulated else TOLERANCE
        reached, slip = stepped(physics, robot, task, self.before, force)
        error = self.after - reached
        missed = np.abs(error)
        self.refuse(~(missed.max(1) <= tolerance), lambda i: _jump(missed[i], tolerance, simulated, robot))
        self.refuse(~(slip <= SLIP_TOLERANCE), lambda i: f"the ball slips at {slip[i]:.2g} m/s. {_SLIPS}")
        c = known.constants[self.episode]
        limits = robot.limits(self.before, force, hold=task.control_dt) if robot.grips and not simulated else ()
        grip = (np.minimum.reduce(limits),) if limits else ()
        did = outcome(task, self.before, force, self.after, c, self.step, grip)
        over = np.broadcast_to(did.terminated + did.truncated > 0, self.step.shape)
        last = self.step == self.lengths[self.episode]
        self.refuse(over & ~last, lambda i: "the episode has ended here, but the recording continues")
        self.refuse(last & ~over, lambda i: "the recording stops here, but the episode has not ended")
        n = len(self.lengths)
        cost = np.bincount(self.episode, np.broadcast_to(did.cost, self.step.shape), n)
        cost[self.lengths == 0] = task.survival_pay
        self._check_errors(task, robot, known, error, cost)
        ends, names = [NO_PLAN] * n, limit_names(task, robot)
        for i in np.flatnonzero(last):
            violated = int(did.violated[i])
            ends[self.episode[i]] = names[violated] if violated >= 0 else SUCCESS if did.success[i] > 0 else MISSED
        return cost.tolist(), ends

    def _check_starts(self, known: certified.EvaluationSet) -> None:
        begun = np.flatnonzero(self.lengths)
        starts = np.rint(self.states[self.first[begun]] / recordings.GRID)
        wrong = begun[(starts != np.rint(known.states[begun] / recordings.GRID)).any(1)]
        if len(wrong):
            raise SubmissionError(f"{self.path}: episode {wrong[0]}, step 0: it does not begin at its certified start")

    def _check_errors(
        self,
        task: Task,
        robot: Robot,
        known: certified.EvaluationSet,
        error: np.ndarray,
        cost: np.ndarray,
    ) -> None:
        """Refuses a recording whose small errors, taken together, may have changed the cost of an episode."""
        from ballbot_train.evaluation import steering  # it imports CasADi

        ends = np.cumsum(self.lengths)
        for i in np.flatnonzero(self.lengths):
            n, first, end = self.lengths[i], self.first[i], ends[i]
            moved = self.states[first : first + n + 1], self.action[end - n : end]
            slopes = steering.costates(task, robot, *moved, known.constants[i])
            part = float(np.abs(slopes * error[end - n : end]).sum()) / cost[i]
            if not part <= STEERED:
                raise SubmissionError(
                    f"{self.path}: episode {i}: the small errors of its steps together may have changed its cost by "
                    f"{part:.2%}, and {STEERED:.2%} is allowed; record the motion as the engine gives it"
                )


def stepped(
    physics: str, robot: Robot, task: Task, before: np.ndarray, force: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The states (n, 8) one control step after others, and how fast a rolling ball then slips (n,), m/s."""
    dt, slip = task.control_dt, np.zeros(len(before))
    if physics == "rk4":
        return robot.step(before, force, dt, robot.substeps(dt)), slip
    simulator, reached = make_simulator(physics, robot, dt), np.empty_like(before)
    try:
        for i, (x, u) in enumerate(zip(before.tolist(), force.tolist(), strict=True)):
            simulator.reset(tuple(x))
            reached[i] = simulator.step(tuple(u))
            if robot.CONTACT:
                slip[i] = math.hypot(*simulator.slip())
    finally:
        simulator.close()
    return reached, slip


def _jump(missed: np.ndarray, tolerance: float, contact: bool, robot: Robot) -> str:
    """What is wrong with a step whose end is missed by so much."""
    i = int(np.argmax(np.where(np.isfinite(missed), missed, np.inf)))
    quantity, unit = robot.STATE[i]
    slips = f". {_SLIPS}" * contact
    missed_by = f"{quantity} is off by {missed[i]:.2g} {unit}, and {tolerance:g} is allowed"
    return f"the next state does not follow: {missed_by}{slips}"
