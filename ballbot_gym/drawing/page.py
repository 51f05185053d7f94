"""The page in the browser that draws ballbots: its HTML, and moments as the data that its scripts draw.

Everything is inside of the page, so it loads nothing. `assets/` has the parts that all pages share. `ballbot_train.report`
adds scenarios that the browser computes by itself.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym import drawing, files
from ballbot_gym.drawing import Drawing, Drawn
from ballbot_gym.robot import Ballbot, Robot

_ASSETS = Path(__file__).parent / "assets"
_FARTHEST = 1e9  # of a number that is sent
_DIGITS = 4  # 0.1 mm and 0.1 mrad are enough to look at


def asset(name: str) -> str:
    """The text of one of the scripts or styles that all pages share."""
    return files.read(_ASSETS / name).decode()


def page_html(data: str, playground: str = "const playground = new Page();", live: bool = False) -> str:
    """The page.

    Args:
        data: a script that declares `DATA`, which begins with what `look` says.
        playground: a script that makes the page, by its class `Page` or one that extends it.
        live: whether the page shows what a `Viewer` sends.
    """
    scripts = [data, asset("scene.js"), asset("page.js"), playground]
    scripts += [asset("stream.js") + "new Stream(playground);"] * live
    shell = asset("page.html").replace("/* style */", asset("page.css"))
    return shell.replace("<!-- scripts -->", "\n".join(f"<script>{script}</script>" for script in scripts))


def look(params: Robot) -> dict[str, Any]:
    """How scene.js draws a robot.

    Raises:
        ValueError: it is no ballbot.
    """
    if not isinstance(params, Ballbot):
        raise ValueError(
            f'the page draws only ballbots, and not a {type(params).__name__}; use render_mode="rgb_array"'
        )
    measures = {name: getattr(params, name) for name in ("ball_radius", "body_radius", "body_length", "com_height")}
    return {
        "robot": measures | {"wheel_radius": params.wheel_radius},
        "colors": {"ball": drawing.BALL, "force": drawing.FORCE, "push": drawing.PUSH, "goal": drawing.GOAL},
        "force_scale": drawing.FORCE_SCALE,
        "push_scale": drawing.PUSH_SCALE,
        "least_force": drawing.LEAST_FORCE,
    }


def moment(drawn: Drawing) -> dict[str, Any]:
    """A drawing as what page.js shows."""
    return {
        "look": look(drawn.params),
        "robots": [_robot(robot) for robot in drawn.robots],
        "paths": [
            {"points": _numbers(path.points), "color": path.color, "dashed": path.dashed} for path in drawn.paths
        ],
        "markers": [asdict(marker) for marker in drawn.markers],
    }


def _robot(robot: Drawn) -> dict[str, Any]:
    x = _numbers(robot.x)
    return {
        "x": x[:4],
        "yaw": x[8] if len(x) > 8 else 0.0,
        "color": robot.color,
        "alpha": robot.alpha,
        "u": None if robot.u is None else _numbers(robot.u),
        "push": None if robot.push is None else _numbers(robot.push),
        "label": robot.label,
        "pushable": True,
    }


def _numbers(values: np.ndarray) -> list[Any]:
    """As JSON has them, which has no infinite numbers."""
    return np.nan_to_num(values).clip(-_FARTHEST, _FARTHEST).round(_DIGITS).tolist()
