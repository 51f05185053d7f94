"""The page of the live playground: its controls, and the loop that keeps the simulation in real time.

Requests of pages arrive in the server's thread. The loop of the simulation does them between two steps, so the playground
needs no locks. If there are several requests for one control, only the last one is done, so that no number of requests delays
the loop.
"""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from ballbot_gym import certified
from ballbot_gym.drawing.viewer import Viewer
from ballbot_gym.robot import ROBOTS
from ballbot_gym.robot import tilt as tilt_of
from ballbot_gym.tasks import TASKS
from ballbot_train.evaluation.robustness import STRESSES
from ballbot_train.report import labels
from ballbot_train.report.simulation import Playground, Runner, Start

PATIENCE = 0.1
"""s of lag that is caught up. A longer lag, for instance of a planner, is not."""
_DRAW_HZ, _TEXT_HZ = 50.0, 10.0
_IDLE = 0.1  # s, between two checks while no page is connected
_SPEEDS = (0.1, 2.0, 0.01)  # simulated seconds per second: least, greatest, step
_NOTICE_LENGTH = 300
_HELP = "Drag a robot and let go: every robot gets the same push. Drag the floor to look around."
_GHOSTS, _HIDDEN = "Ghosts", "Changes hidden from the controllers"


@dataclass(frozen=True)
class _Control:
    """Something that a page can change, by its name."""

    name: str
    apply: Callable[[Any], object]
    """Changes it to a value that `checked` has returned."""
    read: Callable[[], Any] = lambda: None
    """Its present value; None of a button."""
    options: tuple[str, ...] = ()
    """The values of a choice."""
    limits: tuple[float, float, float] | None = None
    """Least and greatest value and step of a slider."""
    group: str = ""
    """The title under which the page shows it."""

    @property
    def shown(self) -> dict[str, Any]:
        """What stream.js shows."""
        return {
            "name": self.name,
            "group": self.group,
            "value": self.read(),
            "options": self.options or None,
            "limits": self.limits,
        }

    def checked(self, value: Any) -> Any:
        """A value that came from a page.

        Raises:
            ValueError: the control cannot have this value.
        """
        if self.options:
            if value not in self.options:
                raise ValueError(f"{self.name} cannot be {value!r}; choose one that the page lists")
        elif self.limits is not None:
            low, high, _ = self.limits
            if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
                raise ValueError(f"{self.name} must be a number from {low:g} to {high:g}, not {value!r}")
        elif not isinstance(value, bool):
            raise ValueError(f"{self.name} must be true or false, not {value!r}")
        return value


class PlayPage:
    """Controls and scene of a playground in a viewer, and the loop that runs them. Every open page has them."""

    def __init__(self, playground: Playground, viewer: Viewer):
        """Builds the page; `run` brings it to life.

        Args:
            playground: what is simulated.
            viewer: where it is shown. The page closes neither of them.
        """
        self.playground, self.viewer = playground, viewer
        self.paused = self.stopped = False
        self.speed = 1.0
        self._asked: dict[str, Any] = {}  # by the name of a control, the last value that a page has requested
        self._lock = threading.Lock()  # of that
        self._controls: dict[str, _Control] = {}
        self._next_text = 0.0
        playground.announce = self._announce
        self._refresh()
        viewer.on_ask = self._ask

    # --- the loop ---

    def run(self, seconds: float = math.inf) -> None:
        """Simulates and draws in real time until `stopped` is set, or for some seconds. Pauses while no page is connected."""
        now = due = next_draw = time.perf_counter()
        end = now + seconds
        while not self.stopped and now < end:
            self._do_requests()
            if not self.viewer.is_watched:
                time.sleep(_IDLE)
                now = due = time.perf_counter()
                continue
            now = time.perf_counter()
            if self.paused:
                due = now + 1 / _DRAW_HZ
            elif now >= due:
                due = self.next_due(now, due)
                self.playground.step()
            if now >= next_draw:
                self.viewer.draw(self.playground.drawing())
                next_draw = max(next_draw + 1 / _DRAW_HZ, now)
            if now >= self._next_text:
                self._next_text = now + 1 / _TEXT_HZ
                self._refresh()
            time.sleep(max(0.0, min(due, next_draw) - time.perf_counter()))

    def next_due(self, now: float, due: float) -> float:
        """When the step is due, s, that follows one that was due at `due` and begins now."""
        return max(due, now - PATIENCE) + self.playground.world.task.control_dt / self.speed

    def _ask(self, name: str, value: Any) -> None:
        """Takes a request, in the server's thread. A request that names no control is ignored."""
        with self._lock:
            if name in self._controls:
                self._asked.pop(name, None)  # so that it comes after the others
                self._asked[name] = value

    def _do_requests(self) -> None:
        """Does what pages have requested. The page shows why a request fails, and the simulation continues."""
        with self._lock:
            asked, self._asked = self._asked, {}
        for name, value in asked.items():
            control = self._controls.get(name)
            if control is None:  # the request before it has chosen a task or robot without this control
                continue
            self.playground.notice = ""
            try:
                control.apply(control.checked(value))
            except Exception as error:
                self.playground.notice = str(error) or repr(error)
            self._refresh()

    # --- controls ---

    def _made_controls(self) -> list[_Control]:
        playground, known = self.playground, tuple(self.playground.world.controllers)
        episodes: dict[str, Start] = {"rest": "rest", "random": "random"}
        if playground.world.certified is not None:
            episodes |= {str(i): i for i in range(certified.EPISODES)}
        return [
            _Control("Task", playground.set_world, lambda: playground.world.task_name, tuple(TASKS)),
            _Control("Robot", lambda to: playground.set_world(robot=to), lambda: playground.world.robot, tuple(ROBOTS)),
            _Control("Controller", playground.set_controller, lambda: playground.main.name, known),
            _Control(
                "Episode", lambda to: playground.begin(episodes[to]), lambda: str(playground.episode), tuple(episodes)
            ),
            *(
                _Control(
                    name, partial(self._set_ghost, name), partial(playground.ghosts.__contains__, name), group=_GHOSTS
                )
                for name in known
            ),
            *(
                _Control(
                    stress.label,
                    partial(playground.set_plant, name),
                    partial(playground.plant.get, name),
                    limits=stress.choices,
                    group=_HIDDEN,
                )
                for name, stress in STRESSES.items()
            ),
            _Control("Set all to 0", lambda _: self._reset_plant(), group=_HIDDEN),
        ]

    def _refresh(self) -> None:
        """Shows what holds now, in every control and in words."""
        shown = self._made_controls()
        hidden = [
            _Control("playing", self._set_playing, lambda: not self.paused),
            _Control("speed", partial(setattr, self, "speed"), lambda: self.speed, limits=_SPEEDS),
            _Control("Restart", lambda _: self.playground.restart()),
            _Push("push", lambda impulse: self.playground.push(*impulse)),
        ]  # stream.js shows these in other places than the panel
        with self._lock:
            self._controls = {control.name: control for control in [*shown, *hidden]}
        self.viewer.send("panel", [control.shown for control in shown])
        self.viewer.send("status", self._status())

    def _set_playing(self, playing: bool) -> None:
        self.paused = not playing

    def _set_ghost(self, name: str, wanted: bool) -> None:
        others = [ghost for ghost in self.playground.ghosts if ghost != name]
        self.playground.set_ghosts([*others, *[name] * wanted])

    def _reset_plant(self) -> None:
        for stress in STRESSES:
            self.playground.set_plant(stress, 0.0)

    # --- words ---

    def _announce(self, text: str) -> None:
        """Shows what happens next, before it happens."""
        self.viewer.send("status", self._status() | {"text": text})
        self._next_text = 0.0

    def _status(self) -> dict[str, Any]:
        """What happens, as stream.js shows it."""
        playground = self.playground
        said = [score.text + "." for score in playground.scores[-1:]]
        if math.isfinite(playground.optimum_cost):
            said.append(f"The optimum of this episode costs {playground.optimum_cost:.2f}.")
        said.append(playground.notice[:_NOTICE_LENGTH] or _HELP)
        return {
            "text": " ".join(said),
            "clock": f"{playground.seconds:.1f} s of {playground.world.task.duration:g} s",
            "rows": [
                self._row(runner, color) for runner, color in zip(playground.runners, playground.colors, strict=True)
            ],
            "playing": not self.paused,
            "speed": self.speed,
        }

    def _row(self, runner: Runner, color: str) -> dict[str, Any]:
        """A row of the page's table."""
        tilt, peak = (f"{math.degrees(angle):.0f}°" for angle in (tilt_of(runner.x), runner.peak))
        end = runner.failed
        if runner.arrived and math.isfinite(self.playground.optimum_cost):
            end = f"regret {100 * (runner.cost / self.playground.optimum_cost - 1):.1f} %"
        return {
            "label": labels.label(runner.name),
            "color": color,
            "cells": [tilt, peak, f"{math.hypot(*runner.force):.0f} N", f"{runner.cost:.1f}", end],
            "mood": "bad" if runner.violated else "good" if runner.arrived else "",
        }


class _Push(_Control):
    """A push, which the page makes of a drag."""

    def checked(self, value: Any) -> Any:
        if not isinstance(value, list) or len(value) != 2 or not all(type(part) in (int, float) for part in value):
            raise ValueError("a push must be two numbers")
        return value
