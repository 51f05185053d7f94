"""The page of the live playground: its controls, and the loop that keeps the simulation in real time.

viser calls back in a thread of its own. What a browser asks for goes into a queue, and the loop of the simulation does it
between two steps. So the playground needs no locks.
"""

import math
import queue
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from ballbot_gym import certified, dynamics
from ballbot_gym.drawing import PUSH_SCALE
from ballbot_gym.robots import ROBOTS
from ballbot_gym.tasks import TASKS
from ballbot_gym.viewer import Viewer
from ballbot_train.evaluation.robustness import STRESSES
from ballbot_train.report import labels
from ballbot_train.report.simulation import Playground, Start, severities
from ballbot_train.work.console import markdown_text

PATIENCE = 0.1
"""s of lag that is caught up; more, as of a planner, is given up."""
_DRAW_HZ, _TEXT_HZ = 30.0, 4.0
_IDLE = 0.1  # s, between two looks while nobody is there
_SLOWEST, _FASTEST = 0.1, 2.0  # simulated seconds per second
_NOTICE_LENGTH = 300
_HELP = "Drag the robot and let go: every robot gets the same push."


class PlayPage:
    """Controls and scene of a playground in a viewer, and the loop that runs them. Who opens the page may use them."""

    def __init__(self, playground: Playground, viewer: Viewer):
        """Builds the page; `run` brings it to life.

        Args:
            playground: what is simulated.
            viewer: where it is shown. The page closes neither of them.
        """
        self.playground, self.viewer, self._gui = playground, viewer, viewer.server.gui
        self.paused = self.stopped = False
        self._requests: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self._next_text = 0.0
        self._bound: list[tuple[Any, Callable[[], Any]]] = []
        self._ghosts: dict[str, Any] = {}
        playground.announce = self._announce
        viewer.on_grab = lambda vector: self._requests.put(lambda: playground.push(*(vector / PUSH_SCALE).tolist()))
        self._build()

    # --- the loop ---

    def run(self, seconds: float = math.inf) -> None:
        """Simulates and draws in real time until `stopped` is set, or for some seconds. Stands still while nobody watches."""
        now = due = next_draw = time.perf_counter()
        end = now + seconds
        while not self.stopped and now < end:
            self._do_requests()
            if not self.watched:
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
                next_draw = max(next_draw, now) + 1 / _DRAW_HZ
            if now >= self._next_text:
                self._next_text = now + 1 / _TEXT_HZ
                self._refresh()
            time.sleep(max(0.0, min(due, next_draw) - time.perf_counter()))

    @property
    def watched(self) -> bool:
        """Whether a browser shows the page."""
        return bool(self.viewer.server.get_clients())

    def next_due(self, now: float, due: float) -> float:
        """When the step is due, s, that follows one that was due at `due` and begins now."""
        return max(due, now - PATIENCE) + self.playground.world.task.control_dt / max(_SLOWEST, self.speed.value)

    def _do_requests(self) -> None:
        """Does what was asked for until now. What cannot be done is said, and the simulation goes on."""
        while not self._requests.empty():
            self.playground.notice = ""
            try:
                self._requests.get()()
            except Exception as error:
                self.playground.notice = str(error) or repr(error)
            self._next_text = 0.0

    # --- controls ---

    def _build(self) -> None:
        gui, playground = self._gui, self.playground
        self._status = gui.add_markdown("")
        self._bind(gui.add_dropdown("Task", tuple(TASKS)), playground.set_world, lambda: playground.world.task_name)
        self._bind(
            gui.add_dropdown("Robot", tuple(name for name in ROBOTS if ROBOTS[name].params.wheels is None)),
            lambda robot: playground.set_world(robot=robot),
            lambda: playground.world.robot,
        )
        self._controller = gui.add_dropdown("Controller", ("lqr",))
        self._bind(self._controller, playground.set_controller, lambda: playground.main.name)
        self._ghost_folder = gui.add_folder("Ghosts", expand_by_default=False)
        with gui.add_folder("What the controllers do not know", expand_by_default=False):
            for stress, described in STRESSES.items():
                slider = gui.add_slider(described.label, *severities(stress), initial_value=0.0)
                self._bind(slider, partial(playground.set_plant, stress), partial(playground.plant.get, stress))
            told = gui.add_button("All as the controllers believe")
            told.on_click(self._asking(lambda _: [playground.set_plant(stress, 0.0) for stress in STRESSES]))
        with gui.add_folder("Time"):
            actions = {
                "Play / pause": ("space", self._toggle),
                "Restart": ("R", playground.restart),
                "Random": ("N", partial(playground.begin, "random")),
            }
            group = gui.add_button_group(" ", tuple(actions), hint="keys: space, R and N")
            group.on_click(self._asking(lambda button: actions[button][1]()))
            self.speed = gui.add_slider("Speed", _SLOWEST, _FASTEST, step=0.1, initial_value=1.0)
            episodes: dict[str, Start] = {"rest": "rest", "random": "random"}
            episodes |= {str(i): i for i in range(certified.EPISODES)}
            shown = gui.add_dropdown("Episode", tuple(episodes))
            self._bind(shown, lambda name: playground.begin(episodes[name]), lambda: str(playground.episode))
        for label, (key, action) in actions.items():
            gui.add_command(label, hotkey=key).on_trigger(self._asking(lambda _, action=action: action()))
        self._refresh()

    def _bind(self, control: Any, apply: Callable[[Any], object], read: Callable[[], Any]) -> None:
        """Lets a control change the playground. What is refused goes back to what `read` says."""
        control.on_update(self._asking(apply))
        self._bound.append((control, read))

    def _asking(self, action: Callable[[Any], object]) -> Any:
        """A callback of viser that asks for something, by the value that the control has got.

        It is a coroutine of viser's loop, so that callbacks come in the order of the changes.
        """

        async def asked(event: Any) -> None:
            value = getattr(event.target, "value", None)
            if event.client_id is not None:  # not set by this program
                self._requests.put(lambda: action(value))

        return asked

    def _refresh(self) -> None:
        """Shows what holds now, in every control and in words."""
        playground, names = self.playground, tuple(self.playground.world.controllers)
        if tuple(self._ghosts) != names:
            self._controller.options = names
            for box in self._ghosts.values():
                box.remove()
            with self._ghost_folder:
                self._ghosts = {name: self._gui.add_checkbox(name, False) for name in names}
            for name, box in self._ghosts.items():
                box.on_update(self._asking(partial(self._set_ghost, name)))
        shown = [(box, partial(playground.ghosts.__contains__, name)) for name, box in self._ghosts.items()]
        for control, read in [*self._bound, *shown]:
            if control.value != (value := read()):
                control.value = value
        self._status.content = self._text()

    # --- what they do ---

    def _set_ghost(self, name: str, wanted: bool) -> None:
        others = [ghost for ghost in self.playground.ghosts if ghost != name]
        self.playground.set_ghosts([*others, *[name] * wanted])

    def _toggle(self) -> None:
        self.paused = not self.paused

    # --- words ---

    def _announce(self, text: str) -> None:
        """Says what is about to be done, before it is done."""
        self._status.content = f"**{markdown_text(text)}**"
        self._next_text = 0.0

    def _text(self) -> str:
        """What goes on."""
        playground, main = self.playground, self.playground.main
        status = f"{labels.label(main.name)}, {playground.seconds:.1f} s of {playground.world.task.duration:g} s"
        cost = f"tilt {math.degrees(dynamics.tilt(main.x)):.0f}°, cost {main.cost:.2f}"
        if math.isfinite(best := playground.optimum_cost):
            cost += f", the optimum's {best:.2f}"
        lines = [f"**{markdown_text(status)}**", cost, *["paused"] * self.paused]
        lines += [markdown_text(score.text) for score in playground.scores[-1:]]
        lines.append(f"*{markdown_text(playground.notice[:_NOTICE_LENGTH])}*" if playground.notice else _HELP)
        return "  \n".join(lines)
