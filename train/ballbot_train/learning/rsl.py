"""rsl-rl on the batched environments: `OnPolicyRunner(RslVecEnv(BallbotBatch("stabilize", 4096)), config)`."""

from typing import TYPE_CHECKING, Any

import torch

from ballbot_gym.seeding import spawned
from ballbot_gym.vector.batch import BallbotBatch

if TYPE_CHECKING:
    from tensordict import TensorDict


class RslVecEnv:
    """A `BallbotBatch` with the interface of rsl-rl's `VecEnv`. Observations are the group "policy"."""

    def __init__(self, batch: BallbotBatch, seed: int = 0):
        """Starts an episode in every env.

        Args:
            batch: the envs.
            seed: seed of the run; runs with different seeds have no episodes in common.
        """
        self.batch, self.num_envs, self.device = batch, batch.num_envs, batch.device
        self.max_episode_length, self.num_actions = batch.task.steps, batch.params.action_size
        self.cfg: dict[str, Any] = {"task": batch.task.id, "num_envs": batch.num_envs}
        batch.reset(spawned(seed))

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """(B,) control steps taken in the running episodes. The runner sets them so that episodes end at different times."""
        assert self.batch.state is not None
        return self.batch.state.steps

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        assert self.batch.state is not None
        self.batch.state = self.batch.state._replace(steps=steps.long())

    def get_observations(self) -> "TensorDict":
        """The present observations."""
        assert self.batch.state is not None
        return self._grouped(self.batch.observe(self.batch.state))

    def step(self, actions: torch.Tensor) -> tuple["TensorDict", torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Observations, rewards (B,), ends (B,), and extras in which "time_outs" marks the ends that are truncations."""
        with torch.no_grad():
            result = self.batch.step(actions)
        ends = (result.terminated | result.truncated).long()
        return self._grouped(result.observation), result.reward, ends, {"time_outs": result.truncated}

    def _grouped(self, observation: torch.Tensor) -> "TensorDict":
        from tensordict import TensorDict  # it comes with rsl-rl

        return TensorDict({"policy": observation.contiguous()}, batch_size=[self.num_envs], device=self.device)
