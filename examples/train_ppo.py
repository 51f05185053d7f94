"""Plain PPO of Stable-Baselines3 on a ballbot, with settings as options, and what it does on fresh episodes as it learns.

Settings that are not given are Stable-Baselines3's defaults. `--learning-rate 1e-3 --falling` falls linearly to 0.
"""

import time

import gymnasium
import torch
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

import ballbot_gym  # noqa: F401
from ballbot_train import BallbotVecEnv, evaluate_fresh


class Report(BaseCallback):
    """Prints what the policy does on 200 fresh episodes, at the beginning of the first rollout after each `every` steps."""

    def __init__(self, task: str, every: int):
        super().__init__()
        self._task, self._every, self._next, self._began = task, every, every, time.process_time()

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self._next:
            self._next += self._every
            self.show()

    def _on_step(self) -> bool:
        return True

    def show(self) -> None:
        """Prints a line."""
        row = evaluate_fresh(self.model, self._task, episodes=200).summary()
        std = self.model.policy.log_std.exp().mean().item()
        print(
            f"{self.num_timesteps:9,} steps, {(time.process_time() - self._began) / 60:5.1f} min of CPU: success "
            f"{row.success:6.1%}, {row.failures:3} failures, cost {row.cost_median:8.2f} median, std parameter {std:.3f}",
            flush=True,
        )


def main(
    task: str = "stabilize",
    steps: int = 3_000_000,
    envs: int = 8,
    seed: int = 0,
    every: int = 250_000,
    learning_rate: float | None = None,
    falling: bool = False,
    n_steps: int | None = None,
    batch_size: int | None = None,
    n_epochs: int | None = None,
    gamma: float | None = None,
    gae_lambda: float | None = None,
    ent_coef: float | None = None,
    clip_range: float | None = None,
    target_kl: float | None = None,
    use_sde: bool = False,
    log_std_init: float | None = None,
    net_arch: tuple[int, ...] | None = None,
    relu: bool = False,
    save: str | None = None,
) -> None:
    """Trains and reports.

    Args:
        task: name of the task.
        steps: env steps in all.
        envs: number of environments that are stepped at once, in the closed-form physics.
        seed: seed of everything that is drawn.
        every: env steps from one report to the next.
        learning_rate: step size.
        falling: the step size falls linearly to 0.
        n_steps, batch_size, n_epochs, gamma, gae_lambda, ent_coef, clip_range, target_kl, use_sde: of PPO.
        log_std_init, net_arch, relu: parts of policy_kwargs, which is one setting of PPO.
        save: path of the model in the end, for `ballbot evaluate PATH.zip`.
    """
    # a network this small is slower on several threads, and many times slower if other programs run
    torch.set_num_threads(1)
    if falling and learning_rate is None:
        raise ValueError("--falling needs --learning-rate, the step size at the start")
    policy = {"log_std_init": log_std_init, "net_arch": None if net_arch is None else list(net_arch)}
    policy |= {"activation_fn": torch.nn.ReLU if relu else None}
    policy = {name: value for name, value in policy.items() if value is not None}
    settings = {
        "learning_rate": (lambda left: learning_rate * left) if falling else learning_rate,
        "n_steps": n_steps,
        "batch_size": batch_size,
        "n_epochs": n_epochs,
        "gamma": gamma,
        "gae_lambda": gae_lambda,
        "ent_coef": ent_coef,
        "clip_range": clip_range,
        "target_kl": target_kl,
        "use_sde": use_sde or None,
        "policy_kwargs": policy or None,
    }
    settings = {name: value for name, value in settings.items() if value is not None}
    print(f"{len(settings)} settings: {', '.join(settings) or 'none'}")
    id = f"Ballbot{task.capitalize()}-v0"
    venv = BallbotVecEnv(gymnasium.make_vec(id, num_envs=envs).unwrapped)
    report = Report(task, every)
    model = PPO("MlpPolicy", venv, seed=seed, device="cpu", **settings).learn(steps, callback=report)
    report.show()
    if save is not None:
        model.save(save)


if __name__ == "__main__":
    tyro.cli(main)
