"""Faults: every long command is killed again and again, and meets full disks, folders that cannot be written, a second run
and dead workers. What it makes in the end must equal what an undisturbed run makes.

    python benchmarks/faults.py --kills 50 --seed 0

Exit status 1 says that something was lost, or that a command ended in a traceback. Only the settings are tiny.
"""

import argparse
import csv
import os
import random
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

_TIMES = {"plan_seconds", "step_seconds"}  # columns that no two runs share
_LIMIT = 900.0  # s, after which a command hangs
_FULL = (0, 200, 3000)  # bytes that a file can hold on a disk that is full
_NO_FOLDERS = ("/proc/ballbot/out-v0", "/dev/null/out-v0")

Made = dict[str, Any]
"""What a command made, by name: what must be the same after faults."""


@dataclass(frozen=True)
class Command:
    """A long command with tiny settings."""

    words: tuple[str, ...]
    read: Callable[[Path], Made]
    """What the command made in its folder."""
    workers: bool = True
    """Whether it works in processes of its own."""


def _episodes(out: Path) -> Made:
    with (out / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {str(i): {key: value for key, value in row.items() if key not in _TIMES} for i, row in enumerate(rows)}


def _basins(out: Path) -> Made:
    return {"basins.csv": (out / "basins.csv").read_text()}


def _sets(out: Path) -> Made:
    from ballbot_gym import files

    return dict(files.read_npz(out / "BallbotTurn-v0.npz"))


def _dataset(out: Path) -> Made:
    from ballbot_gym.env import make_task
    from ballbot_train.learning.demonstrations import load_demos

    return dict(vars(load_demos(out, make_task("turn"))))


def _policy(out: Path) -> Made:
    return {"weights": (out / "policy.safetensors").read_bytes()}


_NET = "--task turn --resume --hidden 8 --evaluations 2 --seed 1"
_RL = "--rl-iterations 6 --num-envs 4 --num-steps 8 --batch-size 16"


def _command(words: str, read: Callable[[Path], Made], workers: bool = True) -> Command:
    return Command(tuple(shlex.split(words)), read, workers)


def _train(learner: str, words: str) -> Command:
    return _command(f"train {learner} {_NET} {words}", _policy, workers=False)


COMMANDS = {
    "benchmark": _command(
        "benchmark --tasks turn stabilize --controllers lqr --episodes 20 --physics rk4 --runs none", _episodes
    ),
    "robustness": _command(
        "robustness --tasks turn --controllers lqr --stresses delay mass --episodes 6 --physics rk4", _episodes
    ),
    "basins": _command("basins --controllers lqr --points 5 --physics rk4", _basins),
    "certify": _command("certify --tasks turn --episodes 12", _sets),
    "demos": _command("demos --task turn --expert lqr --episodes 12 --physics rk4", _dataset),
    "bc": _train("bc", "--total-iterations 6 --gradient-steps 20 --demos {demos}"),
    "dagger": _train(
        "dagger",
        "--total-iterations 4 --gathering-iterations 2 --episodes-per-iteration 2 --candidate-episodes 0 "
        "--tracked-rollouts-per-plan 1 --gradient-steps 20",
    ),
    "ppo": _train("ppo", _RL),
    "sac": _train("sac", _RL),
    "shac": _train("shac", "--total-iterations 8 --num-envs 4 --horizon 3 --no-compile"),
}


class Trial:
    """One command under faults."""

    def __init__(self, name: str, folder: Path, demos: Path, kills: int, rng: random.Random):
        self.name, self.folder, self.kills, self.rng = name, folder, kills, rng
        self.command = COMMANDS[name]
        self.words = [word.replace("{demos}", str(demos)) for word in self.command.words]
        if self.command.workers:
            self.words += ["--workers", "2"]
        self.failures: list[str] = []
        self.out = folder / "out-v0"

    def start(self, out: Path | None = None, file_bytes: int | None = None) -> subprocess.Popen[str]:
        """Starts the command, perhaps on a disk where a file can hold so many bytes only."""

        def limit() -> None:
            if file_bytes is not None:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, file_bytes))

        return subprocess.Popen(
            [sys.executable, "-m", "ballbot_train.cli", *self.words, "--out", str(out or self.out)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            preexec_fn=limit,
            env={**os.environ, "BALLBOT_CHECKPOINT_SECONDS": "0"},
            cwd=self.folder,
        )

    def end(self, process: subprocess.Popen[str]) -> tuple[int, str]:
        """Waits for the command; one that hangs is killed and is a failure."""
        try:
            printed, _ = process.communicate(timeout=_LIMIT)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            printed, _ = process.communicate()
            self.failures.append(f"it hangs: {printed[-300:]}")
        return process.returncode, printed

    def expect(self, what: str, process: subprocess.Popen[str], status: int, message: str = "") -> None:
        """Waits for the command, which must end with a status and say something, without a traceback."""
        code, printed = self.end(process)
        if code != status or message not in printed or "Traceback" in printed:
            self.failures.append(f"{what}: status {code}, and it said: {printed[-1500:]}")

    def compare(self, what: str) -> None:
        """What the folder holds must be what the undisturbed run made."""
        try:
            made = self.command.read(self.out)
            same = made.keys() == self.wanted.keys() and all(
                np.array_equal(value, self.wanted[key]) for key, value in made.items()
            )
        except Exception as error:
            self.failures.append(f"{what}: its result cannot be read: {error!r}")
            return
        if not same:
            self.failures.append(f"{what}: its result differs from that of an undisturbed run")

    def finish(self, what: str) -> None:
        """Runs to the end, and compares."""
        self.expect(what, self.start(), 0)
        self.compare(what)
        shutil.rmtree(self.out, ignore_errors=True)

    def undisturbed(self) -> None:
        start = time.monotonic()
        self.expect("undisturbed", self.start(), 0)
        self.seconds = time.monotonic() - start
        if not self.failures:
            self.wanted = self.command.read(self.out)
        shutil.rmtree(self.out, ignore_errors=True)

    def killed(self) -> None:
        """Kills at random moments: the command alone, or it and its workers. Where it ends before, it starts anew."""
        done = 0
        while done < self.kills:
            process = self.start()
            try:
                process.wait(self.rng.uniform(0.2, 1.0) * self.seconds)
            except subprocess.TimeoutExpired:
                (process.kill if done % 2 else lambda group=process.pid: os.killpg(group, signal.SIGKILL))()
                process.wait()
                done += 1
                continue
            finally:
                if process.poll() is not None and process.stdout is not None:
                    process.stdout.close()
            if process.returncode != 0:
                self.failures.append(f"kills: after {done} of them it ended with status {process.returncode}")
                return
            self.compare(f"after {done} kills")
            shutil.rmtree(self.out)
        self.finish(f"after {done} kills")

    def full_disk(self) -> None:
        for size in _FULL:
            self.expect(f"files of {size} bytes at most", self.start(file_bytes=size), 1)
        self.finish("after a full disk")

    def no_folder(self) -> None:
        for out in _NO_FOLDERS:
            self.expect(f"--out {out}", self.start(Path(out)), 1)

    def two_runs(self) -> None:
        first = self.start()
        locks = (self.out / ".lock", self.out.with_name(f".{self.out.name}.unfinished") / ".lock")
        while first.poll() is None and not any(lock.exists() for lock in locks):
            time.sleep(0.02)
        second = self.start()
        if first.poll() is None:
            self.expect("a second run at once", second, 1, "another run is using")
        self.expect("the first of two runs", first, 0)
        self.compare("the first of two runs")
        shutil.rmtree(self.out, ignore_errors=True)

    def dead_worker(self) -> None:
        """Kills one worker, whose item is tried again."""
        process, end = self.start(), time.monotonic() + self.seconds
        while process.poll() is None and time.monotonic() < end:
            time.sleep(0.05)
            workers = _children(process.pid)
            if workers and time.monotonic() > end - 0.5 * self.seconds:
                os.kill(self.rng.choice(workers), signal.SIGKILL)
                break
        self.expect("a dead worker", process, 0)
        self.compare("a dead worker")
        shutil.rmtree(self.out, ignore_errors=True)

    def run(self) -> list[str]:
        """All faults, one after the other; returns what went wrong."""
        self.undisturbed()
        faults = [self.killed, self.full_disk, self.no_folder, self.two_runs]
        faults += [self.dead_worker] * self.command.workers
        for fault in [] if self.failures else faults:  # without an undisturbed result there is nothing to compare
            fault()
        print(f"{self.name}: {self.seconds:.0f} s, {self.kills} kills, {len(self.failures)} failures", flush=True)
        for failure in self.failures:
            print(f"  {failure}", flush=True)
        return self.failures


def _children(pid: int) -> list[int]:
    """Worker processes of a process: its children that run Python's spawn_main."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == pid and b"spawn_main" in (entry / "cmdline").read_bytes():
                found.append(int(entry.name))
        except (OSError, ValueError, IndexError):  # it has ended meanwhile
            continue
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description="Kills long commands, and compares what they make in the end.")
    parser.add_argument("--kills", type=int, default=50, help="of each command")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", nargs="*", choices=list(COMMANDS), default=list(COMMANDS))
    options = parser.parse_args()
    os.environ.pop("BALLBOT_IN_PROCESS", None)
    failed = []
    with tempfile.TemporaryDirectory() as folder:
        demos = Path(folder) / "demos" / "tiny-v0"
        if "bc" in options.commands:
            words = [*COMMANDS["demos"].words, "--out", str(demos)]
            subprocess.run([sys.executable, "-m", "ballbot_train.cli", *words], check=True, stdout=subprocess.DEVNULL)
        for name in options.commands:
            own = Path(folder) / name
            own.mkdir()
            if Trial(name, own, demos, options.kills, random.Random(f"{options.seed} {name}")).run():
                failed.append(name)
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
