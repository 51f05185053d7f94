"""Many ballbots at once: `BallbotVectorEnv`, and what computes its steps in machine code, in torch or in NumPy."""

from ballbot_gym.vector.env import BallbotVectorEnv

__all__ = ["BallbotVectorEnv"]
