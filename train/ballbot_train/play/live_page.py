"""The page of the live playground: what is shown when, and the loop that keeps the simulation in real time.

viser calls back in a thread of its own. What a browser asks for goes into a queue, and the loop of the simulation does it
between two steps. So the playground itself needs no locks.
"""

import contextlib
import gc
import math
import queue
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ballbot_gym import dynamics
from ballbot_gym.drawing import PUSH_SCALE
from ballbot_gym.viewer import Viewer
from ballbot_train.escaping import markdown_text
from ballbot_train.play import views
from ballbot_train.play.clock import Clock
from ballbot_train.play.controls import Controls
from ballbot_train.play.simulation import Playground

_DRAW_HZ, _TEXT_HZ = 30.0, 4.0
_STARVED = 0.25  # s, after which a moment is drawn even if steps are due
_MOST_STEPS = 10  # between two looks at the requests
_IDLE = 0.02  # s, between two looks while nothing moves
_LONGEST_REST = 3600.0  # s, between two looks while nobody is there
_SCORES_SHOWN = 8
_NOTICE_LENGTH = 300
_HELP = "Drag the robot and let go: every robot gets the same push."


class PlayPage:
    """Controls and scene of a playground in a viewer, and the loop that runs them. Who may open the page may use them."""

    def __init__(self, playground: Playground, viewer: Viewer):
        """Builds the page; `run` brings it to life.

        Args:
            playground: what is simulated.
            viewer: where it is shown. The page closes neither of them.
        """
        self.playground, self.viewer = playground, viewer
        self.clock = Clock(playground.world.task.control_dt)
        self.paused = False
        self.single_steps = 0
        """To do in a pause."""
        self.visitors: set[int] = set()
        """Ids of the browsers that show the page. While there are none, time stands still and nothing is computed."""
        self._requests: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self._stopped = self._moving = False
        self._status = viewer.server.gui.add_markdown("")
        self._controls = Controls(self)
        viewer.on_grab = self._grab
        viewer.server.on_client_connect(self._on_connect)
        viewer.server.on_client_disconnect(self._on_disconnect)
        viewer.centre_on(np.array(playground.main.x[:2]))

    # --- the loop ---

    def run(self, seconds: float = math.inf) -> None:
        """Simulates and draws in real time until `stop` is called, or for some seconds."""
        end = time.perf_counter() + seconds
        next_draw = next_text = drawn = 0.0
        while not self._stopped and (now := time.perf_counter()) < end:
            self._do_requests(0.0 if self.visitors else min(_LONGEST_REST, end - now))
            if not self.visitors:
                self.clock.stop()
                self._moving = False
                continue
            stood, self._moving = not self._moving, self._steps_due()
            if stood and self._moving:
                self._collect_garbage()
            now = time.perf_counter()
            if now >= next_draw and (self.clock.wait() > 0 or now - drawn > _STARVED):
                self.viewer.draw(views.drawing(self.playground))
                next_draw, drawn = max(next_draw + 1 / _DRAW_HZ, now), now
                if now >= next_text:
                    self._write()
                    next_text = now + 1 / _TEXT_HZ
            until = min(next_draw, end) - time.perf_counter()
            time.sleep(max(0.0, min(until, self.clock.wait() if self._moving else _IDLE)))

    def stop(self) -> None:
        """Ends `run`; from any thread."""
        self._stopped = True
        self.request(lambda: None)

    def request(self, action: Callable[[], object]) -> None:
        """Has the loop do something between two steps; from any thread."""
        self._requests.put(action)

    def _collect_garbage(self) -> None:
        """Does it when the robot begins to move. A collection of everything that was imported would be a step too late."""
        gc.unfreeze()
        gc.collect()
        gc.freeze()
        self.clock.stop()  # the pause that this made is not caught up

    def _steps_due(self) -> bool:
        """Does the steps that are due; whether the simulation moves."""
        if self.paused:
            self.clock.stop()
            if self.single_steps > 0 and self.playground.step():
                self.single_steps -= 1
            return False
        for _ in range(_MOST_STEPS):
            if self.clock.take() is None:
                break
            if not self.playground.step():
                self.clock.stop()
                return False
        return True

    def _do_requests(self, patience: float) -> None:
        """Does what was asked for until now, or within `patience`, s. Whatever a browser sends, the simulation goes on."""
        asked: list[Callable[[], object]] = []
        with contextlib.suppress(queue.Empty):
            asked = [self._requests.get(timeout=patience)] if patience > 0 else []
        asked += [self._requests.get() for _ in range(self._requests.qsize())]
        for action in [*asked, *[self._controls.refresh] * (len(asked) > 0)]:
            try:
                action()
            except Exception as error:
                self.playground.notice = str(error) or repr(error)

    # --- browsers ---

    def asking(self, action: Callable[[Any, Any], object]) -> Any:
        """A callback of viser that asks for something, by viser's client and the value that the control has got.

        It is a coroutine of viser's loop, so that callbacks come in the order of the changes.
        """

        async def asked(event: Any) -> None:
            value = getattr(event.target, "value", None)
            if event.client_id is not None:  # not set by this program
                self.request(lambda: action(event.client, value))

        return asked

    def _grab(self, client_id: int, phase: str, vector: np.ndarray) -> None:
        """A drag pushes when it ends, so that the arrow ends where it did."""
        if phase == "end":
            x, y = (vector / PUSH_SCALE).tolist()
            self.request(lambda: self.playground.push(x, y))

    async def _on_connect(self, client: Any) -> None:
        self.visitors.add(client.client_id)
        self.request(lambda: None)

    async def _on_disconnect(self, client: Any) -> None:
        self.visitors.discard(client.client_id)

    # --- words ---

    def _write(self) -> None:
        playground = self.playground
        main, best = playground.main, playground.optimum_cost_so_far
        cost = f"cost {main.cost:.2f}" + (f", the optimum's {best:.2f}" if math.isfinite(best) else "")
        lines = [
            f"**{markdown_text(views.status(playground))}**",
            f"tilt {math.degrees(dynamics.tilt(main.x)):.0f}°, {cost}",
        ]
        lines += ["planning …"] * (playground.planning and not playground.preparing) + ["paused"] * self.paused
        lines.append(f"*{markdown_text(playground.notice[:_NOTICE_LENGTH])}*" if playground.notice else _HELP)
        self._status.content = "  \n".join(lines)
        self._controls.show_scores([markdown_text(score.text) for score in playground.scores[-_SCORES_SHOWN:]])
