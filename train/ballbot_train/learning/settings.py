"""Settings of learners: frozen dataclasses whose numbers state their range on the field."""

import math
from dataclasses import dataclass, field, fields
from typing import Any

from ballbot_gym.checks import MOST_ENVS

__all__ = ["MOST", "MOST_ENVS", "Settings", "number"]

MOST = 10**9
"""The largest number of iterations, steps and the like."""
_MOST_STEPS = 10**8  # env steps of an iteration, which are all in memory


def number(default: Any, least: float = -math.inf, most: float = math.inf, above: float | None = None) -> Any:
    """A field for a number, or for a tuple of numbers, in a range.

    Args:
        default: its default.
        least: the smallest value.
        most: the largest value.
        above: instead of `least`, what the value must exceed.
    """
    return field(default=default, metadata={"least": least, "most": most, "above": above})


def _check(name: str, value: float, least: float, most: float, above: float | None) -> None:
    finite = isinstance(value, int) or math.isfinite(value)
    if finite and least <= value <= most and (above is None or value > above):
        return
    if above is not None:
        wanted = f"finite and {'positive' if above == 0 else f'above {above:g}'}"
    elif math.isfinite(least) and math.isfinite(most):
        wanted = f"{least} to {most}"
    else:
        wanted = f"finite and at least {least:g}" if math.isfinite(least) else "finite"
    raise ValueError(f"{name} must be {wanted}, not {value}")


@dataclass(frozen=True)
class Settings:
    """Base class of settings, the learners' among them."""

    def check(self) -> None:
        """Raises a ValueError that names the first setting that makes no sense."""
        for each in fields(self):
            if each.metadata:
                value = getattr(self, each.name)
                for one in value if isinstance(value, tuple) else [value]:
                    _check(each.name, one, **each.metadata)

    @staticmethod
    def check_memory(num_envs: int, steps: int) -> None:
        """Raises a ValueError where an iteration has more env steps than fit into memory."""
        if num_envs * steps > _MOST_STEPS:
            raise ValueError(
                f"{num_envs} envs of {steps} steps are {num_envs * steps} env steps per iteration, and at most {_MOST_STEPS} "
                "are kept in memory; take fewer of either"
            )
