"""The overhead of each executor per item, the speed-up by more workers, and whether all results arrive if a node is killed.

    python benchmarks/scale_out.py                      # needs pip install "ballbot-gym[ray]"
    python benchmarks/scale_out.py --parts kill --episodes 400

| part | measures |
|---|---|
| overhead | time from item to item less that in the item, here and on one node: items of 1 ms to 1 s, in jobs of 1 and 5 |
| throughput | items a second with 1, 2 and 4 workers: items that compute, and items that sleep |
| driver | CPU time of this process per item, and the items a second that it takes: entries of 40 kB, the size of an optimum |
| kill | two Ray nodes on this machine, one killed after a quarter of the items: all arrive once, as one process makes them |

Items that sleep measure the executor alone, also on a machine with few cores or much else to do.
"""

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

# Ray's workers are as important as this process, so that executors compare on a machine with other work
os.environ.setdefault("RAY_worker_niceness", "0")

import numpy as np
import tyro
from ray.cluster_utils import Cluster

from ballbot_gym import files
from ballbot_gym.env import make_task
from ballbot_train.commands.certify import certify
from ballbot_train.evaluation import optima
from ballbot_train.evaluation.runner import Group, MeasuredRun
from ballbot_train.learning.datasets import load_demos
from ballbot_train.learning.demonstrations import DemoConfig, write_demos
from ballbot_train.work import jobs, shards
from ballbot_train.work.executors import Workers, completed

_NODE = {"object_store_memory": 100 * 2**20}
_LOOPS = 1_000_000  # of a computing item, some tenths of a second
_WARM_SECONDS = 5.0  # of a first item, in which all workers start
_PARTS = ("overhead", "throughput", "driver", "kill")
Row = dict[str, Any]


def sleeping(seconds: float, items: Sequence[int]) -> Iterator[jobs.Entry]:
    for _ in items:
        began = time.perf_counter()
        time.sleep(seconds)
        yield {"seconds": time.perf_counter() - began}


def computing(loops: int, items: Sequence[int]) -> Iterator[jobs.Entry]:
    for _ in items:
        began, total = time.perf_counter(), 0
        for i in range(loops):
            total += i * i
        yield {"seconds": time.perf_counter() - began, "total": total}


@contextmanager
def cluster(*cores: int) -> Iterator[Cluster]:
    """A Ray cluster on this machine with a node for every number of cores, the first being its head."""
    made = Cluster(initialize_head=True, head_node_args={**_NODE, "num_cpus": cores[0], "include_dashboard": False})
    for count in cores[1:]:
        made.add_node(num_cpus=count, **_NODE)
    try:
        yield made
    finally:
        made.shutdown()


def timed(
    function: Callable[..., Any], argument: float, n: int, batch: int, workers: Workers, at_once: int
) -> tuple[float, float]:
    """Mean time from item to item, and in an item, s, once every worker has done a first item, which does not count.

    It is measured again with twice the items where less than half of them were left when the last worker had begun.
    """
    work = [jobs.Job(f"warm-{i}", sleeping, (_WARM_SECONDS,), (0,), "warm") for i in range(at_once)]
    starts = range(0, n, batch)
    work += [
        jobs.Job(f"{start}", function, (argument,), tuple(range(start, start + batch)), "item") for start in starts
    ]
    times: dict[str, list[float]] = {"warm": [], "item": []}

    def on_progress(group: str, count: int) -> None:
        times[group].extend([time.perf_counter()] * count)

    with tempfile.TemporaryDirectory() as folder:
        done = jobs.run(work, Path(folder), workers, on_progress)
    inside = [entry["seconds"] for entries in done[at_once:] for entry in entries]
    began = times["warm"][-1]
    counted = [each for each in times["item"] if each > began]
    if len(counted) < n / 2:
        return timed(function, argument, 2 * n, batch, workers, at_once)
    return (counted[-1] - began) / len(counted), float(np.mean(inside))


def executors(address: str, count: int) -> dict[str, Workers]:
    return {"processes": Workers(count), "ray": Workers(ray=address)}


def overhead() -> list[Row]:
    rows = []
    with cluster(1) as made:
        for seconds in (0.001, 0.01, 0.1, 1.0):
            n = int(np.clip(4 / seconds, 5, 200) // 10 * 10) or 10
            for batch in (1, 5):
                for name, workers in {"this process": Workers(1), "ray": Workers(ray=made.address)}.items():
                    period, inside = timed(sleeping, seconds, n, batch, workers, 1)
                    rows.append(
                        {
                            "executor": name,
                            "item_ms": 1e3 * seconds,
                            "items_per_job": batch,
                            "items": n,
                            "overhead_ms": round(1e3 * (period - inside), 3),
                        }
                    )
                    print(rows[-1], flush=True)
    return rows


def throughput() -> list[Row]:
    rows = []
    for count in (1, 2, 4):
        with cluster(*[1] * count) as made:
            for name, workers in executors(made.address, count).items():
                for function, argument in ((sleeping, 0.1), (computing, _LOOPS)):
                    period, inside = timed(function, argument, 80, 4, workers, count)
                    rows.append(
                        {
                            "executor": name,
                            "items_are": function.__name__,
                            "workers": count,
                            "nodes": count if name == "ray" else 1,
                            "items_per_second": round(1 / period, 2),
                            "seconds_in_item": round(inside, 4),
                        }
                    )
                    print(rows[-1], flush=True)
    return rows


def heavy(kilobytes: int, items: Sequence[int]) -> Iterator[jobs.Entry]:
    for _ in items:
        yield {"seconds": 0.0, "text": "x" * 1000 * kilobytes}


def driver() -> list[Row]:
    rows = []
    with cluster(1, 1) as made:
        for name, workers in executors(made.address, 2).items():
            began, spent = time.perf_counter(), time.process_time()
            period, _ = timed(heavy, 40, 1000, 5, workers, 2)
            spent, total = time.process_time() - spent, time.perf_counter() - began
            rows.append(
                {
                    "executor": name,
                    "items_per_second": round(1 / period),
                    "driver_cpu_ms_per_item": round(1e3 * spent / 1002, 2),
                    "seconds": round(total, 1),
                }
            )
            print(rows[-1], flush=True)
    return rows


def certified_set(out: Path, workers: Workers, episodes: int) -> dict[str, np.ndarray]:
    certify(("stabilize",), episodes, out=out, workers=workers)
    return files.read_npz(out / "BallbotStabilize-v0.npz")


def leaderboard(out: Path, workers: Workers, episodes: int) -> dict[str, np.ndarray]:
    groups = [Group("stabilize", "lqr", "rk4"), Group("turn", "lqr", "rk4")]
    done = MeasuredRun(out, workers).measure(groups, episodes // 2, record=True)
    return {
        name: np.array([getattr(row, name) for row in done])
        for name in ("cost", "optimum", "success", "failure", "settle_time")
    }


def dataset(out: Path, workers: Workers, episodes: int) -> dict[str, np.ndarray]:
    config = DemoConfig("stabilize", "lqr", episodes=episodes, physics="rk4")
    return vars(load_demos(write_demos(config, out / "demos-v0", workers), make_task("stabilize")))


def kill(episodes: int) -> list[Row]:
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for made in (certified_set, leaderboard, dataset):
            began = time.perf_counter()
            expected = made(Path(folder) / f"{made.__name__}-one", Workers(1), episodes)
            alone = time.perf_counter() - began
            with cluster(1, 1) as nodes:
                found, written, seconds = _with_a_kill(made, Path(folder), nodes, episodes)
            same = all(_equal(found[key], array) for key, array in expected.items())
            rows.append(
                {
                    "what": made.__name__,
                    "items": episodes,
                    "arrived": len(written),
                    "arrived_once": len(set(written)),
                    "identical": same,
                    "seconds_one_process": round(alone, 1),
                    "seconds_two_nodes_one_killed": round(seconds, 1),
                    "longest_pause_s": round(max(b - a for a, b in pairwise(written.values())), 1),
                }
            )
            print(rows[-1], flush=True)
    return rows


def _equal(a: np.ndarray, b: np.ndarray) -> bool:
    """Bit for bit."""
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def _with_a_kill(
    made: Callable[..., dict[str, np.ndarray]], folder: Path, nodes: Cluster, episodes: int
) -> tuple[dict[str, np.ndarray], dict[tuple[str, int], float], float]:
    """What it makes, when every item was written, and the time that it took."""
    written: dict[tuple[str, int], float] = {}

    def completed_and_kill(*arguments: Any) -> Iterator[tuple[Any, Any]]:
        for key, result in completed(*arguments):
            name, items = (key[1].name, key[1].items) if isinstance(key[-1], jobs.Job) else ("part", key)
            for item in items:
                assert (name, item) not in written, "an item arrived twice"
                written[name, item] = time.perf_counter()
            if nodes.worker_nodes and len(written) >= episodes // 4:
                nodes.remove_node(next(iter(nodes.worker_nodes)), allow_graceful=False)
            yield key, result

    began, modules = time.perf_counter(), (jobs, shards, optima)
    for module in modules:
        module.completed = completed_and_kill
    try:
        found = made(folder / f"{made.__name__}-nodes", Workers(ray=nodes.address), episodes)
    finally:
        for module in modules:
            module.completed = completed
    return found, written, time.perf_counter() - began


def main(out: Path = Path("runs/scale_out"), parts: tuple[str, ...] = _PARTS, episodes: int = 400) -> None:
    """Measures, and writes a CSV file for each part.

    Args:
        out: folder of the results.
        parts: what to measure.
        episodes: of the part that kills a node; an even number.
    """
    measures = {"overhead": overhead, "throughput": throughput, "driver": driver, "kill": lambda: kill(episodes)}
    for part in parts:
        files.write_csv(out / f"{part}.csv", measures[part]())
    print(f"written to {out}")


if __name__ == "__main__":
    tyro.cli(main)
