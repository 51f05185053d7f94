"""The page of the playground: reads viser's controls, draws, and keeps the simulation in real time.

Callbacks of viser run in other threads. They put requests into a queue, and the loop of the simulation does them between two
steps. So the playground itself needs no locks.
"""

import gc
import math
import queue
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym.robots import ROBOTS
from ballbot_gym.tasks import TASKS
from ballbot_gym.viewer import Viewer
from ballbot_train.escaping import markdown_text
from ballbot_train.evaluation.controllers import is_file
from ballbot_train.evaluation.robustness import STRESSES
from ballbot_train.play.clock import Clock
from ballbot_train.play.playground import AT_END, DRIVERS, LARGEST_PUSH, PLANT, Playground
from ballbot_train.play.tunable import weight_names
from ballbot_train.report import labels
from ballbot_train.report.replay import Replay

SPEEDS = (0.1, 2.0)
"""Least and greatest simulated seconds per second."""

_DRAW_HZ = 30.0
_PLOT_HZ = 5.0
_TEXT_HZ = 4.0
_STARVED = 0.25  # s, after which a moment is drawn even if steps are due
_MOST_STEPS = 10  # between two looks at the requests
_IDLE = 0.02  # s, between two looks while nothing moves
_IMPULSE_PER_METRE = 10.0  # N·s of a push by dragging the robot
_STICK_METRES = 1.0  # of a drag that puts the stick fully out
_HELD = 0.25  # s, after which a button of the pad counts as let go
_KEY_HELD = 0.6  # s, the same for a key: keyboards repeat a held key only after half a second
_OTHERS = 4  # ghosts that the plots have lines for
_PLOT_POINTS = 200
_NARROW = 600  # px, of a phone's page, whose lower part viser covers with the controls
_NARROW_EYE, _NARROW_AIM = (-3.4, -2.4, 2.4), (-1.55, -1.1, 0.0)  # m: the robot is in the upper part
_DIRECTIONS = {"forward": (1.0, 0.0), "left": (0.0, 1.0), "back": (-1.0, 0.0), "right": (0.0, -1.0)}
_KEYS = {"W": "forward", "A": "left", "S": "back", "D": "right"}
_ARROWS = {"arrowup": "forward", "arrowleft": "left", "arrowdown": "back", "arrowright": "right"}
_FILE_ENDINGS = {"film (WebP)": ".webp", "film (MP4)": ".mp4"}
_FILM_WIDTH = 640  # px
_FILM_FPS = 20

_FILE_HINT = "a policy's .json, or a model of Stable-Baselines3 (.zip) or rsl_rl (.pt), where the simulation runs"
_HELP = "Drag the robot and let go to push it."
_TIME_BUTTONS = ("Play / pause", "Step", "Restart")
_START_BUTTONS = ("Certified", "Random")


class PlayPage:
    """Controls, plots and scene of a playground in a viewer, and the loop that runs them."""

    def __init__(self, playground: Playground, viewer: Viewer, out: Path):
        """Builds the page; `run` brings it to life.

        Args:
            playground: what is simulated.
            viewer: where it is shown. The page closes neither of them.
            out: folder of saved files.
        """
        self.playground, self.viewer, self.out = playground, viewer, out
        self.clock = Clock(playground.task.control_dt)
        self.driver: int | None = None
        """Id of the browser that drives; the next that touches anything, if None."""
        self._gui = viewer.server.gui
        self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._stopped = self._paused = self._moving = False
        self._single_steps = 0
        self._stick_until = 0.0
        self._open_pages: set[int] = set()
        self._bound: list[tuple[Any, Callable[[], Any]]] = []
        self._films: ProcessPoolExecutor | None = None
        self._jobs: list[tuple[Future, Callable[[Future], None]]] = []
        self._episode_shown = playground.episode or 0
        self._saved = 0
        self._gui.configure_theme(show_logo=False, show_share_button=False)
        self._build()
        self._refresh()
        viewer.on_grab = self._on_grab
        viewer.server.on_client_connect(self._on_connect)
        viewer.server.on_client_disconnect(self._on_disconnect)
        viewer.centre_on(np.array(playground.main.x[:2]))

    # --- the loop ---

    def run(self, seconds: float = math.inf) -> None:
        """Simulates and draws in real time until `stop` is called, or for some seconds."""
        end = time.perf_counter() + seconds
        next_draw = next_plot = next_text = drawn = 0.0
        while not self._stopped and (now := time.perf_counter()) < end:
            self._do_requests()
            stood, self._moving = not self._moving, self._advance()
            if stood and self._moving:
                self._collect_garbage()
            now = time.perf_counter()
            if now >= next_draw and (self.clock.wait() > 0 or now - drawn > _STARVED):
                self.viewer.draw(self.playground.drawing())
                next_draw, drawn = max(next_draw + 1 / _DRAW_HZ, now), now
                if now >= next_plot:
                    self._plot()
                    next_plot = now + 1 / _PLOT_HZ
                elif now >= next_text:
                    self._write()
                    next_text = now + 1 / _TEXT_HZ
            until = min(next_draw, end) - time.perf_counter()
            time.sleep(max(0.0, min(until, self.clock.wait() if self._moving else _IDLE)))

    def stop(self) -> None:
        """Ends `run`; from any thread."""
        self._stopped = True

    def close(self) -> None:
        """Gives up films that are not finished."""
        if self._films is not None:
            self._films.shutdown(wait=False, cancel_futures=True)

    def _collect_garbage(self) -> None:
        """Does it when the robot begins to move. A collection of everything that was imported would be a step too late."""
        gc.unfreeze()
        gc.collect()
        gc.freeze()
        self.clock.stop()  # the pause that this made is not caught up

    def _advance(self) -> bool:
        """Does the steps that are due; whether the simulation moves."""
        if self._paused:
            self.clock.stop()
            if self._single_steps > 0 and self.playground.step():
                self._single_steps -= 1
            return False
        if time.perf_counter() > self._stick_until:
            self.playground.stick.move(0.0, 0.0)
        for _ in range(_MOST_STEPS):
            if not self.clock.take():
                break
            if not self.playground.step():
                self.clock.stop()
                return False
        return True

    def _do_requests(self) -> None:
        while True:
            try:
                request = self._requests.get_nowait()
            except queue.Empty:
                break
            try:
                request()
            except Exception as error:  # whatever a browser sends, the simulation goes on
                self.playground.notice = str(error)
            self._refresh()
        for job in [job for job in self._jobs if job[0].done()]:
            self._jobs.remove(job)
            job[1](job[0])

    # --- who drives ---

    def _on_connect(self, client: Any) -> None:
        if self.driver is None:
            self.driver = client.client_id
        self._open_pages.add(client.client_id)
        if client.camera.image_width < _NARROW:
            client.camera.position, client.camera.look_at = _NARROW_EYE, _NARROW_AIM
        self._show_roles()

    def _on_disconnect(self, client: Any) -> None:
        self._open_pages.discard(client.client_id)
        if self.driver == client.client_id:
            self.driver = None
        self._show_roles()

    def _take_over(self, client_id: int) -> None:
        self.driver = client_id
        self._show_roles()

    def _show_roles(self) -> None:
        count = len(self._open_pages)
        self._role_text.content = f"{count} browsers show this page. One drives, the others watch."
        self._role_text.visible = self._role_button.visible = count > 1

    def _may(self, client_id: int | None) -> bool:
        """Whether this browser drives. The first one that asks takes a free seat."""
        if client_id is None:
            return False
        if self.driver is None:
            self._take_over(client_id)
        return self.driver == client_id

    # --- controls ---

    def _bind(self, control: Any, apply: Callable[[Any], None], read: Callable[[], Any]) -> Any:
        """Lets a control change the playground. What a watcher changes, and what is refused, goes back to what holds."""

        def changed(event: Any) -> None:
            if event.client_id is None:  # set by this program
                return
            if self._may(event.client_id):
                value = control.value
                self._requests.put(lambda: apply(value))
            else:
                self._requests.put(lambda: None)

        control.on_update(changed)
        self._bound.append((control, read))
        return control

    def _button(self, label: str, apply: Callable[[], None], hint: str | None = None) -> Any:
        button = self._gui.add_button(label, hint=hint)
        button.on_click(lambda event: self._ask(event.client_id, apply))
        return button

    def _ask(self, client_id: int | None, apply: Callable[[], None]) -> None:
        if self._may(client_id):
            self._requests.put(apply)

    def _refresh(self) -> None:
        """Shows in every control what holds now."""
        playground = self.playground
        if self._task_shown != (playground.task_name, playground.robot):
            self._build_task()
        options = tuple(map(self._option, self._choices()))
        if self._controller.options != options:
            self._controller.options = options
        for control, read in self._bound:
            value = read()
            if control.value != value:
                control.value = value

    def _build(self) -> None:
        gui, playground = self._gui, self.playground
        self._status = gui.add_markdown("")
        self._role_text = gui.add_markdown("", visible=False)
        self._role_button = gui.add_button("Take the controls", visible=False)
        self._role_button.on_click(lambda event: self._take_over(event.client_id))
        tabs = gui.add_tab_group()
        with tabs.add_tab("Play"):
            self._bind(
                gui.add_dropdown("Task", tuple(TASKS), initial_value=playground.task_name),
                playground.set_task,
                lambda: playground.task_name,
            )
            self._bind(
                gui.add_dropdown("Robot", tuple(ROBOTS), initial_value=playground.robot),
                playground.set_robot,
                lambda: playground.robot,
            )
            self._controller = gui.add_dropdown("Controller", ("",))
            self._bind(self._controller, self._choose, lambda: self._option(playground.controller))
            file = gui.add_text("Policy file", "", hint=_FILE_HINT)
            self._bind(file, self._choose_file, self._shown_file)
            self._ghost_folder = gui.add_folder("Ghosts", expand_by_default=False)
            self._build_time()
            self._build_push()
        with tabs.add_tab("Change"):
            self._build_plant()
            self._weight_folder = gui.add_folder("Weights of the cost")
        with tabs.add_tab("Drive"):
            self._build_pad()
        with tabs.add_tab("Save"):
            self._build_saving()
        panel = gui.add_panel(order=10)
        self._plot_tab = panel.add_tab("Plots")
        panel.dock_left()
        panel.set_width(300)
        self._plots: list[Any] = []
        self._plotted: tuple[str, ...] = ()
        self._task_controls: list[Any] = []
        self._task_shown = ("", "")
        self._build_task()
        for key, direction in {**_KEYS, **_ARROWS}.items():
            self._command(
                f"drive {direction} ({key})", key, lambda event, d=direction: self._steer(event, d, _KEY_HELD)
            )
        self._command("pause or play", "space", lambda event: self._ask(event.client_id, self._toggle))
        self._command("restart", "R", lambda event: self._ask(event.client_id, playground.restart))
        self._command("random start", "N", lambda event: self._ask(event.client_id, playground.start_random))
        self._command("push", "P", lambda event: self._ask(event.client_id, self._push))

    def _command(self, label: str, key: Any, function: Callable[[Any], None]) -> None:
        self._gui.add_command(label, hotkey=key).on_trigger(function)

    def _build_time(self) -> None:
        gui, playground = self._gui, self.playground
        with gui.add_folder("Time"):
            group = gui.add_button_group(" ", _TIME_BUTTONS, hint="keys: space, and R for restart")
            group.on_click(lambda event: self._ask(event.client_id, self._time_action(event.target.value)))
            self._bind(
                gui.add_slider("Speed", *SPEEDS, step=0.1, initial_value=1.0), self._set_speed, lambda: self.clock.speed
            )
            self._episode = gui.add_number("Certified episode", 0, min=0, step=1)
            self._bind(self._episode, self._start_certified, self._shown_episode)
            group = gui.add_button_group("Start", _START_BUTTONS, hint="key: N for a random one")
            group.on_click(lambda event: self._ask(event.client_id, self._start_action(event.target.value)))
            self._bind(
                gui.add_dropdown("At the end", AT_END, initial_value=playground.at_end),
                self._set_at_end,
                lambda: playground.at_end,
            )

    def _build_push(self) -> None:
        gui = self._gui
        with gui.add_folder("Push"):
            self._impulse = gui.add_slider("N·s", 0.0, LARGEST_PUSH, step=0.5, initial_value=10.0)
            self._bearing = gui.add_slider("Direction, °", 0, 360, step=5, initial_value=0, hint="from the x axis")
            for control in (self._impulse, self._bearing):
                held = [control.value]
                self._bind(control, lambda value, held=held: held.__setitem__(0, value), lambda held=held: held[0])
            self._button("Push", self._push, hint="key: P; or drag the robot and let go")

    def _build_plant(self) -> None:
        gui, playground = self._gui, self.playground
        with gui.add_folder("What the controllers do not know"):
            for stress, span in PLANT.items():
                slider = gui.add_slider(
                    _STRESS_LABELS.get(stress, stress),
                    *span,
                    initial_value=playground.plant[stress],
                    hint=STRESSES[stress].label,
                )
                self._bind(
                    slider,
                    lambda value, stress=stress: playground.set_plant(stress, value),
                    lambda stress=stress: playground.plant[stress],
                )
            self._button("All as the controllers believe", self._reset_plant)

    def _build_pad(self) -> None:
        gui = self._gui
        gui.add_markdown(
            "Choose **you** as the controller. The stick then commands a speed, and the robot keeps its balance. "
            "**you (force)** commands the force itself: how long can you balance? Try it at speed 0.3."
        )
        for direction in _DIRECTIONS:
            button = gui.add_button(direction.capitalize())
            button.on_hold(lambda event, d=direction: self._steer(event, d, _HELD), callback_hz=20.0)
        gui.add_markdown("Or hold W A S D or the arrow keys, or drag the robot.")
        self._scores = gui.add_markdown("")

    def _build_saving(self) -> None:
        gui = self._gui
        gui.add_markdown(f"Files are written to `{self.out}`, and this page downloads them.")
        self._saver("Trajectory file", self._save_trajectory)
        for label, ending in _FILE_ENDINGS.items():
            self._saver(label.capitalize(), lambda client, ending=ending: self._save_film(client, ending))
        self._button("Start for ballbot optimize", self._show_optimize)
        self._optimize_text = gui.add_markdown("", visible=False)

    def _saver(self, label: str, save: Callable[[Any], None]) -> None:
        button = self._gui.add_button(label)
        button.on_click(lambda event: self._ask(event.client_id, lambda: save(event.client)))

    def _build_task(self) -> None:
        """Controls that differ from task to task."""
        gui, playground = self._gui, self.playground
        removed = {id(control) for control in self._task_controls}
        self._bound = [pair for pair in self._bound if id(pair[0]) not in removed]
        for control in self._task_controls:
            control.remove()
        self._task_controls = []
        self._task_shown = playground.task_name, playground.robot
        self._controller.options = tuple(map(self._option, self._choices()))
        self._controller.value = self._option(playground.controller)
        self._episode.max = max(0, playground.episodes - 1)
        with self._ghost_folder:
            for name in self._choices():
                if name in DRIVERS:
                    continue
                box = gui.add_checkbox(self._option(name), name in playground.ghosts)
                self._bind(
                    box,
                    lambda wanted, name=name: self._set_ghost(name, wanted),
                    lambda name=name: name in self.playground.ghosts,
                )
                self._task_controls.append(box)
        with self._weight_folder:
            for name in weight_names(playground.base):
                slider = gui.add_slider(
                    name.removesuffix("_weight").replace("_", " ") + " × 10^",
                    -1.5,
                    1.5,
                    step=0.05,
                    initial_value=0.0,
                    hint=f"{name}: 0 is the task's own, {getattr(playground.base, name):g}",
                )
                self._bind(
                    slider,
                    lambda value, name=name: playground.set_weight(name, getattr(playground.base, name) * 10**value),
                    lambda name=name: self._exponent(name),
                )
                self._task_controls.append(slider)
        self.clock.dt = playground.task.control_dt

    def _choices(self) -> list[str]:
        """Names of what can be chosen, with policy files that are in use."""
        playground = self.playground
        return list(dict.fromkeys([*playground.controllers, playground.controller, *playground.ghosts]))

    def _option(self, name: str) -> str:
        """How a controller is called in the page. Files called the same are told apart by their folders."""
        label = labels.label(name)
        if not is_file(name) or sum(labels.label(other) == label for other in self._choices()) == 1:
            return label
        return f"{Path(name).parent.name}/{Path(name).name}"

    def _name(self, option: str) -> str:
        """The name of what is chosen.

        Raises:
            ValueError: there is nothing like that.
        """
        found = [name for name in self._choices() if self._option(name) == option]
        if not found:
            raise ValueError(f"unknown controller {option!r:.100}")
        return found[0]

    def _choose(self, option: str) -> None:
        self.playground.set_controller(self._name(option))

    def _choose_file(self, path: str) -> None:
        if path:
            self.playground.set_controller(path)

    def _shown_file(self) -> str:
        """The policy file of the main robot, if it has one."""
        name = self.playground.controller
        return name if is_file(name) else ""

    def _set_ghost(self, name: str, wanted: bool) -> None:
        others = [ghost for ghost in self.playground.ghosts if ghost != name]
        if wanted and len(others) >= _OTHERS:
            raise ValueError(f"at most {_OTHERS} ghosts")
        self.playground.set_ghosts([*others, name] if wanted else others)

    def _exponent(self, name: str) -> float:
        playground = self.playground
        own = getattr(playground.base, name)
        return round(20 * math.log10(playground.weights.get(name, own) / own)) / 20

    def _set_speed(self, speed: float) -> None:
        if not SPEEDS[0] <= speed <= SPEEDS[1]:
            raise ValueError(f"speed must be {SPEEDS[0]:g} to {SPEEDS[1]:g}, not {speed:g}")
        self.clock.speed = speed

    def _start_certified(self, episode: float) -> None:
        if not (math.isfinite(episode) and episode == int(episode)):
            raise ValueError(f"episode must be a whole number, not {episode}")
        self.playground.start_certified(int(episode))
        self._episode_shown = int(episode)

    def _set_at_end(self, choice: Any) -> None:
        if choice not in AT_END:
            raise ValueError(f"unknown end {choice!r:.100}")
        self.playground.at_end = choice

    def _time_action(self, button: str) -> Callable[[], None]:
        play, step, _ = _TIME_BUTTONS
        return {play: self._toggle, step: self._one_step}.get(button, self.playground.restart)

    def _start_action(self, button: str) -> Callable[[], None]:
        certified = button == _START_BUTTONS[0]
        return (lambda: self._start_certified(self._episode.value)) if certified else self.playground.start_random

    def _shown_episode(self) -> int:
        """The certified episode, or the number that was typed last."""
        episode = self.playground.episode
        return self._episode_shown if episode is None else episode

    def _toggle(self) -> None:
        self._paused = not self._paused

    def _one_step(self) -> None:
        self._paused = True
        self._single_steps += 1

    def _push(self) -> None:
        bearing, impulse = math.radians(self._bearing.value), float(self._impulse.value)
        self.playground.push(impulse * math.cos(bearing), impulse * math.sin(bearing))

    def _reset_plant(self) -> None:
        for stress in PLANT:
            self.playground.set_plant(stress, 0.0)

    # --- driving ---

    def _steer(self, event: Any, direction: str, seconds: float) -> None:
        """Moves the stick as seen by the browser that asks, for a while."""
        if not self._may(event.client_id) or event.client is None:
            return
        camera = event.client.camera
        ahead = np.array(camera.look_at, np.float64)[:2] - np.array(camera.position, np.float64)[:2]
        length = float(np.hypot(*ahead))
        cosine, sine = (ahead / length).tolist() if math.isfinite(length) and length > 0 else (1.0, 0.0)
        x, y = _DIRECTIONS[direction]
        self._requests.put(lambda: self._move_stick(cosine * x - sine * y, sine * x + cosine * y, seconds))

    def _move_stick(self, x: float, y: float, seconds: float) -> None:
        self.playground.stick.move(x, y)
        self._stick_until = time.perf_counter() + seconds

    def _on_grab(self, client_id: int, phase: str, vector: np.ndarray) -> None:
        """Dragging steers where a human drives, and pushes when it ends everywhere else."""
        if not self._may(client_id):
            return
        x, y = vector.tolist()
        if self.playground.is_driven:
            held = 0.0 if phase == "end" else 5.0
            self._requests.put(lambda: self._move_stick(x / _STICK_METRES, y / _STICK_METRES, held))
        elif phase == "end":
            self._requests.put(lambda: self.playground.push(_IMPULSE_PER_METRE * x, _IMPULSE_PER_METRE * y))

    # --- saving ---

    def _file(self, ending: str) -> Path:
        while True:
            self._saved += 1
            name = Path(self.playground.main.name).stem.replace(" ", "-")
            path = self.out / f"{self.playground.task_name}-{name}-{self._saved}{ending}"
            if not path.exists():
                return path

    def _save_trajectory(self, client: Any) -> None:
        path = self.playground.trajectory().save(self._file(".npz"))
        self._hand_over(client, path)

    def _save_film(self, client: Any, ending: str) -> None:
        """In another process, because drawing a film takes all of a core."""
        replay, path = self.playground.replay(), self._file(ending)
        if self._films is None:
            self._films = ProcessPoolExecutor(1, get_context("spawn"))
        if any(not future.done() for future, _ in self._jobs):
            raise ValueError("a film is being drawn; wait for it")
        self.playground.notice = f"drawing {path} …"
        self._jobs.append((self._films.submit(_film, replay, path), lambda future: self._filmed(client, future)))

    def _filmed(self, client: Any, future: Future) -> None:
        if (error := future.exception()) is not None:
            self.playground.notice = f"no film: {error}"
        else:
            self._hand_over(client, future.result())

    def _hand_over(self, client: Any, path: Path) -> None:
        self.playground.notice = f"saved {path}"
        client.send_file_download(path.name, path.read_bytes(), save_immediately=True)

    def _show_optimize(self) -> None:
        self._optimize_text.content = f"```\n{self.playground.optimize_command()}\n```"
        self._optimize_text.visible = True

    # --- words and plots ---

    def _write(self) -> None:
        playground = self.playground
        main, best = playground.main, playground.optimum_cost_so_far
        cost = f"cost {main.cost:.2f}" + (f", the optimum's {best:.2f}" if math.isfinite(best) else "")
        lines = [f"**{markdown_text(playground.status())}**", f"tilt {_degrees(main.x):.0f}°, {cost}"]
        if playground.planning and not playground.preparing:
            lines.append("planning …")
        if self._paused:
            lines.append("paused")
        if playground.notice:
            lines.append(f"*{markdown_text(playground.notice[:300])}*")
        else:
            lines.append(_HELP)
        self._status.content = "  \n".join(lines)
        self._scores.content = "\n".join(f"- {markdown_text(score.text)}" for score in reversed(playground.scores[-8:]))

    def _plot(self) -> None:
        names = self.playground.robot_names()
        if self._plotted != names:
            self._build_plots(names)
        for plot, data in zip(self._plots, self._plot_data(names), strict=True):
            plot.data = data

    def _build_plots(self, names: tuple[str, ...]) -> None:
        """Gives each robot its line. Plots always have the same number of lines, because a browser that is late could not
        tell old plots from new ones.
        """
        playground = self.playground
        self._plotted = names
        lines = [
            {"label": labels.label(name), "stroke": playground.color_of(name), "width": 2.0 if i == 0 else 1.0}
            for i, name in enumerate(names)
        ]
        lines += [{"label": " ", "show": False}] * (1 + _OTHERS - len(names))
        optimum = {"label": "optimum", "stroke": "#222222", "width": 1.0, "dash": (4, 3)}
        first = {"label": "s"}
        kinds = (  # title, lines, what the scale reaches at least
            ("tilt, °", lines, 10.0),
            ("force, N", lines, 50.0),
            ("cost so far, and the optimum's dashed", [*lines, optimum], 1.0),
            ("controller time, ms", lines, 5.0),
        )
        if self._plots:
            for plot, (_, series, _) in zip(self._plots, kinds, strict=True):
                plot.series = (first, *series)
            return
        with self._plot_tab:
            for title, series, least in kinds:
                empty = tuple(np.zeros(2) for _ in range(len(series) + 1))
                plot = self._gui.add_uplot(
                    empty,
                    (first, *series),
                    title=title,
                    scales={"x": {"time": False}, "y": {"range": _scale(least)}},
                    legend={"show": False},
                    height=150,
                    padding=(4, 8, 0, 0),
                )
                self._plots.append(plot)

    def _plot_data(self, names: tuple[str, ...]) -> list[tuple[np.ndarray, ...]]:
        history = self.playground.history(_PLOT_POINTS)
        t = history.seconds
        tilt, force, cost, act = [], [], [], []
        for name in (*names, *names[:1] * (1 + _OTHERS - len(names))):  # hidden lines repeat the first
            line = history.lines[name]
            tilt.append(np.degrees(line[:, 0]))
            force.append(line[:, 1])
            cost.append(line[:, 2])
            act.append(1e3 * line[:, 3])
        return [(t, *tilt), (t, *force), (t, *cost, history.optimum), (t, *act)]


_STRESS_LABELS = {
    "mass": "Masses, %",
    "com": "Centre of mass, %",
    "delay": "Delay, ms",
    "lag": "Lag, ms",
    "noise": "Sensor noise, ×",
    "push": "Random pushes, N·s",
}


def _scale(least: float) -> dict[str, dict[str, float]]:
    """The range of uPlot's vertical axis: from 0 to what is shown, and to `least` at least."""
    return {"min": {"soft": 0.0, "mode": 1, "pad": 0.0}, "max": {"soft": least, "mode": 1, "pad": 0.1}}


def _film(replay: Replay, path: Path) -> Path:
    """Writes the film; in a process of its own."""
    from ballbot_train.report.film import write_film

    return write_film(replay, path, replay.duration, fps=_FILM_FPS, width=_FILM_WIDTH)


def _degrees(x: Sequence[float]) -> float:
    from ballbot_gym.dynamics import tilt

    return math.degrees(tilt(tuple(x)))
