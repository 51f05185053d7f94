"""PPO of RLlib on a ballbot with several env runners, on this machine or a cluster, measured by the regret of its policy.

Needs `pip install "ballbot-gym[rllib]"`, which installs an older Gymnasium: RLlib pins it, and both work with it.
"""

import time
from typing import Any

import gymnasium
import numpy as np
import tyro


def make(settings: Any) -> gymnasium.Env:
    """The environment on whichever machine an env runner works; `env_config` holds keywords of `gymnasium.make`."""
    return gymnasium.make(**{"physics": "rk4", **settings})


class RllibPolicy:
    """The deterministic policy of an algorithm, for `evaluate` and `evaluate_fresh`.

    Checkpoints of RLlib hold pickles, which run code when they are read. `Algorithm.from_checkpoint` reads one that you
    trust.
    """

    def __init__(self, trained: Any):
        """Args: trained: an algorithm of RLlib's present API."""
        self._module = trained.get_module()
        self._distribution = self._module.get_inference_action_dist_cls()
        self.observation_space, self.action_space = self._module.observation_space, self._module.action_space

    def predict(self, observation: np.ndarray, *_: object, **__: object) -> tuple[np.ndarray, None]:
        """Actions (..., 2) in [−1, 1] for observations (..., no)."""
        import torch
        from ray.rllib.core.columns import Columns

        batch = np.atleast_2d(np.asarray(observation, np.float32))
        with torch.no_grad():
            made = self._module.forward_inference({Columns.OBS: torch.as_tensor(batch)})
            action = self._distribution.from_logits(made[Columns.ACTION_DIST_INPUTS]).to_deterministic().sample()
        return np.clip(action.numpy(), -1, 1).reshape(*np.shape(observation)[:-1], -1), None


def main(
    task: str = "stabilize",
    iterations: int = 100,
    env_runners: int = 2,
    envs_per_runner: int = 8,
    batch: int = 8192,
    minibatch: int = 1024,
    epochs: int = 8,
    learning_rate: float = 1e-3,
    gamma: float = 0.995,
    every: int = 20,
    episodes: int = 200,
    physics: str | None = None,
    seed: int = 0,
    ray: str | None = None,
    save: str | None = None,
) -> None:
    """Trains and reports.

    Args:
        task: name of the task.
        iterations: of PPO.
        env_runners: processes that step environments.
        envs_per_runner: environments of each.
        batch: env steps of an iteration.
        minibatch: env steps of a gradient step.
        epochs: over the batch.
        learning_rate: step size.
        gamma: discount.
        every: iterations from one report to the next.
        episodes: certified episodes that are run in the end.
        physics: of those, "bullet", "mujoco" or "rk4"; default, the first that is installed.
        seed: of everything that is drawn.
        ray: address of a cluster whose nodes have ballbot-gym; default, a Ray of its own on this machine.
        save: folder of a checkpoint in the end.
    """
    import ray as cluster
    import torch
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.tune.registry import register_env

    from ballbot_gym import TASKS, spawned
    from ballbot_train import evaluate, evaluate_fresh

    # a network this small is slower on several threads, and many times slower if other programs run
    torch.set_num_threads(1)
    register_env("ballbot", make)
    if not cluster.is_initialized():
        small = (
            {} if ray else {"num_cpus": env_runners + 1, "object_store_memory": 200 * 2**20, "include_dashboard": False}
        )
        cluster.init(ray or "local", log_to_driver=False, logging_level="ERROR", **small)
    settings = (
        PPOConfig()
        .environment("ballbot", env_config={"id": f"ballbot_gym:{TASKS[task].id}"})
        .env_runners(num_env_runners=env_runners, num_envs_per_env_runner=envs_per_runner, num_cpus_per_env_runner=1)
        .training(
            train_batch_size_per_learner=batch,
            minibatch_size=minibatch,
            num_epochs=epochs,
            lr=learning_rate,
            gamma=gamma,
        )
        .debugging(seed=spawned(seed))
    )
    algorithm, began = settings.build_algo(), time.monotonic()
    for i in range(1, iterations + 1):
        algorithm.train()
        if i % every == 0 or i == iterations:
            row = evaluate_fresh(RllibPolicy(algorithm), task, episodes=200).summary()
            print(
                f"{i * batch:9,} steps, {(time.monotonic() - began) / 60:5.1f} min: success {row.success:6.1%}, "
                f"{row.failures:3} failures, cost {row.cost_median:8.2f} median",
                flush=True,
            )
    row = evaluate(RllibPolicy(algorithm), task, episodes, physics, name="rllib-ppo")
    print(f"certified episodes: success {row.success:.1%}, {row.falls} falls, mean regret {row.regret_mean:.1%}")
    if save is not None:
        algorithm.save_to_path(save)
    algorithm.stop()


if __name__ == "__main__":
    tyro.cli(main)
