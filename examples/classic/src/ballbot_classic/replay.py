"""Replays optima in the environments of Gymnasium that pose the same problem as their tasks.

python -m ballbot_classic.replay Pendulum-v1
"""

import sys
from typing import Any

import gymnasium
import numpy as np

from ballbot_baselines import Optimum, certified_optimum, find_optimum
from ballbot_gym import TASKS, named_robot


def followed(task: str, optimum: Optimum, seed: int, env: gymnasium.Env | None = None) -> np.ndarray:
    """The actions (n, m), float32, of the optimum with its feedback in Gymnasium's environment.

    Without feedback the rounding of actions to float32 would grow: a state near an upright pendulum leaves it exponentially.
    The deviations that the feedback corrects are of the size of that rounding, so they do not show in the return.

    Args:
        task: name of a task with a `counterpart`.
        optimum: of the episode that the counterpart draws from the seed.
        seed: of `reset`.
        env: the counterpart; default, a new one.

    Returns:
        what to give to `returned`, in the counterpart's units.
    """
    problem = TASKS[task]()
    limit = named_robot(problem.ROBOT).force_limit
    env = gymnasium.make(problem.counterpart) if env is None else env
    env.reset(seed=seed)
    space: Any = env.action_space
    taken, done = [], False
    for x, u, gain in zip(optimum.trajectory.x, optimum.trajectory.u, optimum.gains, strict=False):
        state, _ = problem.counterpart_state(env.unwrapped)
        action = np.clip((u - gain @ (state - x)) / limit, -1, 1) * space.high
        taken.append(action.astype(np.float32))
        *_, terminated, truncated, _ = env.step(taken[-1])
        done = terminated or truncated
        if done:
            break
    return np.array(taken)


def returned(id: str, actions: np.ndarray, seed: int, env: gymnasium.Env | None = None) -> tuple[float, bool, bool]:
    """The return of actions (n, m) in a counterpart, and whether it terminated and was truncated at the last of them."""
    env = gymnasium.make(id) if env is None else env
    env.reset(seed=seed)
    total, terminated, truncated = 0.0, False, False
    for action in actions:
        _, reward, terminated, truncated, _ = env.step(action)
        total += float(reward)
    return total, terminated, truncated


def main(id: str, episodes: int = 200) -> float:
    """Replays the certified optima of the seeds from 0 on, and prints how far their returns are from the promised ones.

    Args:
        id: of the counterpart.
        episodes: how many.

    Returns:
        the largest difference, relative to the promised return.
    """
    name, kind = next((name, kind) for name, kind in TASKS.items() if kind.counterpart == id)
    task, robot, off = kind(), named_robot(kind.ROBOT), np.zeros(episodes)
    for seed in range(episodes):
        x, c = task.sample(np.random.default_rng(seed), robot)
        optimum = certified_optimum(task, robot, x, c) or find_optimum(task, robot, x, c)
        promised = task.survival_pay - optimum.cost
        earned, *_ = returned(id, followed(name, optimum, seed), seed)
        off[seed] = abs(earned - promised) / abs(promised)
    print(
        f"{id}: {episodes} seeds, relative differences of returns: median {np.median(off):.1e}, at most {off.max():.1e}"
    )
    return float(off.max())


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
