"""PPO of Stable-Baselines3 on Stabilize, a few minutes of one core: python examples/plain_ppo.py

Three parts matter. The actor is odd: layers of tanh without biases give opposite forces in opposite states, and no force at
the goal, so the robot does not rest next to it. The critic sees products of observations, because the cost to go is nearly a
quadratic form. The standard deviation of the actions stays the same, because a learned one falls before the policy is good.
"""

import time

import gymnasium
import torch
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

import ballbot_gym  # noqa: F401
from ballbot_train import BallbotVecEnv, evaluate

STEPS = 15_360_000
"""Env steps in all: 600 rollouts."""


class Products(nn.Module):
    """The products of all pairs of observed quantities: (n, 8) to (n, 64)."""

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return torch.einsum("ni,nj->nij", observations, observations).flatten(1)


class OddPolicy(ActorCriticPolicy):
    """An actor that is odd, and a critic that sees products."""

    def _build_mlp_extractor(self) -> None:
        super()._build_mlp_extractor()
        actor = nn.Linear(8, 32, bias=False), nn.Tanh(), nn.Linear(32, 32, bias=False), nn.Tanh()
        critic = Products(), nn.Linear(64, 32), nn.Tanh(), nn.Linear(32, 32), nn.Tanh()
        self.mlp_extractor.policy_net, self.mlp_extractor.value_net = nn.Sequential(*actor), nn.Sequential(*critic)


def train(steps: int, seed: int) -> PPO:
    """A model that was trained for a number of control steps, on episodes of 2 s."""
    # the reward times 0.02, and that for survival times 0.01: the optimum is the same, and networks learn such values soonest
    scaled = {"survival_reward": 1.0, "position_weight": 0.02, "rest_weight": 0.01, "effort_weight": 1e-5}
    envs = gymnasium.make_vec("BallbotStabilize-v0", num_envs=256, max_episode_steps=100, **scaled)
    model = PPO(
        OddPolicy,
        BallbotVecEnv(envs.unwrapped),
        learning_rate=lambda left: 3e-3 * left,
        n_steps=100,
        batch_size=1600,
        n_epochs=5,
        gamma=0.995,
        gae_lambda=0.9,
        policy_kwargs={"net_arch": [32, 32], "log_std_init": -2.0},
        seed=seed,
        device="cpu",
    )
    model.policy.value_net.bias.data.fill_(4.0)  # what survival is worth: 1 a second, 0.02 s a step, gamma
    for fixed in (model.policy.action_net.bias, model.policy.log_std):
        fixed.requires_grad_(False)
    return model.learn(steps)


def main(steps: int = STEPS, seed: int = 0, episodes: int = 200) -> None:
    """Trains, and prints what the policy does on certified episodes.

    Args:
        steps: env steps in all.
        seed: of everything that is drawn.
        episodes: certified episodes in the end.
    """
    torch.set_num_threads(1)  # a network this small is slower on several threads
    begin = time.process_time()
    model = train(steps, seed)
    seconds = time.process_time() - begin
    row = evaluate(model, "stabilize", episodes)
    print(
        f"{seconds:.0f} s: success {row.success:.1%}, {row.falls} failures in {episodes}, "
        f"{row.near:.1%} in the goal or near it, mean regret {row.regret_mean:.1%}, median {row.regret_median:.1%}"
    )


if __name__ == "__main__":
    tyro.cli(main)
