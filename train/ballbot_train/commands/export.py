"""`ballbot export POLICY`: a policy as an ONNX file."""

from pathlib import Path

from ballbot_gym.env import make_task
from ballbot_gym.robots import PAPER, file_name
from ballbot_train.console import RobotName, console
from ballbot_train.evaluation.controllers import policy_path, task_name


def export(policy: str, /, task: str | None = None, onnx: Path | None = None, robot: RobotName = PAPER) -> None:
    """Writes a policy as an ONNX file, which needs neither Python nor torch to run.

    Its input is the observation, its output the action in [-1, 1]. Its metadata names the task, the units, the layout and the
    control rate.

    Args:
        policy: a policy file, or the name of a policy that comes with the package.
        task: name of its task; default the one that its file names, or else stabilize.
        onnx: path of the ONNX file; default runs/export/TASK-POLICY.onnx.
        robot: name of the policy's robot.
    """
    from ballbot_train.onnx_export import export_onnx  # it imports torch

    task = task_name(policy, task, robot)
    problem = make_task(task, robot)
    source = policy_path(policy, problem, robot)
    path = Path("runs") / "export" / f"{file_name(task, robot)}-{Path(policy).stem}.onnx" if onnx is None else onnx
    written = export_onnx(source, path, problem, robot)
    console.print(f"ONNX: {written}, {written.stat().st_size / 1e3:.0f} kB; input observation, output action")
