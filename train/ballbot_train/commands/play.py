"""`ballbot play`: a live playground in the browser."""

import signal
from typing import Literal

from ballbot_gym.drawing import need_viewer
from ballbot_gym.drawing.viewer import PORT, Viewer
from ballbot_gym.env import make_task
from ballbot_gym.registry import own_robot
from ballbot_gym.robot import PAPER, Ballbot, named_robot
from ballbot_train.evaluation.controllers import ControllerName
from ballbot_train.report.live_page import PlayPage
from ballbot_train.report.simulation import Playground, Start
from ballbot_train.work.console import RobotName, console


def play(
    task: str | None = None,
    /,
    controller: str | None = None,
    ghosts: tuple[str, ...] = ("lqr",),
    episode: Start | None = None,
    physics: Literal["bullet", "mujoco", "rk4"] | None = None,
    robot: RobotName = PAPER,
    seed: int = 0,
    port: int = PORT,
    randomization: str | None = None,
) -> None:
    """Opens a page on which you push the robot, change it, and compare controllers.

    Args:
        task: name of a task; default, the one that the controller's file names or whose observations fit, else stabilize.
        controller: controller of the robot: an expert, a policy that comes with the package, a policy file, or a model saved
            by Stable-Baselines3 (.zip); default, the best shipped policy.
        ghosts: controllers of further robots, which have the same start and get the same pushes.
        episode: the index of a certified episode; a random start; or at rest, with a push after which LQR falls. Default, at
            rest if the task's episodes have no constants, such as a goal or a speed, and else episode 0.
        physics: "bullet", "mujoco" or "rk4"; default, the first that is installed.
        robot: name of a robot.
        seed: seed of random starts, noise and pushes.
        port: port of the page, which only this machine can open; if it is taken, the next free one.
        randomization: name of a track, such as "unknown": it draws a robot for every episode, hidden from the controllers.
    """
    task = ControllerName(controller or "").task(task, robot)
    robot = own_robot(task, robot)
    if not isinstance(params := named_robot(robot), Ballbot):
        raise ValueError(
            f"the page draws ballbots, and {task} is a task of a {type(params).__name__}; to see its episodes: "
            f"ballbot replay {task} --controllers NAME"
        )
    need_viewer()
    if episode is None:
        episode = 0 if make_task(task, robot).constant_names else "rest"
    console.print("preparing the controllers …")
    playground = Playground(task, controller, ghosts, physics, episode, seed, robot, randomization)
    from ballbot_train.report.playground import playground_page  # it imports casadi

    viewer = Viewer(port, playground_page(live=True))
    page = PlayPage(playground, viewer)
    signal.signal(signal.SIGTERM, lambda *_: setattr(page, "stopped", True))
    try:
        console.print(f"open {viewer.address}\nCtrl+C ends it", highlight=False)
        page.run()
    except KeyboardInterrupt:
        console.print("ended")
    finally:
        viewer.close()
        playground.close()
