"""Training of policies: demonstrations, learners, training runs, the Stable-Baselines3 adapter."""
