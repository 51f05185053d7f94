"""`ballbot export POLICY`: a policy as an ONNX file or as a C file."""

from pathlib import Path
from typing import Literal

from ballbot_gym.env import make_task
from ballbot_gym.robot import PAPER, file_name, named_robot
from ballbot_train.evaluation.controllers import ControllerName
from ballbot_train.evaluation.names import file_part
from ballbot_train.work.console import RobotName, console


def export(
    policy: str,
    /,
    task: str | None = None,
    format: Literal["onnx", "c"] = "onnx",
    out: Path | None = None,
    robot: RobotName = PAPER,
    prefix: str = "ballbot",
    filter: Literal["ekf"] | None = None,
) -> None:
    """Writes a policy as an ONNX or a C file, which needs neither Python nor torch to run.

    An ONNX file computes the action in [-1, 1] from the observation. Its metadata names the task, the units, the layout
    and the control rate. A C file is C99 for microcontrollers, without malloc. It also computes the observation from the
    state, has the same facts in a comment, and can test itself.

    Args:
        policy: a policy file, or the name of a policy that comes with the package; for C also lqr.
        task: name of the task; default, the one that the file of the policy names, else stabilize.
        format: onnx or c.
        out: path of the file; default runs/export/TASK-POLICY with the ending .onnx or .c.
        robot: name of the policy's robot.
        prefix: beginning of all names in a C file; if one program contains several controllers, give each its own.
        filter: ekf, for a robot with wheels and C only: the file then computes the state from the robot's sensor readings.
    """
    name = ControllerName(policy).behind(filter)
    filtered = name.filter == "ekf" and format == "c" and bool(named_robot(robot).SENSORS)
    exported = ControllerName(name.alone) if filtered else name
    task = exported.task(task, robot)
    problem = make_task(task, robot)
    source = "lqr" if (exported.text, format) == ("lqr", "c") else exported.path(problem, robot)
    path = Path("runs") / "export" / f"{file_name(task, robot)}-{file_part(name.text)}.{format}" if out is None else out
    if format == "c":
        from ballbot_train.policy.export_c import export_c  # it imports torch

        written, how = export_c(source, path, problem, robot, filtered, prefix), f"-D{prefix.upper()}_TEST checks it"
    else:
        from ballbot_train.policy.export_onnx import export_onnx  # it imports torch

        written, how = export_onnx(source, path, problem, robot), "input observation, output action"
    console.print(f"{written}: {written.stat().st_size / 1e3:.0f} kB; {how}")
