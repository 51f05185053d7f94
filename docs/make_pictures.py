"""Draws the documentation's pictures and films that `ballbot` makes, and writes down which policies they show.

`make pictures` makes those that show other policies than the shipped ones, or were made by another command. Names make these
in any case: `python docs/make_pictures.py basins.png lean.webp`. Started again, an interrupted run continues.

pictures/made.json has each picture's command, and the SHA-256 of the weights of every learned policy that it shows; a test
compares them with the policies that come with the package. Scripts in benchmarks/ draw their figures themselves, and learning
curves are of training runs.
"""

import json
import shlex
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from ballbot_gym import files
from ballbot_gym.tasks import TASKS
from ballbot_train.evaluation.controllers import controllers_of, policy_digests

PICTURES = Path(__file__).parent / "pictures"
MADE = PICTURES / "made.json"
_WORK = Path("runs/pictures")


@dataclass(frozen=True)
class Make:
    """A command, what it writes below its --out by the names of the pictures, and the learned policies shown."""

    command: str
    files: dict[str, str]
    tasks: tuple[str, ...] = ()
    """Whose shipped policies are shown."""
    names: tuple[str, ...] = field(default=())
    """Of the controllers shown, experts among them; default, all of these tasks."""

    def policies(self) -> dict[str, str]:
        """SHA-256 of the weights of the policies that are shipped now, by TASK/NAME."""
        return policy_digests(controllers_of(self.tasks, self.names)) if self.tasks else {}


MAKES = [
    *(Make(f"replay {task}", {f"{task}-trajopt-0.png": f"{task}-trajopt-0.png"}) for task in TASKS),
    Make(
        "paper",
        {name: name for name in ("fig4b-turn-10.png", "fig5a-orbit-4.png", "fig5b-weave.png")}
        | {"fig3-stabilize-5-lqr-and-trajopt.png": "fig3-stabilize-5-lqr-and-trajopt.png"},
    ),
    Make(
        "replay stabilize --episode 1 --controllers trajopt --robot rolling --frictions 0.8 0.6 0.5 --seconds 3 --speed 0.75 "
        "--fps 20 --format webp",
        {"slip.webp": "stabilize-rolling-trajopt-1+0.8+0.6+0.5.webp"},
    ),
    Make(
        "replay stabilize --controllers lqr nmpc sac --episode 7 --seconds 3 --speed 0.75 --width 800 --format webp",
        {"lean.webp": "stabilize-lqr+nmpc+sac-7.webp"},
        ("stabilize",),
        ("lqr", "nmpc", "sac"),
    ),
    Make("basins", {"basins.png": "basins.png"}, ("stabilize",)),
    Make(
        "robustness --tasks stabilize --episodes 10",
        {"robustness-stabilize.png": "figures/robustness-stabilize.png"},
        ("stabilize",),
    ),
    Make("benchmark --tasks stabilize --episodes 1", {"stabilize.png": "figures/stabilize.png"}, ("stabilize",)),
]
"""Every picture that `ballbot` makes, the quick ones first."""


def record(make: Make, policies: dict[str, str]) -> dict[str, object]:
    """What made.json holds of a picture."""
    return {"command": f"ballbot {make.command}", "policies": policies}


def main(names: list[str]) -> None:
    """Makes the pictures of these names, or else those that are not as they should be."""
    known = [name for make in MAKES for name in make.files]
    if unknown := set(names) - set(known):
        sys.exit(f"no command makes {', '.join(sorted(unknown))}; known: {', '.join(known)}")
    for make in MAKES:
        policies, made = make.policies(), json.loads(MADE.read_text())
        asked = any(name in make.files for name in names)
        if not asked and (names or all(made.get(name) == record(make, policies) for name in make.files)):
            continue
        out, start = _WORK / Path(next(iter(make.files))).stem, time.monotonic()
        print(f"ballbot {make.command}", flush=True)
        command = [sys.executable, "-m", "ballbot_train.cli", *shlex.split(make.command), "--out", str(out)]
        if ended := subprocess.run(command).returncode:
            sys.exit(ended)
        for name, written in make.files.items():
            shutil.copyfile(out / written, PICTURES / name)
            made[name] = record(make, policies)
        files.write(MADE, json.dumps(dict(sorted(made.items())), indent=1) + "\n")
        print(f"{', '.join(make.files)}: {time.monotonic() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
