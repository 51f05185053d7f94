"""`ballbot play`: a live playground in the browser."""

import signal
from typing import Literal

from ballbot_gym.drawing.viewer import PORT, Viewer, need_library
from ballbot_gym.env import make_task
from ballbot_gym.registry import own_robot
from ballbot_gym.robot import PAPER, Ballbot, named_robot
from ballbot_train.evaluation.controllers import task_name
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
        task: name of a task; default the one that the controller's file names or whose observations fit, or else stabilize.
        controller: of the robot: an expert, a policy that comes with the package, a policy file, or a model saved
            by Stable-Baselines3 (.zip); default, the best shipped policy.
        ghosts: controllers of further robots, with the same start and the same pushes.
        episode: index of the certified episode it starts with, a random start, or at rest until a push that fells LQR;
            default, at rest where all episodes of the task differ in their start alone, and else 0.
        physics: "bullet", "mujoco" or "rk4"; default, the first that is installed.
        robot: name of a robot.
        seed: of random starts, noise and pushes.
        port: where the page is, for this machine only; the next free one, if it is taken.
        randomization: name of a track, as "unknown": every episode has a robot of it, which is hidden from the controllers.
    """
    task = task_name(controller or "", task, robot)
    robot = own_robot(task, robot)
    if not isinstance(params := named_robot(robot), Ballbot):
        raise ValueError(
            f"the page draws ballbots, and {task} is a task of a {type(params).__name__}; to see its episodes: "
            f"ballbot replay {task} --controllers NAME"
        )
    need_library()
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
