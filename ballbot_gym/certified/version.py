"""The version of the benchmark: the episodes, costs, observations and optima that a regret refers to.

Certified sets, results and the leaderboard's rows hold the version, and those of another version are refused.
CONTRIBUTING.md says when this version changes, and when an id such as `BallbotTurn-v0` does.
"""

BENCHMARK = "1"
"""Raised whenever `digest` changes."""


def check(found: object, what: object, remedy: str) -> None:
    """Raises a ValueError where something is of another version of the benchmark."""
    if found != BENCHMARK:
        raise ValueError(
            f"{what} is of version {found!r:.40} of the benchmark, and this is version {BENCHMARK}; {remedy}"
        )


def digest() -> str:
    """Digest of the four shipped tasks with the paper's robot: episodes, costs, limits, observations and optima."""
    from ballbot_gym import certified
    from ballbot_gym.env import make_task
    from ballbot_gym.robot import PAPER, named_robot
    from ballbot_gym.tasks import SHIPPED, identity

    robot, parts = named_robot(PAPER), []
    for kind in SHIPPED:
        task, known = make_task(kind.id, PAPER), certified.load(kind.id, PAPER)
        numbers = [*known.states.ravel(), *known.constants.ravel(), *known.costs]
        parts.append([identity.problem_digest(task, robot), [f"{value:.9g}" for value in numbers]])
    return identity.digest(parts)
