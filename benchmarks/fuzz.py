"""Fuzzing: every reader is given mutations of valid files. A reader may only answer or raise the errors that it documents.

    python benchmarks/fuzz.py --minutes 10 --seed 0

Every tenth file is unchanged or says the same in other bytes, and must be accepted: a reader that refuses everything fails.
Every reader runs in a process of its own whose memory is bounded, so that a file that makes it allocate too much is found.
The file of a failure is kept. Exit status 1 says that there is one.
"""

import argparse
import io
import json
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym.robot import read_urdf

_MEMORY = 3 * 2**30  # bytes that a reader may take on top of what its imports map
_HARMLESS = 0.1  # share of the files that every reader must accept
_SECONDS = 60.0  # of CPU, that a reader may take: a busy machine makes no reader slow
_PIECES = [
    b"",
    b"\x00",
    b"\xff" * 8,
    b"nan",
    b"inf",
    b"-1",
    b"1e999",
    b"null",
    b"[" * 5000,
    b"{}",
    b"<a>",
    b'"',
    b"\n",
    b",",
]
_NUMBERS = [b"0", b"-1", b"1", b"255", b"65536", b"2147483648", b"9223372036854775808", b"1" * 400, b"1e308", b"NaN"]


def mutated(rng: random.Random, content: bytes) -> bytes:
    """A file's content after one to eight random changes."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        at = rng.randrange(len(data) + 1)
        kind = rng.randrange(7)
        if kind == 0 and data:
            data[min(at, len(data) - 1)] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del data[at:]
        elif kind == 2:
            del data[at : at + rng.randrange(1, 64)]
        elif kind == 3:
            data[at:at] = rng.choice(_PIECES)
        elif kind == 4:
            data[at : at + 8] = rng.randbytes(8)
        elif kind == 5:  # another number in the place of one
            digits = [i for i in range(len(data)) if 48 <= data[i] < 58][:5000]
            if digits:
                i = rng.choice(digits)
                data[i : i + 1] = rng.choice(_NUMBERS)
        else:
            start = rng.randrange(len(data) + 1)
            data[at:at] = data[start : start + rng.randrange(1, 256)]
    return bytes(data)


def repacked(rng: random.Random, content: bytes, change: bool) -> bytes:
    """A zip archive packed again, perhaps with a mutated member. Its checksums are right, so readers reach the member."""
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as archive, zipfile.ZipFile(packed, "w") as copy:
        members = archive.infolist()
        chosen = rng.choice(members)
        for member in members:
            data = archive.read(member)
            copy.writestr(member, mutated(rng, data) if change and member is chosen else data)
    return packed.getvalue()


def harmless(rng: random.Random, path: Path, content: bytes) -> bytes:
    """The same file, or one that says the same in other bytes. Every reader must accept it."""
    if path.suffix == ".json" and rng.random() < 0.5:
        return json.dumps(json.loads(content), indent=rng.choice((None, 0, 3))).encode()
    return repacked(rng, content, False) if zipfile.is_zipfile(path) and rng.random() < 0.5 else content


def harmful(rng: random.Random, path: Path, content: bytes) -> bytes:
    """A mutation of a file; of an archive, half of the time a mutation of a member."""
    return repacked(rng, content, True) if zipfile.is_zipfile(path) and rng.random() < 0.5 else mutated(rng, content)


def _trajectory(folder: Path) -> tuple[list[Path], Callable[[], Any], tuple[type, ...]]:
    from ballbot_gym.trajectory import Trajectory, TrajectoryError

    made = Trajectory(np.arange(5.0), np.ones((5, 8)), np.ones((4, 2)))
    path = made.save(folder / "t.npz")
    return [path], lambda: Trajectory.load(path), (TrajectoryError,)


def _stored_trajectory(folder: Path) -> tuple[list[Path], Callable[[], Any], tuple[type, ...]]:
    """Without compression, so that mutations reach the arrays' headers."""
    from ballbot_gym.trajectory import Trajectory, TrajectoryError

    path = folder / "t.npz"
    np.savez(path, t=np.arange(5.0), x=np.ones((5, 8)), u=np.ones((4, 2)))
    return [path], lambda: Trajectory.load(path), (TrajectoryError,)


def _certified(folder: Path) -> tuple[list[Path], Callable[[], Any], tuple[type, ...]]:
    from ballbot_gym import certified, files
    from ballbot_gym.env import make_task

    path = folder / "set.npz"
    arrays: dict[str, Any] = files.read_npz(certified.path_of(make_task("turn")))
    np.savez(path, **arrays)
    return [path], lambda: certified.load("turn", "paper", path), (certified.CertificateError,)


def _urdf(folder: Path) -> tuple[list[Path], Callable[[], Any], tuple[type, ...]]:
    from ballbot_gym.robot import URDF_PATH

    path = Path(shutil.copy(URDF_PATH, folder / "mine.urdf"))
    return [path], lambda: read_urdf(path), (ValueError,)


def _policy(folder: Path) -> tuple[list[Path], Callable[[], Any], tuple[type, ...]]:
    from ballbot_gym.env import make_task
    from ballbot_train.policy.files import PolicyError, PolicySpec
    from ballbot_train.policy.network import PolicyNetwork, load_policy

    network = PolicyNetwork(PolicySpec.of(make_task("turn"), hidden=(8,)))
    path = network.save(folder / "mine", {"measured": {"regret_mean": 0.1}})
    return [path, path.with_suffix(".safetensors")], lambda: load_policy(path, "turn"), (PolicyError,)


def _sb3_model(folder: Path) -> tuple[list[Path], Callable[[], Any], tuple[type, ...]]:
    import gymnasium
    from stable_baselines3 import PPO

    from ballbot_gym.env import make_task
    from ballbot_gym.robot import default_params
    from ballbot_train.policy.files import PolicyError
    from ballbot_train.policy.saved_models import SavedModel

    env = gymnasium.make("BallbotTurn-v0", physics="rk4")
    path = folder / "mine.zip"
    PPO("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, device="cpu").save(path)
    return [path], lambda: SavedModel.read(path).actor(make_task("turn"), default_params()), (PolicyError,)


def _results(folder: Path) -> tuple[list[Path], Callable[[], Any], tuple[type, ...]]:
    from ballbot_train.evaluation.results import Result, leaderboard, read_results, write_results

    made = [Result("turn", "lqr", i, "rk4", 12.0, 10.0, True, False, 30.0, 2.0, 8.0, 0.1, 1e-5) for i in range(10)]
    write_results(leaderboard(made), made, {"commit": "a"}, folder)

    def read() -> None:
        leaderboard(read_results(folder)[1] or made)

    return [folder / "leaderboard.json"], read, (ValueError,)


def _marker(folder: Path) -> tuple[list[Path], Callable[[], Any], tuple[type, ...]]:
    from ballbot_train.work import jobs

    config, name = {"episodes": 3, "policies": {"a": "b"}}, "config.json"
    jobs.RunFolder(folder, name).claim(config)
    return [folder / name], lambda: jobs.RunFolder(folder, name).claim(config), (ValueError,)


def _entries(folder: Path) -> tuple[list[Path], Callable[[], Any], tuple[type, ...]]:
    from ballbot_train.work import jobs

    path = folder / "job.json"
    path.write_text(json.dumps([{"cost": 1.5}] * 9))
    return [path], lambda: jobs._read(path, 9), ()


def _demos(folder: Path) -> tuple[list[Path], Callable[[], Any], tuple[type, ...]]:
    from ballbot_gym.env import make_task
    from ballbot_train.learning.datasets import load_demos
    from ballbot_train.learning.demonstrations import DemoConfig, write_demos

    out = write_demos(DemoConfig("turn", "lqr", 2, "rk4"), folder / "tiny-v0", 1)
    paths = [out / "data" / "metadata.json", out / "data" / "main_data.hdf5"]
    return paths, lambda: load_demos(out, make_task("turn")), (ValueError,)


def _checkpoint(folder: Path) -> tuple[list[Path], Callable[[], Any], tuple[type, ...]]:
    from ballbot_gym.env import make_task
    from ballbot_gym.robot import default_params
    from ballbot_train.learning import apg, training
    from ballbot_train.work import jobs

    task, config = make_task("turn"), {"learner": "apg", "task": "turn"}
    settings = apg.ApgConfig(iterations=2, evaluations=1, num_envs=2, episode_seconds=0.04, hidden=(4,))
    made = apg.make(task, default_params(), settings)
    run = training._Run(made, task, config | {"settings": asdict(settings)}, folder / "run", False)
    run.score()
    run.save()

    def resume() -> None:
        jobs.RunFolder(folder / "run").unlock()
        training._Run(
            apg.make(task, default_params(), settings),
            task,
            config | {"settings": asdict(settings)},
            folder / "run",
            True,
        )

    return [folder / "run" / "checkpoint.pt", folder / "run" / "config.json"], resume, (ValueError,)


READERS = {
    "trajectory": _trajectory,
    "trajectory, stored": _stored_trajectory,
    "certified set": _certified,
    "urdf": _urdf,
    "policy": _policy,
    "saved model of Stable-Baselines3": _sb3_model,
    "results": _results,
    "marker": _marker,
    "job entries": _entries,
    "demonstrations": _demos,
    "checkpoint": _checkpoint,
}


def fuzz(name: str, minutes: float, seed: int, kept: Path) -> None:
    """Gives a reader mutations until the time is over; ends the process with status 1 at the first failure."""
    rng = random.Random(f"{seed} {name}")
    with tempfile.TemporaryDirectory() as folder:
        paths, read, allowed = READERS[name](Path(folder))
        original = {path: path.read_bytes() for path in paths}
        read()
        mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (mapped + _MEMORY, mapped + _MEMORY))
        count = Counter[str]()
        longest, end = 0.0, time.monotonic() + 60 * minutes
        while time.monotonic() < end:
            path = rng.choice(paths)
            must_accept = rng.random() < _HARMLESS
            path.write_bytes((harmless if must_accept else harmful)(rng, path, original[path]))
            shutil.copy(path, kept)  # so that a file that kills the process is kept
            start = time.process_time()
            signal.setitimer(signal.ITIMER_PROF, _SECONDS)  # ends this process, also within a library's code
            try:
                read()
                count["harmless" if must_accept else "accepted"] += 1
            except BaseException as error:
                if must_accept or not isinstance(error, allowed):
                    what = "refused, though it says the same" if must_accept else "a failure"
                    print(f"{name}: {what}; {path.name} is kept as {kept}\n{traceback.format_exc()}", flush=True)
                    sys.exit(1)
                count["refused"] += 1
            signal.setitimer(signal.ITIMER_PROF, 0)
            longest = max(longest, time.process_time() - start)
            for changed, content in original.items():
                changed.write_bytes(content)
        kept.unlink(missing_ok=True)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(
            f"{name}: {count.total()} files: {count['harmless']} harmless ones accepted; of the mutated ones "
            f"{count['accepted']} accepted, {count['refused']} refused with a message, 0 tracebacks; "
            f"longest {longest:.2f} s of CPU, peak memory {peak:.0f} MiB",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description="Gives every reader mutations of valid files.")
    parser.add_argument("--minutes", type=float, default=10.0, help="for each reader")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--readers", nargs="*", choices=list(READERS), default=list(READERS))
    parser.add_argument("--out", type=Path, default=Path("runs/fuzz"), help="folder of the files of failures")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    failed = []
    for name in options.readers:
        kept = options.out / f"{name.replace(', ', '-').replace(' ', '-')}.bin"
        process = get_context("spawn").Process(target=fuzz, args=(name, options.minutes, options.seed, kept))
        process.start()
        process.join()
        if process.exitcode == -signal.SIGPROF:
            print(f"{name}: takes more than {_SECONDS} s of CPU; its file is kept as {kept}", flush=True)
        if process.exitcode != 0:
            failed.append(f"{name} (exit status {process.exitcode})")
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
