"""Plain PPO of Stable-Baselines3 on Stabilize, five minutes of one core: python examples/plain_ppo.py

The policy's features are the observation o and tanh(20 o), in which small errors are large. Without them the robot comes to
rest near the goal, but not in it. The standard deviation of the actions falls on a schedule, because a learned one falls long
before the policy is good. Gradients are not clipped, because those of the values are large.
"""

import time

import gymnasium
import numpy as np
import torch
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

import ballbot_gym  # noqa: F401
from ballbot_train import BallbotVecEnv, evaluate


class Fine(BaseFeaturesExtractor):
    """Observations (n, 8), and the same with small values enlarged: (n, 16)."""

    def __init__(self, space: gymnasium.spaces.Box):
        super().__init__(space, features_dim=2 * space.shape[0])

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return torch.cat([observations, torch.tanh(20 * observations)], dim=1)


class LessNoise(BaseCallback):
    """The standard deviation of the actions falls geometrically from 0.15 to 0.03."""

    def _on_rollout_start(self) -> None:
        left = self.model._current_progress_remaining
        self.model.policy.log_std.data.fill_(np.log(0.03) + left * np.log(0.15 / 0.03))

    def _on_step(self) -> bool:
        return True


def train(steps: int, seed: int) -> PPO:
    """A model that was trained for a number of control steps, on episodes of 4 s."""
    # A smaller reward for survival makes the values small, which the critic learns sooner. It moves no optimum.
    made = gymnasium.make_vec("BallbotStabilize-v0", num_envs=128, max_episode_steps=200, survival_reward=30.0)
    model = PPO(
        "MlpPolicy",
        BallbotVecEnv(made.unwrapped),
        learning_rate=lambda left: 2e-3 * left,
        n_steps=96,
        batch_size=1536,
        n_epochs=5,
        gae_lambda=0.97,
        max_grad_norm=1000.0,
        policy_kwargs={"features_extractor_class": Fine},
        seed=seed,
        device="cpu",
    )
    return model.learn(steps, LessNoise())


def main(steps: int = 4_900_000, seed: int = 0, episodes: int = 200) -> None:
    """Trains, and prints what the policy does on certified episodes.

    Args:
        steps: env steps in all.
        seed: of everything that is drawn.
        episodes: certified episodes in the end.
    """
    torch.set_num_threads(1)  # a network this small is slower on several threads
    begin = time.process_time()
    model = train(steps, seed)
    row = evaluate(model, "stabilize", episodes)
    print(
        f"{time.process_time() - begin:.0f} s: success {row.success:.1%}, {row.falls} failures in {episodes}, "
        f"{row.near:.1%} in the goal or near it, mean regret {row.regret_mean:.1%}, median {row.regret_median:.1%}"
    )


if __name__ == "__main__":
    tyro.cli(main)
