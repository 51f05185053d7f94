"""RLlib: our environments under their ids, and what RLlib has trained as a policy that our evaluation takes.

RLlib pins an older Gymnasium than this package tests with. Both work with that version; `pip install "ballbot-gym[rllib]"`
without constraints.txt installs it.
"""

from functools import partial
from typing import Any

import numpy as np

import ballbot_gym
from ballbot_gym.lazy import missing
from ballbot_gym.tasks import TASKS

try:
    import gymnasium
    import torch
    from ray.rllib.core.columns import Columns  # pyright: ignore[reportMissingImports]
    from ray.tune.registry import register_env  # pyright: ignore[reportMissingImports]
except ImportError as error:  # Ray without RLlib raises one without a name
    raise missing(__name__, error.name or str(error), "rllib") from error


def register() -> list[str]:
    """Makes the ids of all tasks known to RLlib, and says them.

    `env_config` holds keywords of `gymnasium.make`; the physics is the closed form by default.
    """
    ids = [task.id for task in TASKS.values()]
    for each in ids:
        register_env(each, partial(_make, each))
    return ids


def _make(id: str, settings: Any) -> Any:
    """The environment of an id, on whichever machine an env runner works."""
    assert id in gymnasium.registry, ballbot_gym.__name__  # importing it registers the ids
    return gymnasium.make(id, **{"physics": "rk4", **settings})


class RllibPolicy:
    """The deterministic policy of an algorithm, for `evaluate` and `evaluate_fresh`.

    Checkpoints of RLlib hold pickles, which run code when they are read. So none is read here: `Algorithm.from_checkpoint`
    reads one that you trust.
    """

    def __init__(self, trained: Any):
        """Args: trained: an algorithm of RLlib's present API, or its RLModule."""
        module = trained.get_module() if hasattr(trained, "get_module") else trained
        self._module: Any = module
        self._distribution: Any = module.get_inference_action_dist_cls()
        self.observation_space, self.action_space = module.observation_space, module.action_space

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, None]:
        """Actions (..., 2) in [−1, 1] for observations (..., no); the other arguments change nothing."""
        batch = np.atleast_2d(np.asarray(observation, np.float32))
        with torch.no_grad():
            made = self._module.forward_inference({Columns.OBS: torch.as_tensor(batch)})
            action = self._distribution.from_logits(made[Columns.ACTION_DIST_INPUTS]).to_deterministic().sample()
        return np.clip(action.numpy(), -1, 1).reshape(*np.shape(observation)[:-1], -1), None
