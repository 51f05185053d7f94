"""The controls of the live page. Each shows what holds in the playground, and changes it."""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from ballbot_gym import files
from ballbot_gym.robots import without_wheels
from ballbot_gym.tasks import TASKS
from ballbot_train.evaluation.controllers import is_file
from ballbot_train.evaluation.robustness import STRESSES
from ballbot_train.play.simulation import LARGEST_PUSH
from ballbot_train.play.world import PLANT
from ballbot_train.report import labels

if TYPE_CHECKING:
    from ballbot_train.play.live_page import PlayPage

SPEEDS = (0.1, 2.0)
"""Least and greatest simulated seconds per second."""

MOST_GHOSTS = 4

_FILE_HINT = "a policy's .json, or a model of Stable-Baselines3 (.zip), where the simulation runs"


class Controls:
    """Builds the controls of a page, and keeps them as the playground is."""

    def __init__(self, page: "PlayPage"):
        self._page, self._playground, self._gui = page, page.playground, page.viewer.server.gui
        self._bound: list[tuple[Any, Callable[[], Any]]] = []
        self._task_controls: list[Any] = []
        self._task_shown = ("", "")
        self._episode_typed = self._playground.episode or 0
        self._impulse, self._bearing = 90.0, 0.0  # N·s and degrees
        tabs = self._gui.add_tab_group()
        with tabs.add_tab("Play"):
            self._build_choices()
            self._build_time()
            self._build_push()
        with tabs.add_tab("Change"):
            self._build_plant()
        with tabs.add_tab("Scores"):
            self._button("Save the episode so far", self._save, hint="a trajectory file, for ballbot replay")
            self._scores = self._gui.add_markdown("")
        self.refresh()

    def refresh(self) -> None:
        """Shows in every control what holds now."""
        shown = self._playground.world.task_name, self._playground.world.robot
        if self._task_shown != shown:
            self._task_shown = shown
            self._build_task()
        if self._controller.options != (options := tuple(self._options())):
            self._controller.options = options
        for control, read in self._bound:
            if control.value != (value := read()):
                control.value = value

    def show_scores(self, scores: Sequence[str]) -> None:
        """Lists how the last episodes ended, the last one first."""
        self._scores.content = "\n".join(f"- {score}" for score in reversed(scores))

    # --- building blocks ---

    def _bind(self, control: Any, apply: Callable[[Any], None], read: Callable[[], Any]) -> Any:
        """Lets a control change the playground. What is refused goes back to what holds."""

        def changed(_: Any, value: Any) -> None:
            if hasattr(control, "min") and not control.min <= value <= control.max:
                raise ValueError(f"{control.label} must be {control.min:g} to {control.max:g}, not {value:g}")
            apply(value)

        control.on_update(self._page.asking(changed))
        self._bound.append((control, read))
        return control

    def _bind_attribute(self, control: Any, owner: object, name: str) -> None:
        self._bind(control, lambda value: setattr(owner, name, value), lambda: getattr(owner, name))

    def _button(self, label: str, action: Callable[[Any], None], hint: str | None = None) -> None:
        """A button that does something for viser's client who presses it."""
        self._gui.add_button(label, hint=hint).on_click(self._page.asking(lambda client, _: action(client)))

    def _button_group(self, label: str, actions: dict[str, Callable[[], None]], hint: str) -> None:
        group = self._gui.add_button_group(label, tuple(actions), hint=hint)
        group.on_click(self._page.asking(lambda _, button: actions[button]()))

    def _key(self, label: str, key: Any, action: Callable[[], None]) -> None:
        self._gui.add_command(label, hotkey=key).on_trigger(self._page.asking(lambda *_: action()))

    # --- the tabs ---

    def _build_choices(self) -> None:
        gui, playground = self._gui, self._playground
        self._bind(gui.add_dropdown("Task", tuple(TASKS)), playground.set_task, lambda: playground.world.task_name)
        self._bind(gui.add_dropdown("Robot", without_wheels()), playground.set_robot, lambda: playground.world.robot)
        self._controller = gui.add_dropdown("Controller", tuple(self._options()))
        self._bind(self._controller, self._choose, self._chosen)
        self._bind(gui.add_text("Policy file", "", hint=_FILE_HINT), self._choose_file, self._file)
        self._ghost_folder = gui.add_folder("Ghosts", expand_by_default=False)

    def _build_time(self) -> None:
        gui, page, playground = self._gui, self._page, self._playground
        with gui.add_folder("Time"):
            actions = {"Play / pause": self._toggle, "Step": self._step, "Restart": playground.restart}
            self._button_group(" ", actions, hint="keys: space, and R for restart")
            self._bind_attribute(gui.add_slider("Speed", *SPEEDS, step=0.1, initial_value=1.0), page.clock, "speed")
            self._episode = gui.add_number("Certified episode", 0, min=0, step=1)
            self._bind(self._episode, self._start_certified, self._shown_episode)
            starts = {
                "Certified": lambda: self._start_certified(self._shown_episode()),
                "Random": playground.start_random,
                "At rest": playground.start_at_rest,
            }
            self._button_group("Start", starts, hint="key: N for a random one")
        self._key("pause or play", "space", self._toggle)
        self._key("restart", "R", playground.restart)
        self._key("random start", "N", playground.start_random)

    def _build_push(self) -> None:
        with self._gui.add_folder("Push"):
            self._bind_attribute(self._gui.add_slider("N·s", 0.0, LARGEST_PUSH, 5.0, 90.0), self, "_impulse")
            slider = self._gui.add_slider("Direction, °", 0.0, 360.0, 5.0, 0.0, hint="from the x axis")
            self._bind_attribute(slider, self, "_bearing")
            self._button("Push", lambda _: self._push(), hint="key: P; or drag the robot and let go")
        self._key("push", "P", self._push)

    def _build_plant(self) -> None:
        playground = self._playground
        with self._gui.add_folder("What the controllers do not know"):
            for stress, (label, low, high, step) in PLANT.items():
                self._bind(
                    self._gui.add_slider(label, low, high, step, 0.0, hint=STRESSES[stress].label),
                    lambda value, stress=stress: playground.set_plant(stress, value),
                    lambda stress=stress: playground.plant[stress],
                )
            self._button("All as the controllers believe", lambda _: self._reset_plant())

    def _build_task(self) -> None:
        """Controls that differ from task to task."""
        gui, playground = self._gui, self._playground
        self._bound = [pair for pair in self._bound if pair[0] not in self._task_controls]
        for control in self._task_controls:
            control.remove()
        self._task_controls = []
        with self._ghost_folder:
            for option, name in self._options().items():
                self._task_controls.append(
                    self._bind(
                        gui.add_checkbox(option, False),
                        lambda wanted, name=name: self._set_ghost(name, wanted),
                        lambda name=name: name in playground.ghosts,
                    )
                )
        self._episode.max = max(0, playground.world.episodes - 1)
        self._page.clock.dt = playground.world.task.control_dt
        self._page.viewer.aim()

    # --- what they do ---

    def _options(self) -> dict[str, str]:
        """What can be chosen by how the page calls it. Files called the same are told apart by their paths."""
        names = self._playground.controllers
        shown = [labels.label(name) for name in names]
        return {
            name if is_file(name) and shown.count(label) > 1 else label: name
            for name, label in zip(names, shown, strict=True)
        }

    def _choose(self, option: str) -> None:
        if (name := self._options().get(option)) is None:  # the options have changed meanwhile
            raise ValueError(f"unknown controller {option!r}")
        self._playground.set_controller(name)

    def _chosen(self) -> str:
        return next(option for option, name in self._options().items() if name == self._playground.main.wanted)

    def _choose_file(self, path: str) -> None:
        if path:
            self._playground.set_controller(path)

    def _file(self) -> str:
        """The policy file of the main robot, if it has one."""
        name = self._playground.main.wanted
        return name if is_file(name) else ""

    def _set_ghost(self, name: str, wanted: bool) -> None:
        others = [ghost for ghost in self._playground.ghosts if ghost != name]
        if wanted and len(others) >= MOST_GHOSTS:
            raise ValueError(f"at most {MOST_GHOSTS} ghosts")
        self._playground.set_ghosts([*others, name] if wanted else others)

    def _start_certified(self, episode: int) -> None:
        self._playground.start_certified(episode)
        self._episode_typed = episode

    def _shown_episode(self) -> int:
        """The certified episode, or the number that was typed last."""
        episode = self._playground.episode
        return self._episode_typed if episode is None else episode

    def _toggle(self) -> None:
        self._page.paused = not self._page.paused

    def _step(self) -> None:
        self._page.paused = True
        self._page.single_steps += 1

    def _save(self, client: Any) -> None:
        """Hands viser's client the trajectory of the episode so far."""
        episode, name = self._playground.trajectory(), f"{self._playground.world.task_name}.npz"
        content = files.npz({"t": episode.t, "x": episode.x, "u": episode.u})
        client.send_file_download(name, content, save_immediately=True)

    def _push(self) -> None:
        bearing = math.radians(self._bearing)
        self._playground.push(self._impulse * math.cos(bearing), self._impulse * math.sin(bearing))

    def _reset_plant(self) -> None:
        for stress in PLANT:
            self._playground.set_plant(stress, 0.0)
