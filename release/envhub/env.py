"""Ballbot tasks for LeRobot's EnvHub, which loads environments from `env.py` of a repository.

Needs `pip install ballbot-gym`. Every task is a vector environment in machine code, or of separate processes.
"""

import gymnasium

from ballbot_gym import TASKS


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> dict[str, dict[int, gymnasium.vector.VectorEnv]]:
    """The vector environments of all tasks.

    Args:
        n_envs: environments of each task.
        use_async_envs: whether each environment is a process of its own, with an engine that has contact. Otherwise all are
            computed at once in the closed form.

    Returns:
        {"ballbot": {0: Stabilize, 1: Turn, 2: Orbit, 3: Weave}}
    """
    mode = {"vectorization_mode": "async"} if use_async_envs else {}
    made = {i: gymnasium.make_vec(task.id, num_envs=n_envs, **mode) for i, task in enumerate(TASKS.values())}
    return {"ballbot": made}
