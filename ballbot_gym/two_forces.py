"""The action of robots without wheels for robots with wheels."""

import math
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from ballbot_gym import omni
from ballbot_gym.checks import real_array
from ballbot_gym.env import BallbotEnv

_YAW_RATE = 2.0  # rad/s: how fast `TwoForces` turns the body back


class TwoForces(gymnasium.ActionWrapper):
    """Gives a robot with wheels the action of the others, (2,): a force Fx, Fy.

    Its unit is what the wheels together give in every direction at standstill, `omni.LEAST_FORCE` times the pull of one.
    The wheels' torque on the ball is that of a rolling robot. A small feedback holds the heading ψ at 0.
    """

    def __init__(self, env: gymnasium.Env):
        """Args: env: a `BallbotEnv` of a robot with wheels, wrapped or not."""
        super().__init__(env)
        ballbot: Any = env.unwrapped
        if not isinstance(ballbot, BallbotEnv) or ballbot.params.wheels is None:
            raise ValueError("TwoForces takes a BallbotEnv of a robot with wheels, as robot='omni'")
        self._ballbot = ballbot
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def action(self, action: np.ndarray) -> np.ndarray:
        """The wheels' action (3,) for an action (2,)."""
        params, x = self._ballbot.params, self._ballbot.get_state().x
        force = (
            omni.LEAST_FORCE * params.force_limit * real_array(action, "action", (2,)).astype(np.float64).clip(-1, 1)
        )
        yaw_torque = -params.axial_inertia * (_YAW_RATE**2 * math.sin(x[8]) + 2 * _YAW_RATE * x[9])
        return np.array(omni.wheel_forces(params, x, tuple(force.tolist()), yaw_torque)) / params.force_limit
