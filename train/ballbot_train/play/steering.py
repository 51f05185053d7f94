"""How a human drives: keys, buttons and drags move the stick, or push where a controller acts."""

import math
import time
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ballbot_train.play.live_page import PlayPage

_IMPULSE_PER_METRE = 10.0  # N·s of a push by dragging the robot
_STICK_METRES = 1.0  # of a drag that puts the stick fully out
_HELD = 0.25  # s, after which a button of the pad counts as let go
_KEY_HELD = 0.6  # s, the same for a key: keyboards repeat a held key only after half a second
_DRAG_HELD = 5.0  # s, the same for a drag
_DIRECTIONS = {"forward": (1.0, 0.0), "left": (0.0, 1.0), "back": (-1.0, 0.0), "right": (0.0, -1.0)}
_KEYS = {
    "forward": ("W", "arrowup"),
    "left": ("A", "arrowleft"),
    "back": ("S", "arrowdown"),
    "right": ("D", "arrowright"),
}
_LEAD = (
    "Choose **you** as the controller. The stick then commands a speed, and the robot keeps its balance. "
    "**you (force)** commands the force itself: how long can you balance? Try it at speed 0.3."
)


class Steering:
    """Moves the playground's stick for a page."""

    def __init__(self, page: "PlayPage"):
        self._page, self._playground = page, page.playground
        self._until = 0.0
        page.viewer.on_grab = self._grab

    def build(self) -> None:
        """Adds the buttons of the pad, and the keys."""
        gui = self._page.viewer.server.gui
        gui.add_markdown(_LEAD)
        for direction, keys in _KEYS.items():
            gui.add_button(direction.capitalize()).on_hold(self._steered(direction, _HELD), callback_hz=20.0)
            for key in keys:
                command = gui.add_command(f"drive {direction} ({key})", hotkey=key)  # pyright: ignore[reportArgumentType]
                command.on_trigger(self._steered(direction, _KEY_HELD))
        gui.add_markdown("Or hold W A S D or the arrow keys, or drag the robot.")

    def let_go(self) -> None:
        """Centres the stick when nothing holds it any more."""
        if time.perf_counter() > self._until:
            self._playground.stick.move(0.0, 0.0)

    def _steered(self, direction: str, seconds: float) -> Any:
        """Moves the stick as seen by the browser that asks, for a while."""

        async def steered(event: Any) -> None:
            camera = event.client.camera
            ahead = np.array(camera.look_at, np.float64)[:2] - np.array(camera.position, np.float64)[:2]
            length = float(np.hypot(*ahead))
            cosine, sine = (ahead / length).tolist() if math.isfinite(length) and length > 0 else (1.0, 0.0)
            x, y = _DIRECTIONS[direction]
            self._page.ask(event.client_id, lambda: self._move(cosine * x - sine * y, sine * x + cosine * y, seconds))

        return steered

    def _move(self, x: float, y: float, seconds: float) -> None:
        self._playground.stick.move(x, y)
        self._until = time.perf_counter() + seconds

    def _grab(self, client_id: int, phase: str, vector: np.ndarray) -> None:
        """Dragging steers where a human drives, and pushes when it ends everywhere else."""
        x, y = vector.tolist()
        ended = phase == "end"
        if self._playground.is_driven:
            held = 0.0 if ended else _DRAG_HELD
            self._page.ask(client_id, lambda: self._move(x / _STICK_METRES, y / _STICK_METRES, held))
        elif ended:
            self._page.ask(client_id, lambda: self._playground.push(_IMPULSE_PER_METRE * x, _IMPULSE_PER_METRE * y))
