"""The version of the benchmark: the episodes, costs, observations and optima that a regret refers to.

Certified sets, results and the leaderboard's rows hold the version, and those of another version are refused.
CONTRIBUTING.md says when this version changes, and when an id such as `BallbotTurn-v0` does.
"""

BENCHMARK = "2"
"""Increased whenever an episode, a cost, a limit, an observation or an optimum changes; a test compares a digest of all."""


def check(found: object, what: object, remedy: str) -> None:
    """Raises a ValueError where something is of another version of the benchmark."""
    if found != BENCHMARK:
        raise ValueError(
            f"{what} is of version {found!r:.40} of the benchmark, and this is version {BENCHMARK}; {remedy}"
        )
