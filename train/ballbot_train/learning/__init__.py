"""Training of policies: demonstrations, learners, training runs, the Stable-Baselines3 adapter."""

from ballbot_gym.lazy import need

need(__name__, "torch", "stable_baselines3", "minari", "tensorboard")

VALIDATION_EPISODES = 200
"""Episodes of the validation set, if a run does not ask for more; every run draws the same ones (`evaluation.fresh.draw`)."""
