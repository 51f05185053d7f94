"""The table of agents on Pendulum-v1: Stable-Baselines3 with the hyperparameters of RL Baselines3 Zoo, beside controllers.

    python examples/classic/agents.py --out runs/agents

Every agent is trained in Gymnasium's own environment, for as many steps as the zoo publishes, and judged on the 200 episodes
of the seeds 0 to 199 by `ballbot_train.evaluate`. Models stay in the folder, and are not trained again.
"""

import argparse
from pathlib import Path
from typing import Any

import ballbot_classic
import gymnasium
import numpy as np
import torch
from ballbot_classic.pendulum import EnergyShaping
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise

from ballbot_gym import files, named_robot
from ballbot_gym.env import make_task
from ballbot_train import evaluate

ID = "Pendulum-v1"
CONTROLLERS = ("optimum", "nmpc", "lqr")


def _ppo(seed: int) -> Any:
    model = PPO(
        "MlpPolicy",
        make_vec_env(ID, n_envs=4, seed=seed),
        learning_rate=1e-3,
        n_steps=1024,
        gamma=0.9,
        gae_lambda=0.95,
        n_epochs=10,
        ent_coef=0.0,
        clip_range=0.2,
        use_sde=True,
        sde_sample_freq=4,
        seed=seed,
        device="cpu",
    )
    return model.learn(100_000)


def _sac(seed: int) -> Any:
    return SAC("MlpPolicy", gymnasium.make(ID), learning_rate=1e-3, seed=seed, device="cpu").learn(20_000)


def _td3(seed: int) -> Any:
    model = TD3(
        "MlpPolicy",
        gymnasium.make(ID),
        learning_rate=1e-3,
        buffer_size=200_000,
        learning_starts=10_000,
        gamma=0.98,
        train_freq=1,
        gradient_steps=1,
        action_noise=NormalActionNoise(np.zeros(1), 0.1 * np.ones(1)),
        policy_kwargs={"net_arch": [400, 300]},
        seed=seed,
        device="cpu",
    )
    return model.learn(20_000)


AGENTS = {"PPO": (PPO, _ppo, "100,000"), "SAC": (SAC, _sac, "20,000"), "TD3": (TD3, _td3, "20,000")}
"""Class, training, and the steps that it takes."""


def main() -> None:
    """Trains, judges, and writes table.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/agents"))
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    ballbot_classic.register()
    torch.set_num_threads(1)
    task, robot = make_task("pendulum"), named_robot("pendulum")
    lines = ["| | steps of training | mean return | median regret | regret of the mean cost |", "|---|---|---|---|---|"]
    acting: dict[str, tuple[Any, str]] = {name: (name, "") for name in CONTROLLERS}
    acting["energy shaping"] = (EnergyShaping(task, robot), "")
    for name, (kind, train, steps) in AGENTS.items():
        path = chosen.out / f"{name}-{chosen.seed}.zip"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            train(chosen.seed).save(path)
        acting[f"{name} of Stable-Baselines3"] = (kind.load(path, device="cpu"), steps)
    best = evaluate("optimum", ID, episodes=chosen.episodes).cost_mean
    for name, (policy, steps) in acting.items():
        row = evaluate(policy, ID, episodes=chosen.episodes, name=name.lower().replace(" ", "-"))
        cost = row.cost_mean
        lines.append(f"| {name} | {steps} | {-cost:.2f} | {row.regret_median:.2%} | {cost / best - 1:.2%} |")
    files.write(chosen.out / "table.md", "\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
