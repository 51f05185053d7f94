"""`ballbot replay`: a certified episode, rendered."""

import math
from pathlib import Path
from typing import Literal

import numpy as np

from ballbot_baselines import CONTROLLERS
from ballbot_baselines.controller import rollout
from ballbot_gym import certified
from ballbot_gym.env import BallbotEnv
from ballbot_gym.tasks import TASKS
from ballbot_train import evaluate, figures
from ballbot_train.console import console


def replay(
    task: str,
    /,
    controller: str = "trajopt",
    episode: int = 0,
    physics: Literal["bullet", "rk4"] = "bullet",
    frames: int = 5,
    seconds: float | None = None,
    out: Path = Path("runs/replay"),
) -> None:
    """Draws a certified episode under a controller: a strip of rendered frames.

    Args:
        task: name of a task.
        controller: name of a controller.
        episode: index of the certified episode.
        physics: "bullet" or "rk4".
        frames: how many, at equal times.
        seconds: of the last frame; default the end of the episode.
        out: folder of TASK-CONTROLLER-EPISODE.png.
    """
    evaluate.check_names("task", [task], TASKS)
    evaluate.check_names("controller", [controller], CONTROLLERS)
    env = BallbotEnv(task, physics=physics, render_mode="rgb_array")
    episode_set = certified.load(env.task)
    if not 0 <= episode < len(episode_set):
        raise ValueError(f"episode must be 0 to {len(episode_set) - 1}, not {episode}")
    run = rollout(env, CONTROLLERS[controller](env.task, env.params), options=episode_set.options(episode))
    end = min(seconds or math.inf, run.trajectory.duration)
    steps = np.linspace(0, end / env.task.control_dt, frames).round().astype(int)
    pictures = [env.render_state(run.trajectory.x[k]) for k in steps]
    env.close()
    titles = [f"{k * env.task.control_dt:.2f} s, {math.degrees(run.trajectory.tilt[k]):.0f}°" for k in steps]
    path = figures.save(figures.strip_figure(pictures, titles), out / f"{task}-{controller}-{episode}.png")
    console.print(f"picture: {path}")
