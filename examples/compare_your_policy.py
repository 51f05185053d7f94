"""Your own policy against LQR and trajectory optimization, by regret on the certified episodes.

A policy is a function from observation to action, a Stable-Baselines3 model, a Controller or a policy file.
"""

import numpy as np
import tyro

from ballbot_train import evaluate

GAIN = np.array([[0.3, 0, 1.3, 0, 0.7, 0, 1.3, 0], [0, 0.3, 0, 1.3, 0, 0.7, 0, 1.3]])


def mine(observation: np.ndarray) -> np.ndarray:
    """Action in [−1, 1]², in units of 350 N, for an observation of Stabilize: scaled position, lean, velocity, lean rate."""
    return np.clip(GAIN @ observation, -1, 1)


def main(task: str = "stabilize", episodes: int = 20) -> None:
    """Prints one leaderboard row each."""
    for policy in (mine, "lqr", "trajopt"):
        print(evaluate(policy, task, episodes))


if __name__ == "__main__":
    tyro.cli(main)
