"""BallbotBatch: many ballbots at once in torch, tensors in and out, differentiable.

Components come first: a batch of B states is a tensor (8, B), so that every operation runs over contiguous memory.

Random numbers come from `seeding`; `BallbotEnv` draws others, from NumPy's generator, for the same seed.
Eager batches give bit-identical results for the same seed and actions, and so do compiled batches of two or more envs. Eager
and compiled batches agree to rounding. So does a compiled batch of one env, which computes sines with another library.
"""

import logging
import shutil
import types
from collections.abc import Sequence
from typing import Any, cast

import gymnasium
import numpy as np

from ballbot_gym import seeding
from ballbot_gym.checks import LARGEST, check_history, check_num_envs, fixed_error, shown
from ballbot_gym.env import make_task, robot_of
from ballbot_gym.lazy import imports_of
from ballbot_gym.robot import (
    PAPER,
    Randomization,
    Robot,
    Sensors,
)
from ballbot_gym.seeding import seeds_of
from ballbot_gym.step import FLAGS, Draws, StepState, check_observation, limit_names, observe, start, start_draws, step
from ballbot_gym.tasks import Task
from ballbot_gym.vector.state import BatchState, BatchStep, _check_starts

with imports_of("a batch of environments", "train"):
    import torch

_log = logging.getLogger(__name__)

COMPILE_FROM = 1024
"""Batch size from which compile="auto" compiles. Compiling takes half a minute, which seldom pays off for smaller batches."""

# By default a loop holds at most 64 operations, and results pass from one loop to the next through memory. By default the
# compiler also repeats an operation in every operation that reads its result. Within one loop the result is kept in any
# case, so the repetition only doubles the time of compiling.
COMPILE_OPTIONS: dict[str, Any] = {
    "max_fusion_size": 1000,
    "realize_opcount_threshold": 2,
    "realize_reads_threshold": 1,
}
"""Options of torch.compile for code that steps a batch."""

_FIXED = ("task", "params", "randomization", "history", "observation", "num_envs", "device", "dtype", "limit_names")
"""Attributes of a batch that cannot be set once it is made: more is computed from them."""


_DONE_BY_STEPS = (
    *("reward", "reward_parts", "cost", "terminated", "truncated", "success", "failure"),
    *("force", "clipped", "grip"),
)
"""Fields of a `BatchStep` that are 0 of an env that has done nothing in its episode yet."""

_Rows = Any
"""A `BatchState` in which each matrix is a tuple of its rows (B,). Everything is computed in this form."""


class BallbotBatch:
    """B ballbots that do one task, in torch, differentiable from actions and states to rewards, costs and observations.

    `transition` is a pure function of state and actions; `reset` and `step` apply it to `self.state`. Gradients flow
    through `step` into earlier actions until an episode ends. The physics is the closed form of
    `BallbotEnv(physics="rk4")`. `state` is never written into: keep it and assign it again to continue from there. Copies and
    pickles are independent batches in the same state.

    As in Gymnasium, the seed s gives env i the seed s + i. So batches with the seeds 0 and 1 share all
    episodes but one. Use `seeding.spawned` to derive a separate seed for each run.
    """

    def __init__(
        self,
        task: str | Task = "stabilize",
        num_envs: int = 1,
        device: str | torch.device = "cpu",
        dtype: torch.dtype | str = torch.float32,
        compile: bool | str = "auto",
        params: Robot | None = None,
        randomization: Randomization | str | None = None,
        robot: str | Robot = PAPER,
        history: int = 0,
        observation: str = "state",
        **task_fields: Any,
    ):
        """Makes the batch; call `reset` first.

        Args:
            task: a name in `TASKS`, or a Task.
            num_envs: B.
            device, dtype: of all tensors; torch.float32 or torch.float64, or its name.
            compile: True compiles `transition` at the first step, for half a minute or so, and raises if that fails.
                "auto" compiles batches of at least `COMPILE_FROM` envs if there is a compiler; if that fails, it logs a
                warning and runs eagerly. False never compiles. Of robots with wheels the equations of motion alone are
                compiled: all of their `transition` would take many minutes.
            params: the nominal robot as a Robot; the same as robot.
            randomization: what varies, or a name in `TRACKS`; default, nothing.
            robot: a name in `ROBOTS`, or a Robot.
            history, observation: same as in `BallbotEnv`.
            **task_fields: fields of the task that replace its defaults.

        Raises:
            ValueError: num_envs, dtype or compile out of range, or as `make_task`.
            TypeError: a keyword that is no field of the task.
        """
        check_num_envs(num_envs)
        dtype = _dtype_named(dtype)
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype must be torch.float32 or torch.float64, not {dtype}")
        if compile not in (True, False, "auto"):
            raise ValueError(f'compile must be True, False or "auto", not {compile!r}')
        self.params = robot_of(task, robot, params)
        self.task = make_task(task, self.params, **task_fields)
        self.limit_names = limit_names(self.task, self.params)
        self.randomization, self.history = Randomization.checked(randomization, self.params), check_history(history)
        self.observation = check_observation(observation, self.params, self.randomization)
        self.num_envs, self.device, self.dtype = int(num_envs), torch.device(device), dtype
        self.state: BatchState | None = None
        self.most_steps = self.task.steps  # fewer truncate episodes sooner; neither pay nor goal changes
        self.restarts = True  # else envs stay at the ends of their episodes
        self._substeps = self.params.substeps(self.task.control_dt)
        self.randomization.delay_steps(self.task.control_dt)  # raises an error where it is no whole number of these
        self._entropy = int(np.random.SeedSequence().generate_state(1)[0])
        self._compile = compile
        wanted = compile is True or (compile == "auto" and num_envs >= COMPILE_FROM and _has_compiler(self.device))
        long = self.params.LONG_EQUATIONS
        self._run = _compiled(self._transition) if wanted and not long else self._transition
        self._slope = self._compiled_slope() if wanted and long and not self.randomization.varies_robot else None
        self._proven = not wanted

    def __setattr__(self, name: str, value: Any) -> None:
        # not by `checks.fixed`, through which torch.compile cannot see
        if name in _FIXED and name in vars(self):
            raise fixed_error(self, name)
        super().__setattr__(name, value)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_run": self.compiled, "_slope": self._slope is not None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._run = _compiled(self._transition) if state["_run"] else self._transition
        self._slope = self._compiled_slope() if state["_slope"] else None

    @property
    def compiled(self) -> bool:
        """Whether `step` runs compiled code. It can change once, at the first step, where compiling fails."""
        return self._run != self._transition

    def reset(
        self,
        seed: int | Sequence[int | None] | None = None,
        mask: torch.Tensor | None = None,
        x: torch.Tensor | None = None,
        c: torch.Tensor | None = None,
        drawn: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Starts episodes.

        Args:
            seed: an int seeds env i with seed + i; a sequence seeds env i with seed[i]. An env without a seed starts its
                next episode; the first time it is seeded at random.
            mask: (B,) bool, the envs to reset; default, all. The first time all are reset.
            x: (8, B) initial states; default, drawn.
            c: (nc, B) constants; default, drawn.
            drawn: (6 or 14, B) what the randomization draws for the episodes; default, by their seeds.

        Returns:
            (B, no) observations of all envs.

        Raises:
            ValueError: seeds, mask, states, constants or draws of the wrong shape, not finite or out of their range; or a
                given state that violates a limit of the task.
        """
        self.state = self.initial_state(seed, mask, x, c, drawn)
        return self.observe(self.state)

    def initial_state(
        self,
        seed: int | Sequence[int | None] | None = None,
        mask: torch.Tensor | None = None,
        x: torch.Tensor | None = None,
        c: torch.Tensor | None = None,
        drawn: torch.Tensor | None = None,
    ) -> BatchState:
        """The state in which `reset` with these arguments would start; changes nothing."""
        size = self.num_envs
        if mask is not None and (not isinstance(mask, torch.Tensor) or (mask.dtype, *mask.shape) != (torch.bool, size)):
            raise ValueError(f"mask must be a tensor of {size} bools, not {_described(mask)}")
        self._check_given(x, self.params.state_size, "x")
        self._check_given(drawn, self.randomization.episode_draws * self.randomization.varies_episodes, "drawn")
        if c is not None:
            self._check_given(c, len(self.task.constant_names), "c")
            for distinct in np.unique(c.detach().cpu().double().numpy(), axis=1).T:
                self.task.check_constants(distinct, self.params)
        old = self.state
        if old is None:
            mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
            seeds = torch.tensor(seeds_of(self._entropy, self.num_envs), device=self.device)
            episode = torch.zeros_like(seeds)
        else:
            mask = torch.ones_like(old.seed, dtype=torch.bool) if mask is None else mask
            seeds, episode = old.seed, old.episode + 1
        if seed is not None:
            given = torch.tensor([-1 if s is None else s for s in seeds_of(seed, self.num_envs)], device=self.device)
            seeds, episode = torch.where(given < 0, seeds, given), torch.where(given < 0, episode, 0)
        new = self._start(seeds, episode, x, c, drawn)
        if x is not None:
            _check_starts(self.task, new.x, new.c, mask)
        return self._stacked(new if old is None else _select(mask, new, _rows(old)))

    def _check_tensor(self, given: Any, shape: tuple[int, ...], what: str) -> None:
        if not isinstance(given, torch.Tensor) or given.shape != shape:
            raise ValueError(f"{what} must be a tensor of shape {shape}, not {_described(given)}")
        if given.is_complex() or given.dtype == torch.bool:
            raise ValueError(f"{what} must be real numbers, not {_described(given)}")

    def _check_given(self, given: Any, rows: int, what: str) -> None:
        if given is None:
            return
        self._check_tensor(given, (rows, self.num_envs), what)
        if not (given.detach().abs() <= LARGEST).all():  # NaN neither
            raise ValueError(f"{what} must be finite numbers within ±{LARGEST:g}")

    def observe(self, state: BatchState) -> torch.Tensor:
        """(B, no) observations of a state, with the sensors' noise. A pure function."""
        return self._observe(_rows(state))

    def sensed(self, state: BatchState) -> torch.Tensor:
        """(8, B) states as sensors report them, with the noise that `observe` shows. A pure function."""
        return torch.stack(self._sensed(_rows(state)))

    def step(self, actions: torch.Tensor) -> BatchStep:
        """Holds forces for one control step; see `transition`. Call `reset` first.

        Raises:
            ValueError: actions that are no tensor of real, finite numbers of shape (B, 2), or (B, 3) with wheels; the envs
                stay as they are.
        """
        state = self.state
        if state is None:
            raise gymnasium.error.ResetNeeded("step() before reset()")
        self._check_tensor(actions, (self.num_envs, self.params.action_size), "actions")
        if not torch.isfinite(actions.detach()).all():
            bad = (~torch.isfinite(actions.detach()).all(1)).nonzero().flatten()
            raise ValueError(f"actions must be finite; those of envs {bad[:8].tolist()} are not")
        try:
            self.state, result = self._run(state, actions)
        except Exception as error:
            if self._proven or self._compile is True:
                raise
            reason = str(error).strip().splitlines()[:1]
            _log.warning("torch.compile failed, the batch runs eagerly: %s %s", type(error).__name__, reason)
            self._run, self._slope = self._transition, None
            self.state, result = self._run(state, actions)
        self._proven = True
        return _typed(result)

    @torch.no_grad()
    def advance(self, actions: np.ndarray, waiting: np.ndarray | None = None) -> BatchStep:
        """`step` for vector envs: without gradients, and some envs may start their next episode instead.

        Args:
            actions: (B, 2), same as in `step`.
            waiting: (B,) bool, the envs that ignore their action and start their next episode, in which they do nothing yet;
                None if there are none.
        """
        begun = None if waiting is None else self.initial_state(None, self._own(waiting))
        did = self.step(self._own(np.asarray(actions, order="F")))  # components contiguous, as everything in the batch
        if begun is None:
            return did
        wait = self._own(waiting)
        self.state = BatchState(*(torch.where(wait, a, b) for a, b in zip(begun, cast(Any, self.state), strict=True)))
        return did._replace(
            **{name: getattr(did, name).masked_fill(wait, 0) for name in _DONE_BY_STEPS},
            violated=did.violated.masked_fill(wait, -1),
            observation=torch.where(wait[:, None], self.observe(self.state), did.observation),
            measured=self.measurements(self.state),
        )

    def _own(self, values: Any) -> torch.Tensor:
        """Numbers or truth values as the batch computes with them."""
        given = torch.as_tensor(values, device=self.device)
        return given if given.dtype == torch.bool else given.to(self.dtype)

    def transition(self, state: BatchState, actions: torch.Tensor) -> tuple[BatchState, BatchStep]:
        """One control step of every env, and the start of the next episode where one ended; a pure function.

        Args:
            state: of the batch.
            actions: (B, 2) forces in units of the robot's force limit, clipped to [−1, 1]. That they are finite is not
                checked.
        """
        state, result = self._transition(state, actions)
        return state, _typed(result)

    def _transition(self, state: BatchState, actions: torch.Tensor) -> tuple[BatchState, BatchStep]:
        """`transition` with flags, 0 and 1, and `violated` as numbers: torch's CPU code generator stores bools one by one."""
        now, noise, steps = _rows(state), self.randomization, state.steps + 1
        asked = actions.to(self.dtype).unbind(-1)
        key = seeding.key(state.seed, state.episode, steps)
        push = seeding.uniforms(key, Randomization.PUSH_DRAWS, self.dtype) if noise.pushes else ()
        read = seeding.uniforms(key, Sensors.DRAWS, self.dtype) if now.sensors else ()
        made = step(self.task, self.params, noise, self._step_state(now), asked, Draws(push, read), self._moved)
        end, did = made.state.x, made.outcome
        truncated = did.truncated
        if self.most_steps < self.task.steps:
            truncated = torch.where(steps >= self.most_steps, 1.0 - did.terminated, truncated)
        done = did.terminated + truncated > 0

        past = now.past
        if past:
            tried = (part.clamp(-1.0, 1.0) for part in asked)
            past = (*self._seen(now), *tried, *past)[: len(past)]
        after = now._replace(x=end, steps=steps, actuator=made.state.actuator, past=past, sensors=made.state.sensors)
        new, observed, measured = after, self._observe(after), self._measured(end)
        observation, new_measured = observed, measured
        # Drawing the next episodes takes as long as the dynamics. Compiled code has no branches that depend on numbers.
        if self.restarts and (torch.compiler.is_compiling() or bool(done.any())):
            new = _select(done, self._start(state.seed, state.episode + 1), after)
            observation, new_measured = self._observe(new), self._measured(new.x)
        result = BatchStep(
            observation=observation,
            reward=did.reward,
            reward_parts=torch.stack((did.reward_survive, did.reward_cost, did.reward_goal)),
            cost=did.cost,
            terminated=did.terminated,
            truncated=truncated,
            final_observation=observed,
            final_x=torch.stack(end),
            success=did.success,
            failure=did.failure,
            violated=did.violated,
            force=torch.stack(made.force),
            clipped=torch.where(made.clipped, 1.0, 0.0),
            grip=self._stack(made.grip, end[0]),
            measured=new_measured,
            final_measured=measured,
        )
        return self._stacked(new), result

    def _moved(
        self, robot: Any, x: tuple[torch.Tensor, ...], force: tuple[torch.Tensor, ...]
    ) -> tuple[tuple[Any, ...], tuple[Any, ...], tuple[Any, ...]]:
        """The states after a control step, and what the floor does, which carries no gradient."""
        dt, slope = self.task.control_dt, self._slope
        if slope is None:
            end = robot.step(x, force, dt, self._substeps)
        else:
            rows = (torch.stack(x),), (torch.stack(force),)
            (moved,) = robot.step(*rows, dt, self._substeps, lambda x, u: (slope(*x, *u),))
            end = moved.unbind(0)
        with torch.no_grad():  # it decides what ends an episode, and nothing else
            return end, *robot.held(x, force, dt)

    def _compiled_slope(self) -> Any:
        """`Robot.derivative` of states (n, B) and forces (m, B), compiled."""
        params = self.params

        def slope(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
            return torch.stack(params.derivative(x.unbind(0), u.unbind(0)))

        return torch.compile(slope, fullgraph=True, dynamic=False, options=COMPILE_OPTIONS)

    def measurements(self, state: BatchState) -> torch.Tensor:
        """(nm, B) what the robot measures in a state, as its `MEASUREMENTS` name it. It carries no gradient."""
        return self._measured(state.x.unbind(0))

    @torch.no_grad()
    def _measured(self, x: tuple[torch.Tensor, ...]) -> torch.Tensor:
        return self._stack(self.params.measurements(x), x[0])

    def model(self, drawn: tuple[torch.Tensor, ...]) -> Robot:
        """The robots for whose episodes the randomization drew this, (B,) each, as one whose numbers are (B,)."""
        return self.randomization.robot(self.params, drawn) if self.randomization.varies_robot else self.params

    def _start(
        self,
        seed: torch.Tensor,
        episode: torch.Tensor,
        x: torch.Tensor | None = None,
        c: torch.Tensor | None = None,
        drawn: torch.Tensor | None = None,
    ) -> _Rows:
        """The starts of episodes; x, c and what the randomization draws are drawn where they are not given."""
        noise, senses = self.randomization, self.observation == "sensors"
        z = seeding.uniforms(seeding.key(seed, episode, 0 * episode), start_draws(self.task, noise, senses), self.dtype)
        given = (None if part is None else part.unbind(0) for part in (x, c, drawn))
        made = start(self.task, self.params, noise, z, senses, *given)
        zero, still = torch.zeros_like(episode), torch.zeros_like(seed, dtype=self.dtype)
        fields: Any = made.x, made.c, zero, episode, seed, made.drawn, made.actuator, (), made.sensors
        begun: _Rows = BatchState(*fields)
        forces = self.params.action_size
        return begun._replace(past=self.history * (*self._seen(begun), *(still,) * forces)) if self.history else begun

    def _observe(self, now: _Rows) -> torch.Tensor:
        """(B, no) observations, with those of the past behind the present one."""
        return torch.stack((*self._seen(now), *now.past)).T

    def _seen(self, now: _Rows) -> tuple[torch.Tensor, ...]:
        """The present observation with the sensors' noise, which depends on the number of steps taken in the episode."""
        return observe(self.task, self.params, self.randomization, self._step_state(now), self._noise(now))

    def _sensed(self, now: _Rows) -> tuple[torch.Tensor, ...]:
        if not self.randomization.is_noisy:
            return now.x
        state = self._step_state(now)
        return self.randomization.sensed(state.x, self._noise(now), state.drawn, state.steps * self.task.control_dt)

    def _noise(self, now: _Rows) -> tuple[torch.Tensor, ...]:
        """Uniform numbers for the noise of the present observation; () where there is none."""
        if not self.randomization.is_noisy:
            return ()
        key = seeding.key(now.seed, now.episode, now.steps + 1)
        z = seeding.uniforms(key, Randomization.PUSH_DRAWS + Randomization.NOISE_DRAWS, self.dtype)
        return z[Randomization.PUSH_DRAWS :]

    def _step_state(self, now: _Rows) -> StepState:
        return StepState(now.x, now.c, now.steps.to(self.dtype), now.drawn, now.actuator, now.sensors)

    def _stacked(self, rows: _Rows) -> BatchState:
        """The rows as tensors."""
        return BatchState(*(self._stack(part, rows.seed) if isinstance(part, tuple) else part for part in rows))

    def _stack(self, parts: tuple[torch.Tensor, ...], like: torch.Tensor) -> torch.Tensor:
        """(n, B) tensor of n components, each in the shape of `like`."""
        return torch.stack(parts) if parts else torch.zeros(0, *like.shape, dtype=self.dtype, device=like.device)


def _typed(result: BatchStep) -> BatchStep:
    """A step whose flags and `violated` are numbers, with bools and an int64."""
    flags = {name: getattr(result, name) > 0 for name in FLAGS}
    return result._replace(violated=result.violated.long(), **flags)


def _has_compiler(device: torch.device) -> bool:
    if device.type == "cuda":
        return True  # Triton brings its own
    return any(shutil.which(name) for name in ("g++", "c++", "clang++"))


def _compiled(transition: Any) -> Any:
    """The bound method, compiled.

    A copy of its code is compiled, because PyTorch limits the recompilations of a code object, and each batch size and task
    needs one.
    """
    function = transition.__func__
    own = types.FunctionType(function.__code__.replace(), function.__globals__, function.__name__)
    bound = types.MethodType(own, transition.__self__)
    return torch.compile(bound, fullgraph=True, dynamic=False, options=COMPILE_OPTIONS)


def _rows(state: BatchState) -> _Rows:
    parts: Any = (part.unbind(0) if part.ndim == 2 else part for part in state)
    return BatchState(*parts)


def _select(mask: torch.Tensor, new: _Rows, old: _Rows) -> _Rows:
    """The new state where the mask (B,) holds, else the old."""

    def chosen(a: Any, b: Any) -> Any:
        if isinstance(a, tuple):
            return tuple(map(chosen, a, b))
        return a if a is b else torch.where(mask, a, b)

    return BatchState(*map(chosen, new, old))


def _described(value: Any) -> str:
    """What a value is, for a message."""
    return f"one of shape {tuple(value.shape)}, {value.dtype}" if isinstance(value, torch.Tensor) else shown(value)


def _dtype_named(dtype: Any) -> Any:
    """A dtype that may be given by its name, as in a spec that was JSON."""
    return {"float32": torch.float32, "float64": torch.float64}.get(dtype, dtype) if isinstance(dtype, str) else dtype
