"""Optima per second of `find_optima`, which solves many episodes at once, beside `find_optimum`, on starts of Stabilize.

Times are of the processor, of one process, so that a busy machine spoils them less. Run it with OMP_NUM_THREADS=1. Both
solve the same episodes in turns. The batch starts from simulated recoveries, and from the episodes of the shipped policy.
"""

import statistics
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from ballbot_baselines.batched import find_optima
from ballbot_baselines.optimum import find_optimum
from ballbot_gym import files
from ballbot_gym.batch import BallbotBatch, run_episodes
from ballbot_gym.env import make_task
from ballbot_gym.params import default_params
from ballbot_gym.rollout import PlanError
from ballbot_train.evaluation import fresh
from ballbot_train.policy import load_network, shipped_policies

_ACCURATE = 1e-4  # relative


@dataclass(frozen=True)
class Row:
    """A solver: milliseconds per episode, how many times as many per second as one by one, and how accurate they are."""

    solver: str
    episodes: int
    milliseconds: float
    speedup: float
    solved: float
    accurate: float
    """Share of those solved by both whose cost is within 1e-4 of the least found."""
    worst: float
    """Greatest excess over the least found, relative."""


def main(episodes: int = 8192, checked: int = 300, seed: int = 0, out: Path = Path("runs/batched_optima")) -> None:
    """Measures, and writes batched_optima.csv.

    Args:
        episodes: solved in the batch.
        checked: of these, solved one by one too.
        seed: of the episodes.
        out: folder of the results.
    """
    task, params = make_task("stabilize"), default_params()
    x0, c = fresh.draw(task, range(episodes), seed, "training", "paper")
    find_optimum(task, params, x0[0], c[0])  # compiles
    one_by_one, times = np.full(checked, np.nan), []
    for i in range(checked):
        begin = time.process_time()
        try:
            found = find_optimum(task, params, x0[i], c[i])
            one_by_one[i] = found.cost if found.is_optimal else np.nan
        except PlanError as error:
            print(f"episode {i}: {error}")
        times.append(time.process_time() - begin)
    begin = time.process_time()
    cold = find_optima(task, params, x0)
    cold_seconds = time.process_time() - begin
    begin = time.process_time()
    network = load_network(shipped_policies(task)["sac"], task)
    run = run_episodes(BallbotBatch(task, episodes, compile=False), network, x0, c, record=True)
    assert run.states is not None
    met = torch.cat(
        [torch.as_tensor(x0)[None], run.states.transpose(1, 2).double()[:-1]]
    )  # before each step, (n, B, 8)
    with torch.no_grad():
        actions = network(task.observe(met, torch.as_tensor(c)).float()).double()
    warm = find_optima(task, params, x0, forces=params.force_limit * actions.transpose(0, 1).numpy())
    warm_seconds = time.process_time() - begin
    least = np.nanmin([one_by_one, cold.costs[:checked], warm.costs[:checked]], axis=0)
    mean = statistics.mean(times)

    def row(solver: str, costs: np.ndarray, count: int, seconds: float, solved: float) -> Row:
        excess = costs[:checked] / least - 1
        excess = excess[np.isfinite(excess)]
        accurate = float((excess < _ACCURATE).mean())
        return Row(solver, count, 1e3 * seconds / count, mean * count / seconds, solved, accurate, float(excess.max()))

    rows = [
        row("find_optimum", one_by_one, checked, sum(times), float(np.isfinite(one_by_one).mean())),
        row("find_optima, from recoveries", cold.costs, episodes, cold_seconds, float(cold.solved.mean())),
        row("find_optima, from a policy", warm.costs, episodes, warm_seconds, float(warm.solved.mean())),
    ]
    for each in rows:
        print(
            f"{each.solver:30s} {each.episodes:6d} episodes, {each.milliseconds:7.2f} ms each, {each.speedup:5.1f} times, "
            f"{each.solved:.2%} solved, {each.accurate:.2%} within 1e-4, at most {each.worst:.2%} above"
        )
    files.write_csv(out / "batched_optima.csv", [asdict(each) for each in rows])
    print(f"written to {out}")


if __name__ == "__main__":
    tyro.cli(main)
