"""Faults: every long command is killed again and again, and meets full disks, folders that cannot be written, a second run
and dead workers. What it makes in the end must equal what an undisturbed run makes.

    python benchmarks/faults.py --kills 50 --seed 0

Exit status 1 says that something was lost, or that a command ended in a traceback. Only the settings are tiny. Commands that
are to be killed are forked from this process, which has imported their libraries, so that kills meet work and not imports.
"""

import argparse
import csv
import fcntl
import os
import random
import resource
import shlex
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym.lazy import load
from ballbot_train import cli
from ballbot_train.commands import COMMANDS as COMMAND_ENTRIES
from ballbot_train.learning.learners import LEARNERS
from ballbot_train.policy.files import SHIPPED

_TIMES = {"plan_seconds", "step_seconds"}  # columns that no two runs share
_LIMIT = 900.0  # s, after which a command hangs
_FULL = (0, 200, 3000)  # bytes that a file can hold on a disk that is full
_KILLED = (0.02, 0.5)  # when a command is killed, as a share of the time that it takes undisturbed
_PIPE_BYTES = 2**20
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
    from ballbot_train.learning.datasets import load_demos

    return dict(vars(load_demos(out, make_task("turn"))))


def _fresh(out: Path) -> Made:
    return {"fresh.csv": (out / "fresh.csv").read_text()}


def _policy(out: Path) -> Made:
    return {"weights": (out / "policy.safetensors").read_bytes()}


_NET = "--task turn --resume --hidden 8 --evaluations 1 --seed 1"
_RL = "--iterations 6 --num-envs 4 --num-steps 8 --batch-size 16"


def _command(words: str, read: Callable[[Path], Made], workers: bool = True) -> Command:
    return Command(tuple(shlex.split(words)), read, workers)


def _train(learner: str, words: str) -> Command:
    return _command(f"train {learner} {_NET} {words}", _policy, workers=False)


COMMANDS = {
    "benchmark": _command("benchmark --tasks turn stabilize --controllers lqr --episodes 20 --physics rk4", _episodes),
    "robustness": _command(
        "robustness --tasks turn --controllers lqr --stresses delay mass --episodes 6 --physics rk4", _episodes
    ),
    "basins": _command("basins --controllers lqr --points 5 --physics rk4", _basins),
    "certify": _command("certify --tasks turn --episodes 6", _sets),
    "evaluate": _command("evaluate apg --fresh 20 --optima 4", _fresh),
    "transfer": _command(
        "transfer --tasks turn --controllers lqr --made-for paper rolling --episodes 20 --physics rk4", _episodes
    ),
    "demos": _command("demos --task turn --expert lqr --episodes 12 --physics rk4", _dataset),
    "bc": _train("dagger", "--iterations 6 --gathering-iterations 0 --gradient-steps 20 --demos {demos}"),
    "dagger": _train(
        "dagger", "--iterations 4 --gathering-iterations 2 --episodes-per-iteration 64 --gradient-steps 20"
    ),
    "ppo": _train("ppo", _RL),
    "ppo from a policy": _train("ppo", f"{_RL} --start {SHIPPED / 'turn-dagger.json'}"),
    "sac": _train("sac", _RL),
    "apg": _train("apg", "--iterations 8 --num-envs 4 --episode-seconds 0.06"),
}


class Process:
    """A command that runs in a session of its own. What it says goes into a pipe, which holds all of it."""

    def __init__(self, pid: int, pipe: int):
        self.pid, self._pipe = pid, pipe
        self.status: int | None = None

    def wait(self, seconds: float) -> int | None:
        """Its exit status, or None if it still runs after `seconds`."""
        end = time.monotonic() + seconds
        while self.running() and time.monotonic() < end:
            time.sleep(0.02)
        return self.status

    def running(self) -> bool:
        if self.status is None:
            ended, status = os.waitpid(self.pid, os.WNOHANG)
            self.status = os.waitstatus_to_exitcode(status) if ended else None
        return self.status is None

    def kill(self, group: bool) -> None:
        """Kills it, or it and its workers."""
        (os.killpg if group else os.kill)(self.pid, signal.SIGKILL)
        os.waitpid(self.pid, 0)
        self.status = -signal.SIGKILL

    def said(self) -> str:
        """What it said; call it once, at the end."""
        os.set_blocking(self._pipe, False)
        text = b""
        try:
            while part := os.read(self._pipe, _PIPE_BYTES):
                text += part
        except BlockingIOError:  # a worker that outlives it holds the other end
            pass
        os.close(self._pipe)
        return text.decode(errors="replace")


class Trial:
    """One command under faults."""

    def __init__(self, name: str, folder: Path, demos: Path, kills: int, rng: random.Random):
        self.name, self.folder, self.wanted_kills, self.rng = name, folder, kills, rng
        self.kills = self.compared = 0
        self.command = COMMANDS[name]
        self.words = [word.replace("{demos}", str(demos)) for word in self.command.words]
        if self.command.workers:
            self.words += ["--workers", "2"]
        self.failures: list[str] = []
        self.out = folder / "out-v0"

    def start(self, out: Path | None = None, file_bytes: int | None = None, fork: bool = True) -> Process:
        """Starts the command, perhaps on a disk where a file can hold only `file_bytes` bytes.

        Args:
            out: its folder.
            file_bytes: of the largest file.
            fork: go on in the copy of this process, which has imported the libraries; else a new interpreter starts.
        """
        words = [*self.words, "--out", str(out or self.out)]
        pipe, end = os.pipe()
        fcntl.fcntl(end, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        sys.stdout.flush()
        pid = os.fork()
        if pid:
            os.close(end)
            return Process(pid, pipe)
        status: int | str | None = 70
        try:
            os.setsid()
            os.chdir(self.folder)
            os.dup2(end, 1)
            os.dup2(end, 2)
            if file_bytes is not None:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, file_bytes))
            if not fork:
                os.execv(sys.executable, [sys.executable, "-m", "ballbot_train.cli", *words])
            sys.argv = ["ballbot", *words]
            cli.main()
        except SystemExit as ended:
            status = ended.code
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            os._exit(status if isinstance(status, int) else 1)

    def expect(self, what: str, process: Process, status: int, message: str = "") -> None:
        """Waits for the command, which must end with a status and say something, without a traceback."""
        if process.wait(_LIMIT) is None:
            process.kill(group=True)
            self.failures.append(f"{what}: it hangs")
        said = process.said()
        if process.status != status or message not in said or "Traceback" in said:
            self.failures.append(f"{what}: status {process.status}, and it said: {said[-1500:]}")

    def compare(self, what: str) -> None:
        """What the folder holds must be what the undisturbed run made. Deletes it."""
        try:
            made = self.command.read(self.out)
            same = made.keys() == self.wanted.keys() and all(
                np.array_equal(value, self.wanted[key]) for key, value in made.items()
            )
            self.compared += 1
            if not same:
                self.failures.append(f"{what}: its result differs from that of an undisturbed run")
        except Exception as error:
            self.failures.append(f"{what}: its result cannot be read: {error!r}")
        self.clear()

    def clear(self) -> None:
        """Deletes what the command made."""
        for made in (self.out, self.folder / "optima"):
            shutil.rmtree(made, ignore_errors=True)

    def finish(self, what: str) -> None:
        """Runs to the end, and compares."""
        self.expect(what, self.start(), 0)
        self.compare(what)

    def undisturbed(self) -> None:
        """Runs to the end, and keeps what was made."""
        start = time.monotonic()
        self.expect("undisturbed", self.start(fork=False), 0)
        self.seconds = time.monotonic() - start
        if not self.failures:
            self.wanted = self.command.read(self.out)
        self.clear()

    def killed(self) -> None:
        """Kills at random moments: the command alone, or it and its workers. If it ends before, it is started again."""
        seconds = 0.0  # that it takes undisturbed
        while self.kills < self.wanted_kills:
            start, process = time.monotonic(), self.start()
            if process.wait(self.rng.uniform(*_KILLED) * seconds if seconds else _LIMIT) is None:
                process.kill(group=self.kills % 2 == 1)
                self.kills += 1
            seconds = seconds or time.monotonic() - start
            said = process.said()
            if process.status == 0:
                self.compare(f"after {self.kills} kills")
            elif process.status != -signal.SIGKILL:
                self.failures.append(f"after {self.kills} kills: status {process.status}, and it said: {said[-1500:]}")
                return
        self.finish(f"after {self.kills} kills")

    def full_disk(self) -> None:
        for size in _FULL:
            self.expect(f"files of {size} bytes at most", self.start(file_bytes=size), 1)
        self.finish("after a full disk")

    def no_folder(self) -> None:
        for out in _NO_FOLDERS:
            self.expect(f"--out {out}", self.start(Path(out)), 1)

    def two_runs(self) -> None:
        first = self.start()
        while first.running() and not any(self.folder.rglob(".lock")):
            time.sleep(0.02)
        second = self.start()
        if first.running():
            self.expect("a second run at once", second, 1, "another run is using")
        self.expect("the first of two runs", first, 0)
        self.compare("the first of two runs")

    def dead_worker(self) -> None:
        """Kills one worker, which ends the command, and runs the command again."""
        process, end = self.start(), time.monotonic() + self.seconds
        while process.running() and time.monotonic() < end:
            time.sleep(0.05)
            workers = _children(process.pid)
            if workers and time.monotonic() > end - 0.5 * self.seconds:
                os.kill(self.rng.choice(workers), signal.SIGKILL)
                break
        process.wait(_LIMIT)
        ended = process.status == 0  # before the kill, or the dead worker had nothing to do any more
        self.expect("a dead worker", process, 0 if ended else 1, "" if ended else "a worker process died")
        self.finish("after a dead worker")

    def run(self) -> list[str]:
        """All faults, one after the other; returns what went wrong."""
        self.undisturbed()
        faults = [self.killed, self.full_disk, self.no_folder, self.two_runs]
        faults += [self.dead_worker] * self.command.workers
        for fault in [] if self.failures else faults:  # without an undisturbed result there is nothing to compare
            fault()
        print(
            f"{self.name}: {self.kills} kills; {self.compared} results compared with that of an undisturbed run, which took "
            f"{self.seconds:.0f} s; {len(self.failures)} failures",
            flush=True,
        )
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


def _import_libraries() -> None:
    """Imports what the commands import, for `Trial.fork`."""
    for entry in COMMAND_ENTRIES.values():
        load(entry)
    for learner in LEARNERS.values():
        learner.settings("stabilize")


def main() -> None:
    parser = argparse.ArgumentParser(description="Kills long commands, and compares what they make in the end.")
    parser.add_argument("--kills", type=int, default=50, help="of each command")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", nargs="*", choices=list(COMMANDS), default=list(COMMANDS))
    options = parser.parse_args()
    os.environ |= {"BALLBOT_CHECKPOINT_SECONDS": "0", "OMP_NUM_THREADS": "1"}
    _import_libraries()
    failed = []
    with tempfile.TemporaryDirectory() as folder:
        demos = Path(folder) / "demonstrations" / "tiny-v0"
        if any("{demos}" in COMMANDS[name].words for name in options.commands):
            Trial("demos", Path(folder), demos, 0, random.Random()).start(demos).wait(_LIMIT)
        for name in options.commands:
            own = Path(folder) / name.replace(" ", "-")
            own.mkdir()
            if Trial(name, own, demos, options.kills, random.Random(f"{options.seed} {name}")).run():
                failed.append(name)
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
