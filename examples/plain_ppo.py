"""Plain PPO of Stable-Baselines3 on `gymnasium.make("BallbotStabilize-v0")`, with three of its settings changed.

An observation wrapper appends tanh(20 o) to the observation o, which makes small errors large. Without it the robot comes to
rest near the goal, but not in it. Episodes in training last 4 s instead of 8, so that more of the samples are from starts.
Episodes in the evaluation have their full length.
"""

import gymnasium
import numpy as np
import torch
import tyro
from gymnasium.wrappers import TransformObservation
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

import ballbot_gym  # noqa: F401
from ballbot_gym import spawned
from ballbot_train import evaluate_fresh


def fine(observation: np.ndarray) -> np.ndarray:
    """(..., 16): observations (..., 8), followed by the same observations with small values made large."""
    return np.concatenate([observation, np.tanh(20 * observation)], -1)


def make() -> gymnasium.Env:
    """The env, in the closed-form physics."""
    env = gymnasium.make("BallbotStabilize-v0", physics="rk4", max_episode_steps=200)
    return TransformObservation(env, fine, gymnasium.spaces.Box(-np.inf, np.inf, (16,), np.float32))


class Seen:
    """A model that sees observations of the env as `fine` shows them."""

    def __init__(self, model: PPO):
        self.model = model

    def predict(self, observation: np.ndarray, *args: object, **options: object) -> tuple[np.ndarray, None]:
        """Actions (..., 2) for observations (..., 8), without noise."""
        return self.model.predict(fine(observation), deterministic=True)[0], None


def main(steps: int = 3_000_000, seed: int = 0, episodes: int = 1000) -> None:
    """Trains, and prints what the policy does on fresh episodes.

    Args:
        steps: env steps in all.
        seed: of everything that is drawn.
        episodes: fresh episodes in the end.
    """
    # a network this small is slower on several threads, and many times slower if other programs run
    torch.set_num_threads(1)
    settings = {"learning_rate": lambda left: 2e-3 * left, "batch_size": 2048, "ent_coef": 0.03}
    model = PPO("MlpPolicy", make_vec_env(make, n_envs=8), seed=spawned(seed), device="cpu", **settings).learn(steps)
    row = evaluate_fresh(Seen(model), "stabilize", episodes=episodes).summary()
    print(f"success {row.success:.1%}, {row.failures} failures in {episodes}, cost {row.cost_median:.2f} in the median")


if __name__ == "__main__":
    tyro.cli(main)
