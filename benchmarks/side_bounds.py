"""Lower bounds of the cost of each choice of sides in a slalom, with the costs themselves and those of `sides.predict`.

An episode that passes all obstacles on given sides also passes one or two of them on theirs. So the optimum without the
other obstacles costs no more. The highest optimum of these relaxed problems is a lower bound for the choice. A choice is
pruned if its bound is above the best cost found. The bounds are as global as the optima of the relaxed problems, which have
few obstacles.

Every choice is solved from its own path. It writes side_bounds.csv with a line for each choice of each episode.
"""

import itertools
import time
from pathlib import Path

import numpy as np
import tyro

from ballbot_baselines import find_optimum
from ballbot_baselines.optimum import sides
from ballbot_gym import files
from ballbot_gym.robot import default_params
from ballbot_gym.rollout import PlanError
from ballbot_gym.tasks.paths import sides_passed
from ballbot_gym.tasks.weave import MAX_OBSTACLES, Weave

TASK, PARAMS = Weave(), default_params()
Choice = tuple[int, ...]


def cost_of(x0: np.ndarray, c: np.ndarray, kept: tuple[int, ...], choice: Choice) -> tuple[float, np.ndarray]:
    """The optimum that passes the kept obstacles on the chosen sides, without the others, and its path (n, 2).

    The cost is infinite where no such optimum is found.
    """
    goal, obstacles = Weave.split_constants(c)
    rows = [obstacles[i] for i in kept]
    fewer = np.concatenate([goal, *rows, *[rows[-1]] * (MAX_OBSTACLES - len(rows))])
    start = TASK.routed_path(x0, fewer, choice)
    try:
        found = find_optimum(TASK, PARAMS, x0, fewer, paths=[start])
    except PlanError:
        return np.inf, start
    path = found.trajectory.x[:, :2]
    passed = sides_passed(path, TASK.passed_obstacles(fewer))
    return (found.cost if found.is_optimal and passed == choice else np.inf), path


def lines_of(index: int, seed: int) -> list[dict[str, float | str]]:
    """A line for each choice of sides of a drawn episode."""
    x0, c = TASK.sample(np.random.default_rng([seed, index]), PARAMS)
    obstacles = TASK.passed_obstacles(c)
    every = tuple(range(len(obstacles)))
    choices: list[Choice] = [*itertools.product((-1, 1), repeat=len(every))]
    began = time.process_time()
    relaxed: dict[tuple[tuple[int, ...], Choice], float] = {
        (kept, chosen): cost_of(x0, c, kept, chosen)[0]
        for size in (1, 2)
        for kept in itertools.combinations(every, size)
        for chosen in itertools.product((-1, 1), repeat=size)
    }
    bounding = time.process_time() - began
    solved = {choice: cost_of(x0, c, every, choice) for choice in choices}
    solving = time.process_time() - began - bounding
    best = min(solved, key=lambda choice: solved[choice][0])
    prediction = sides.predict(TASK, PARAMS, x0[None], c[1:2], solved[best][1][None, :, 0], obstacles[None])
    predicted: dict[Choice, float] = {
        tuple(side): cost for side, cost in zip(prediction.sides.tolist(), prediction.costs[0], strict=True)
    }

    def bound(choice: Choice, size: int) -> float:
        # An optimum that was not found bounds nothing.
        costs = [
            relaxed[kept, tuple(choice[i] for i in kept)]
            for kept in itertools.combinations(every, min(size, len(every)))
        ]
        return max((cost for cost in costs if np.isfinite(cost)), default=0.0)

    return [
        {
            "episode": index,
            "obstacles": len(every),
            "choice": "".join("-+"[side > 0] for side in choice),
            "cost": solved[choice][0],
            "best": solved[best][0],
            "bound_of_one": bound(choice, 1),
            "bound_of_two": bound(choice, 2),
            "predicted": solved[best][0] + predicted[choice] - predicted[best],
            "seconds_of_bounds": bounding,
            "seconds_of_costs": solving,
        }
        for choice in choices
    ]


def main(episodes: int = 30, seed: int = 2026, out: Path = Path("runs/side_bounds")) -> None:
    """Bounds and solves every choice of sides.

    Args:
        episodes: drawn.
        seed: of the episodes.
        out: folder of the results.
    """
    lines: list[dict[str, float | str]] = []
    for index in range(episodes):
        lines += lines_of(index, seed)
        print(f"episode {index}: {len(lines)} choices", flush=True)
    files.write_csv(out / "side_bounds.csv", lines)
    column = {name: np.array([line[name] for line in lines]) for name in lines[0] if name != "choice"}
    cost, best = column["cost"], column["best"]
    found, first = np.isfinite(cost), cost == best
    print(f"{len(lines)} choices in {episodes} episodes; an optimum was found for {found.sum()} of them")
    for name in ("bound_of_one", "bound_of_two"):
        bound = column[name]
        above, gap = (bound / cost - 1)[found].max(), (best / bound - 1)[first]
        print(
            f"{name}: at most {above:.4%} above the cost of its choice; prunes {(bound > best)[~first].mean():.1%} of the "
            f"others; the best choice costs {np.median(gap):.2%} more in the median, at most {gap.max():.2%}"
        )
    likely = column["predicted"] <= best * 1.01
    print(
        f"sides.predict leaves {likely.mean():.1%} of the choices to solve, and all that cost less than the best: ",
        end="",
    )
    print("yes" if likely[first].all() else "no")


if __name__ == "__main__":
    tyro.cli(main)
