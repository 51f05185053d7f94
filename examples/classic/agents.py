"""PPO, SAC and TD3 of Stable-Baselines3 on Gymnasium's own environments, with the settings of RL Baselines3 Zoo, by regret.

    python examples/classic/agents.py train Pendulum-v1 ppo --seeds 0 1 2
    python examples/classic/agents.py measure Pendulum-v1
    python examples/classic/agents.py table runs/agents/Pendulum-v1.csv

Training needs Gymnasium and Stable-Baselines3 alone. Measuring needs the package `ballbot-classic`.
"""

import csv
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
import tyro
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import VecNormalize

from ballbot_gym import BallbotEnv, files
from ballbot_train import evaluate

AGENTS: dict[str, type[BaseAlgorithm]] = {"ppo": PPO, "sac": SAC, "td3": TD3}
WIDE = {"net_arch": [400, 300]}
# hyperparams/{ppo,sac,td3}.yml of rl_zoo3 2.9.2; with `normalize`, VecNormalize has the discount of the algorithm
SETTINGS: dict[tuple[str, str], dict[str, Any]] = {
    ("Pendulum-v1", "ppo"): {
        "n_timesteps": 100_000,
        "n_envs": 4,
        "n_steps": 1024,
        "gae_lambda": 0.95,
        "gamma": 0.9,
        "n_epochs": 10,
        "ent_coef": 0.0,
        "learning_rate": 1e-3,
        "clip_range": 0.2,
        "use_sde": True,
        "sde_sample_freq": 4,
    },
    ("Pendulum-v1", "sac"): {"n_timesteps": 20_000, "learning_rate": 1e-3},
    ("Pendulum-v1", "td3"): {
        "n_timesteps": 20_000,
        "gamma": 0.98,
        "buffer_size": 200_000,
        "learning_starts": 10_000,
        "noise": (NormalActionNoise, 0.1),
        "gradient_steps": 1,
        "train_freq": 1,
        "learning_rate": 1e-3,
        "policy_kwargs": WIDE,
    },
    ("MountainCarContinuous-v0", "ppo"): {
        "n_timesteps": 20_000,
        "normalize": True,
        "batch_size": 256,
        "n_steps": 8,
        "gamma": 0.9999,
        "learning_rate": 7.77e-05,
        "ent_coef": 0.00429,
        "clip_range": 0.1,
        "n_epochs": 10,
        "gae_lambda": 0.9,
        "max_grad_norm": 5,
        "vf_coef": 0.19,
        "use_sde": True,
        "policy_kwargs": {"log_std_init": -3.29, "ortho_init": False},
    },
    ("MountainCarContinuous-v0", "sac"): {
        "n_timesteps": 50_000,
        "learning_rate": 3e-4,
        "buffer_size": 50_000,
        "batch_size": 512,
        "ent_coef": 0.1,
        "train_freq": 32,
        "gradient_steps": 32,
        "gamma": 0.9999,
        "tau": 0.01,
        "learning_starts": 0,
        "use_sde": True,
        "policy_kwargs": {"log_std_init": -3.67, "net_arch": [64, 64], "use_expln": True},
    },
    ("MountainCarContinuous-v0", "td3"): {
        "n_timesteps": 300_000,
        "noise": (OrnsteinUhlenbeckActionNoise, 0.5),
        "gradient_steps": 1,
        "train_freq": 1,
        "learning_rate": 1e-3,
        "batch_size": 256,
        "policy_kwargs": WIDE,
    },
}


def trained(env: str, agent: str, seed: int, steps: int | None = None) -> BaseAlgorithm:
    """A model that was trained as the zoo trains it.

    Args:
        env: and agent: a key of `SETTINGS`.
        seed: of the environments and of the model.
        steps: environment steps; default, as published.
    """
    settings = dict(SETTINGS[env, agent])
    published, normalize = settings.pop("n_timesteps"), settings.pop("normalize", False)
    noise: tuple[Callable[..., ActionNoise], float] | None = settings.pop("noise", None)
    envs = make_vec_env(env, n_envs=settings.pop("n_envs", 1), seed=seed)
    if normalize:
        envs = VecNormalize(envs, gamma=settings["gamma"])
    if noise is not None:
        kind, std = noise
        size = envs.action_space.shape
        settings["action_noise"] = kind(mean=np.zeros(size), sigma=std * np.ones(size))
    model = AGENTS[agent]("MlpPolicy", envs, seed=seed, device="cpu", **settings)
    return model.learn(published if steps is None else steps)


def train(
    env: str, agent: str, /, seeds: tuple[int, ...] = (0,), out: Path = Path("runs/agents"), steps: int | None = None
) -> None:
    """Trains one model for each seed. Models that exist are kept.

    Args:
        env: id of the environment.
        agent: ppo, sac or td3.
        seeds: of the runs.
        out: folder of ENV-AGENT-SEED.zip, of the statistics of its VecNormalize (.pkl), and of what it took (.json).
        steps: environment steps; default, as published.
    """
    torch.set_num_threads(1)  # networks this small are slower on several threads
    out.mkdir(parents=True, exist_ok=True)
    for path, seed in ((out / f"{env}-{agent}-{seed}.zip", seed) for seed in seeds):
        if path.exists():
            continue
        begin = time.process_time()
        model = trained(env, agent, seed, steps)
        about = {"steps": model.num_timesteps, "cpu_seconds": round(time.process_time() - begin, 1)}
        normalization = model.get_vec_normalize_env()
        if normalization is not None:
            normalization.save(str(path.with_suffix(".pkl")))
        path.with_suffix(".json").write_text(json.dumps(about))
        model.save(path)
        print(f"{path}: {about}", flush=True)


def loaded(path: Path, env: str, agent: str) -> BaseAlgorithm:
    """A model of `train`, with its normalization of observations."""
    statistics, envs = path.with_suffix(".pkl"), make_vec_env(env)
    return AGENTS[agent].load(path, VecNormalize.load(str(statistics), envs) if statistics.exists() else envs, "cpu")


def acts_at_random(env: str) -> Callable[[np.ndarray], np.ndarray]:
    """A policy that draws every action of an environment, with equal chance."""
    space = gymnasium.make(env).action_space
    space.seed(0)
    return lambda _: space.sample()


def by_hand(env: str) -> dict[str, Any]:
    """Controllers without learning, by name, that act on an environment."""
    known: dict[str, Any] = {"random": acts_at_random(env), "lqr": "lqr", "nmpc": "nmpc"}
    if env == "Pendulum-v1":
        from ballbot_classic.pendulum import EnergyShaping

        with BallbotEnv(env) as own:
            known["energy shaping"] = EnergyShaping(own.task, own.params)
    if env == "MountainCarContinuous-v0":
        known["along the speed"] = lambda observation: np.sign(observation[1:])  # with all of the force
    return known


def measure(
    env: str, /, out: Path = Path("runs/agents"), episodes: int = 200, controllers: tuple[str, ...] | None = None
) -> None:
    """Measures the models of `train` and other controllers on certified episodes, and writes ENV.csv. Its rows are kept.

    | column | meaning |
    |---|---|
    | return_mean | mean return of the episodes |
    | gap_mean | optimum − return, mean |
    | regret | mean gap over the mean cost of the optimum |
    | regret_median | median over the episodes of cost / cost of the optimum − 1 |

    Args:
        env: id of the environment.
        out: folder of the models, and of the table.
        episodes: certified episodes: those of the seeds from 0.
        controllers: others to measure; default, all.
    """
    with BallbotEnv(env) as own:
        pay, others = own.task.survival_pay, by_hand(env)
    entries: list[tuple[str, str, Any, dict[str, Any]]] = [
        (each, "", others[each], {}) for each in (others if controllers is None else controllers)
    ]
    for agent in AGENTS:
        for path in sorted(out.glob(f"{env}-{agent}-*.zip")):
            about = json.loads(path.with_suffix(".json").read_text())
            entries.append((agent, path.stem.rpartition("-")[2], loaded(path, env, agent), about))
    data = out / f"{env}.csv"
    rows: list[dict[str, Any]] = list(csv.DictReader(data.open())) if data.exists() else []
    known = {(row["agent"], row["seed"]) for row in rows}
    for agent, seed, policy, about in (entry for entry in entries if entry[:2] not in known):
        row = evaluate(policy, env, episodes, physics="rk4", name=agent)
        best = row.cost_mean - row.excess_mean
        of = {"env": env, "agent": agent, "seed": seed}
        of |= {"steps": about.get("steps", ""), "cpu_seconds": about.get("cpu_seconds", ""), "episodes": episodes}
        figures = {
            "return_mean": pay - row.cost_mean,
            "gap_mean": row.excess_mean,
            "regret": row.excess_mean / best,
            "regret_median": row.regret_median,
            "success": row.success,
        }
        if not rows:
            optimum = {"return_mean": pay - best, "gap_mean": 0.0, "regret": 0.0, "regret_median": 0.0}
            rows.append({**of, "agent": "optimum", **_rounded(optimum), "success": ""})
        rows.append({**of, **_rounded(figures)})
        print(rows[-1], flush=True)
        files.write_csv(data, rows)


def _rounded(figures: dict[str, float]) -> dict[str, str]:
    return {name: f"{value:.4f}" for name, value in figures.items()}


_SHOWN = {
    "mean return": ("return_mean", "{:.2f}"),
    "below the optimum": ("gap_mean", "{:.2f}"),
    "regret": ("regret", "{:.1%}"),
    "median regret": ("regret_median", "{:.1%}"),
}
"""Columns of a page's table: the column of the data, and its form."""


def table(path: Path, /) -> None:
    """Prints a table of `measure` in Markdown, with the range over seeds, the best agent first."""
    print(markdown(path))


def markdown(path: Path) -> str:
    """What `table` prints."""
    agents: dict[str, list[dict[str, str]]] = {}
    for row in csv.DictReader(path.open()):
        agents.setdefault(row["agent"], []).append(row)
    lines = [f"| agent | seeds | {' | '.join(_SHOWN)} |", f"|---|---|{'---|' * len(_SHOWN)}"]
    for agent, rows in sorted(agents.items(), key=lambda entry: min(float(row["gap_mean"]) for row in entry[1])):
        cells = []
        for column, form in _SHOWN.values():
            values = sorted(float(row[column]) for row in rows)
            shown = dict.fromkeys(form.format(value).replace("%", " %") for value in (values[0], values[-1]))
            cells.append(" to ".join(shown).replace("-", "−"))
        lines.append(f"| {agent} | {len(rows) if rows[0]['seed'] else ''} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"train": train, "measure": measure, "table": table})
