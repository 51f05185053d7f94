"""Whether forged submissions are refused and honest ones accepted: python benchmarks/submissions.py [--forged 200].

22 honest submissions of three engines are verified as they are, and as on a machine whose arithmetic differs in the last
digits. Forged ones are drawn over kinds, honest submissions, episodes, steps and sizes. Prints what was refused and why, and
ends with status 1 if a forged one was accepted or an honest one refused.
"""

import argparse
import io
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ballbot_gym import certified, files, named_robot, ops
from ballbot_gym.engines import PHYSICS
from ballbot_gym.env import make_task
from ballbot_gym.tasks import TASKS
from ballbot_train import evaluate
from ballbot_train.evaluation import judge, recordings, steering, submissions

EPISODES = 3
HONEST = [(task, "lqr", physics, "paper") for task in TASKS for physics in PHYSICS]
HONEST += [("stabilize", "sac", physics, "paper") for physics in PHYSICS]
HONEST += [("orbit", "sac", physics, "paper") for physics in PHYSICS]
HONEST += [("turn", "apg", "rk4", "rolling"), ("orbit", "nmpc", "mujoco", "paper")]
HONEST += [("stabilize", "lqr", physics, "kugle") for physics in ("bullet", "mujoco")]


def make(folder: Path) -> list[Path]:
    paths = []
    for i, (task, controller, physics, robot) in enumerate(HONEST):
        out = folder / str(i)
        evaluate(controller, task, episodes=EPISODES, physics=physics, robot=robot, out=out)
        packed = submissions.pack(out, controller, "")
        paths += [files.write(out / file, content) for file, content in packed.items()]
    return paths


@contextmanager
def other_machine(rng: np.random.Generator) -> Iterator[None]:
    """Elementary functions and engines whose last digits differ."""
    last = np.finfo(float).eps

    def noisy(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            value = function(*arguments)
            return value * (1 + last * rng.uniform(-4, 4, np.shape(value)))

        return call

    names = ("sin", "cos", "sqrt")
    kept, stepped = {name: getattr(ops, name) for name in names}, judge.stepped

    def noisy_step(*arguments: Any) -> tuple[np.ndarray, np.ndarray]:
        reached, slip = stepped(*arguments)
        return noisy(lambda: reached)(), slip

    try:
        for name in names:
            setattr(ops, name, noisy(kept[name]))
        judge.stepped = noisy_step
        yield
    finally:
        judge.stepped = stepped
        for name in names:
            setattr(ops, name, kept[name])


class Forger:
    """Draws a forgery of a kind from an honest submission."""

    def __init__(self, path: Path, target: Path, rng: np.random.Generator):
        self.path, self.target, self.rng = path, target, rng
        self.honest = recordings.Recording.read(path)
        rows = self.honest.lengths + 1
        self.first = np.cumsum(rows) - rows
        self.episode = int(rng.integers(EPISODES))
        self.steps = int(self.honest.lengths[self.episode])
        self.step = int(rng.integers(1, self.steps + 1))

    def write(self, about: dict[str, Any] | None = None, **changes: Any) -> None:
        changed = replace(self.honest, about=self.honest.about | (about or {}), **changes)
        files.write(self.target, changed.to_bytes())

    def size(self, low: float, high: float) -> float:
        return float(self.rng.choice([-1, 1]) * np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def start(self) -> None:
        states = self.honest.states.copy()
        states[self.first[self.episode], self.rng.integers(8)] += self.size(2e-8, 0.1)
        self.write(states=states)

    def teleport(self) -> None:
        states, begin = self.honest.states.copy(), self.first[self.episode] + self.step
        end = begin + 1 if self.rng.random() < 0.5 else self.first[self.episode] + self.steps + 1
        states[begin:end, self.rng.integers(8)] += self.size(1e-3, 1e-3)
        self.write(states=states)

    def steer(self) -> None:
        """Errors in every step that each keep the tolerance of contact, and all lower the cost."""
        h, i = self.honest, self.episode
        task, robot = make_task(h.about["task"], h.about["robot"]), named_robot(h.about["robot"])
        begin, done = self.first[i], int(h.lengths[: i + 1].sum())
        states, actions = h.states[begin : begin + self.steps + 1], h.actions[done - self.steps : done]
        c = certified.load(task, robot).constants[i]
        pushed = np.sign(steering.costates(task, robot, states, actions, c))
        size, changed = abs(self.size(2e-6, 1e-4)), h.states.copy()
        for k in range(self.steps):
            action = h.actions[done - self.steps + k][None]
            before = np.rint(changed[begin + k] / recordings.GRID) * recordings.GRID
            (reached,), _ = judge.stepped(h.about["physics"], robot, task, before[None], robot.force_limit * action)
            changed[begin + k + 1] = reached - size * pushed[k]
        self.write(states=changed)

    def action(self) -> None:
        actions = self.honest.actions.copy()
        rolls = (
            self.honest.about["robot"] == "kugle"
        )  # less than this is within the tolerance of contact, and `steer` tries it
        actions[self._row, self.rng.integers(2)] += self.size(2e-3 if rolls else 2e-6, 1.0)
        self.write(actions=actions)

    def limit(self) -> None:
        actions = self.honest.actions.copy()
        actions[self._row, self.rng.integers(2)] = np.sign(self.size(1, 1)) * (1 + abs(self.size(1e-8, 2)))
        self.write(actions=actions)

    def end(self) -> None:
        """Some steps fewer, or more, which move as they should."""
        h, i, n = self.honest, self.episode, int(self.rng.integers(1, 10))
        last, done = self.first[i] + self.steps, int(h.lengths[: i + 1].sum())
        if self.rng.random() < 0.5:
            n = min(n, self.steps - 1)
            gone = np.s_[last - n + 1 : last + 1], np.s_[done - n : done]
            states, actions = np.delete(h.states, gone[0], 0), np.delete(h.actions, gone[1], 0)
            n = -n
        else:
            task, robot = make_task(h.about["task"], h.about["robot"]), named_robot(h.about["robot"])
            more = [h.states[last]]
            for _ in range(n):
                rounded = np.rint(more[-1] / recordings.GRID) * recordings.GRID
                (reached,), _ = judge.stepped(h.about["physics"], robot, task, rounded[None], np.zeros((1, 2)))
                more.append(reached)
            states = np.insert(h.states, last + 1, more[1:], 0)
            actions = np.insert(h.actions, done, np.zeros((n, 2)), 0)
        self.write(lengths=h.lengths + n * (np.arange(EPISODES) == i), states=states, actions=actions)

    def mixed(self) -> None:
        h, order = self.honest, self.rng.permutation(EPISODES)
        if (order == np.arange(EPISODES)).all():
            order = order[::-1]
        states = np.split(h.states, self.first[1:])
        actions = np.split(h.actions, np.cumsum(h.lengths)[:-1])
        joined: dict[str, Any] = {
            "states": np.concatenate([states[i] for i in order]),
            "actions": np.concatenate([actions[i] for i in order]),
        }
        self.write(lengths=h.lengths[order], **joined)

    def cost(self) -> None:
        if self.rng.random() < 0.5:
            self.write(about={str(self.rng.choice(["regret_mean", "costs", "success"])): 0.0})
        else:
            name = str(self.rng.choice(["costs", "ends", "success"]))
            files.write(self.target, files.npz(files.read_npz(self.path) | {name: np.zeros(EPISODES)}))

    def facts(self) -> None:
        wrong = [
            {"physics": "bullet" if self.honest.about["physics"] != "bullet" else "rk4"},
            {"robot": "kugle"},
            {"task": "orbit" if self.honest.about["task"] != "orbit" else "turn"},
            {"task": "os:system"},
            {"link": "javascript:alert(1)"},
            {"link": "https://a.org/|0.00 %|"},
            {"name": "<script>"},
            {"name": "x" * 10_000},
        ]
        self.write(about=wrong[self.rng.integers(len(wrong))])

    def cut(self) -> None:
        content = self.path.read_bytes()
        self.target.write_bytes(content[: self.rng.integers(1, len(content))])

    def damaged(self) -> None:
        content = bytearray(self.path.read_bytes())
        with zipfile.ZipFile(self.path) as archive:
            member = archive.getinfo("states.npy")
        # within what is compressed; elsewhere a bit may mean nothing
        where = member.header_offset + 30 + len(member.filename) + self.rng.integers(40, member.compress_size - 40)
        content[where] ^= 1 << self.rng.integers(8)
        self.target.write_bytes(bytes(content))

    def bomb(self) -> None:
        buffer = io.BytesIO()
        size = int(self.rng.choice([2**27, 2**28]))
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(str(self.rng.choice(["states.npy", "about.npy", "more.npy"])), bytes(size))
        content = buffer.getvalue()
        if self.rng.random() < 0.5:  # and says that it is small
            content = content.replace(size.to_bytes(4, "little"), (1000).to_bytes(4, "little"))
        self.target.write_bytes(content)

    @property
    def _row(self) -> int:
        return int(self.honest.lengths[: self.episode].sum()) + self.step - 1


KINDS = ("start", "teleport", "steer", "action", "limit", "end", "mixed", "cost", "facts", "cut", "damaged", "bomb")


def refusal(path: Path) -> str:
    """Why a file is refused; "" if it is accepted."""
    try:
        submissions.verify(path, EPISODES)
    except ValueError as error:
        return str(error).removeprefix(f"{path}: ")
    return ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--forged", type=int, default=200)
    count, rng, wrong = parser.parse_args().forged, np.random.default_rng(0), 0
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        paths = make(Path(folder))
        print(f"{len(paths)} honest submissions made in {time.perf_counter() - begin:.0f} s")
        for where in ("as they are", "with other last digits"):
            refused = []
            for path in paths:
                if where == "as they are":
                    refused.append(refusal(path))
                else:
                    with other_machine(rng):
                        refused.append(refusal(path))
            wrong += sum(map(bool, refused))
            print(f"honest, {where}: {refused.count('')} of {len(paths)} accepted", *filter(None, refused), sep="\n  ")
        kinds = [KINDS[i % len(KINDS)] for i in range(count)]
        for kind in KINDS:
            reasons = []
            for _ in range(kinds.count(kind)):
                forger = Forger(paths[rng.integers(len(paths))], Path(folder) / "forged.npz", rng)
                getattr(forger, kind)()
                reasons.append(refusal(forger.target))
                if not reasons[-1]:
                    print(f"ACCEPTED: {kind} of {HONEST[paths.index(forger.path)]}, {forger.episode}, {forger.step}")
            wrong += reasons.count("")
            print(f"{kind}: {len(reasons) - reasons.count('')} of {len(reasons)} refused; the last: {reasons[-1]}")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
