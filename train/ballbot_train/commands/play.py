"""`ballbot play`: a live playground in the browser."""

import signal
from pathlib import Path
from typing import Literal

from ballbot_gym.robots import PAPER
from ballbot_gym.viewer import HOST, PORT, Viewer, import_viser
from ballbot_train.console import RobotName, console
from ballbot_train.evaluation.controllers import task_name
from ballbot_train.play.live_page import PlayPage
from ballbot_train.play.simulation import Playground


def play(
    task: str | None = None,
    /,
    controller: str = "nmpc",
    ghosts: tuple[str, ...] = ("lqr",),
    policies: tuple[str, ...] = (),
    episode: int | None = 0,
    physics: Literal["bullet", "mujoco", "rk4"] | None = None,
    robot: RobotName = PAPER,
    seed: int = 0,
    host: str = HOST,
    port: int = PORT,
    out: Path = Path("runs/play"),
) -> None:
    """Opens a page on which you push the robot, change it, drive it, and compare controllers.

    Args:
        task: name of a task; default the one that the controller's file names or whose observations fit, or else stabilize.
        controller: of the robot: an expert, a policy that comes with the package, a policy file, a model saved by
            Stable-Baselines3 (.zip) or rsl_rl (.pt), "you" or "you (force)".
        ghosts: controllers that get the same start and the same pushes beside it.
        policies: more policy files and saved models, which the page offers in the tasks that they are made for.
        episode: index of the certified episode it starts with; None for a random start.
        physics: "bullet", "mujoco" or "rk4"; default, the first that is installed.
        robot: name of a robot.
        seed: of random starts, noise and pushes.
        host: address to bind. Everybody but this machine needs the token that is printed.
        port: where the page is; the next free one, if it is taken.
        out: folder of saved files.
    """
    task = task_name(controller, task, robot)
    import_viser()
    playground = Playground(task, controller, ghosts, physics, episode, seed, robot, policies, other_process=True)
    viewer = Viewer(host, port, "ballbot play")
    page = PlayPage(playground, viewer, out)
    signal.signal(signal.SIGTERM, lambda *_: page.stop())
    try:
        console.print(f"open {viewer.address}\nCtrl+C ends it", highlight=False)
        page.run()
    except KeyboardInterrupt:
        console.print("ended")
    finally:
        page.close()
        viewer.close()
        playground.close()
