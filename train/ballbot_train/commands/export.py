"""`ballbot export POLICY`: a policy as an ONNX file."""

from pathlib import Path

from ballbot_gym.env import make_task
from ballbot_train.console import console
from ballbot_train.evaluation.controllers import policy_path, task_name


def export(policy: str, /, task: str | None = None, onnx: Path | None = None) -> None:
    """Writes a policy as an ONNX file, which needs neither Python nor torch to run.

    Its input is the observation, its output the action in [-1, 1]. Its metadata names the task, the units, the layout and the
    control rate.

    Args:
        policy: a policy file, or the name of a policy that comes with the package.
        task: name of its task; default the one that its file names, or else stabilize.
        onnx: path of the ONNX file; default runs/export/TASK-POLICY.onnx.
    """
    from ballbot_train.onnx_export import export_onnx  # it imports torch

    task = task_name(policy, task)
    problem = make_task(task)
    source = policy_path(policy, problem)
    path = Path("runs") / "export" / f"{task}-{Path(policy).stem}.onnx" if onnx is None else onnx
    written = export_onnx(source, path, problem)
    console.print(f"ONNX: {written}, {written.stat().st_size / 1e3:.0f} kB; input observation, output action")
