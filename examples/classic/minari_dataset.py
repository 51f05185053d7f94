"""The optimum of Gymnasium's own environments as Minari datasets: python examples/classic/minari_dataset.py Pendulum-v1

The episodes are those of the seeds from 0, recorded in the environment itself. Minari normalizes scores between the mean
returns of random actions and of the optimum, both in these same episodes: `minari.get_normalized_score`.
"""

import itertools
from collections.abc import Iterable
from typing import Any

import gymnasium
import minari
import numpy as np
import tyro
from ballbot_classic import register
from ballbot_classic.replay import followed
from minari.data_collector import EpisodeBuffer

from ballbot_baselines import certified_optimum, find_optimum
from ballbot_gym import TASKS, BallbotEnv


def recorded(env: gymnasium.Env, actions: Iterable[np.ndarray], seed: int) -> EpisodeBuffer:
    """The episode of a seed under actions (n, m), or under fewer if it ends before."""
    observation, _ = env.reset(seed=seed)
    steps: list[tuple[Any, ...]] = []
    seen = [observation]
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        seen.append(observation)
        steps.append((action, reward, terminated, truncated))
        if terminated or truncated:
            break
    taken, rewards, terminations, truncations = (np.array(each) for each in zip(*steps, strict=True))
    return EpisodeBuffer(
        seed=seed,
        observations=np.array(seen),
        actions=taken,
        rewards=rewards,
        terminations=terminations,
        truncations=truncations,
    )


def random_return(env: gymnasium.Env, seed: int) -> float:
    """The return of random actions in the episode of a seed."""
    env.action_space.seed(seed)
    return float(np.sum(recorded(env, (env.action_space.sample() for _ in itertools.count()), seed).rewards))


def main(id: str, /, episodes: int = 200, name: str | None = None) -> minari.MinariDataset:
    """Records the optimum of every episode.

    Args:
        id: of the environment, such as Pendulum-v1.
        episodes: how many, from that of seed 0.
        name: of the dataset; default ENVIRONMENT/optimum-v0, such as pendulum/optimum-v0.
    """
    register()
    env, optima = gymnasium.make(id), []
    (task,) = (name for name, kind in TASKS.items() if kind.counterpart == id)
    with BallbotEnv(id) as own:
        for seed in range(episodes):
            _, info = own.reset(seed=seed)
            problem = own.task, own.params, info["state"], info["constants"]
            optima.append(certified_optimum(*problem) or find_optimum(*problem, twice=True))
    dataset = minari.create_dataset_from_buffers(
        name or f"{id.rpartition('-')[0].lower()}/optimum-v0",
        [recorded(env, followed(task, optimum, seed), seed) for seed, optimum in enumerate(optima)],
        env,
        algorithm_name="optimum of ballbot-classic",
        ref_min_score=float(np.mean([random_return(env, seed) for seed in range(episodes)])),
        ref_max_score=float(own.task.survival_pay - np.mean([optimum.cost for optimum in optima])),
        description=f"The best motion known in each of the first {episodes} episodes of {id}, by seed.",
        requirements=["gymnasium>=1.1"],
    )
    scores = dataset.storage.metadata
    print(
        f"{dataset.id}: {episodes} episodes, scores from {scores['ref_min_score']:.2f} to {scores['ref_max_score']:.2f}"
    )
    return dataset


if __name__ == "__main__":
    tyro.cli(main)
