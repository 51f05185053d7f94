"""How sure a mean is, and how tables write numbers."""

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Literal, NamedTuple

import numpy as np

CONFIDENCE = 0.95
RESAMPLES = 9999


def shown(value: float, form: str, unit: str = "") -> str:
    """A number of a table; a dash where there is none."""
    return format(value, form) + unit if math.isfinite(value) else "–"


class Interval(NamedTuple):
    """An interval in which the true value lies with the probability `CONFIDENCE`."""

    low: float
    high: float

    @classmethod
    def of_mean(cls, values: Sequence[float] | np.ndarray, seed: int = 0) -> "Interval":
        """The 95 % bootstrap interval of the mean, bias-corrected and accelerated (BCa).

        Args:
            values: (n,) one per episode.
            seed: of the resampling; the same values give the same interval.

        Returns:
            Both ends are the value itself where all are equal, and NaN for fewer than two values. Where BCa does not
            exist, as for nearly constant data, it is the percentile interval.
        """
        values = np.asarray(values, np.float64)
        if len(values) < 2:
            return cls(math.nan, math.nan)
        if np.ptp(values) == 0:
            return cls(float(values[0]), float(values[0]))
        count = len(values)
        rng = np.random.default_rng(seed)
        drawn = rng.integers(0, count, (RESAMPLES, count))
        means = values[drawn].mean(-1)
        low, high = np.quantile(means, _bca(values, means) or ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2))
        return cls(float(low), float(high))

    @classmethod
    def of_share(cls, count: int, total: int) -> "Interval":
        """The 95 % Wilson interval of a probability, from `count` successes in `total` independent tries."""
        z = NormalDist().inv_cdf((1 + CONFIDENCE) / 2)
        share, spread = count / total, z * z / total
        middle = (share + spread / 2) / (1 + spread)
        half = z / (1 + spread) * math.sqrt(share * (1 - share) / total + spread / (4 * total))
        return cls(0.0 if count == 0 else middle - half, 1.0 if count == total else middle + half)

    def text(self, value: float, sign: Literal["", "+"] = "") -> str:
        """A share in per cent with its interval, with plus signs if wanted; a dash where there is none."""
        ends = f" ({100 * self.low:{sign}.2f} to {100 * self.high:{sign}.2f})" if math.isfinite(self.low) else ""
        return shown(100 * value, f"{sign}.2f", " %") + ends


def _bca(values: np.ndarray, means: np.ndarray) -> tuple[float, float] | None:
    """Which quantiles of the resampled means bound the BCa interval; None where it does not exist.

    Source: Efron, "Better bootstrap confidence intervals", 1987.
    """
    normal, mean = NormalDist(), values.mean()
    below = ((means < mean).mean() + (means <= mean).mean()) / 2
    left_out = (values.sum() - values) / (len(values) - 1)
    apart = left_out.mean() - left_out
    spread = (apart**2).sum()
    if not 0 < below < 1 or spread == 0:
        return None
    bias = normal.inv_cdf(below)
    acceleration = (apart**3).sum() / (6 * spread**1.5)

    def quantile(share: float) -> float:
        moved = bias + normal.inv_cdf(share)
        return normal.cdf(bias + moved / (1 - acceleration * moved))

    return quantile((1 - CONFIDENCE) / 2), quantile((1 + CONFIDENCE) / 2)
