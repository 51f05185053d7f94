"""How sure a mean is, and whether one result is better than another."""

import math
import warnings
from collections.abc import Sequence
from typing import Literal

import numpy as np

Verdict = Literal["better", "worse", "cannot tell"]

CONFIDENCE = 0.95
RESAMPLES = 9999


def interval(values: Sequence[float] | np.ndarray, seed: int = 0) -> tuple[float, float]:
    """The 95 % bootstrap interval of the mean, bias-corrected and accelerated (BCa).

    Args:
        values: (n,) one per episode.
        seed: of the resampling; the same values give the same interval.

    Returns:
        Low and high; both the value itself where all are equal, NaN for fewer than two values. Where BCa does not exist,
        as for nearly constant data, the percentile interval.
    """
    values = np.asarray(values, np.float64)
    if len(values) < 2:
        return math.nan, math.nan
    if np.ptp(values) == 0:
        return float(values[0]), float(values[0])
    from scipy import stats  # slow to import

    for method in ("BCa", "percentile"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # degenerate data make SciPy warn; they are looked for below
            result = stats.bootstrap(
                (values,),
                np.mean,
                confidence_level=CONFIDENCE,
                n_resamples=RESAMPLES,
                method=method,
                rng=np.random.default_rng(seed),
            ).confidence_interval
        if math.isfinite(result.low) and math.isfinite(result.high):
            break
    return float(result.low), float(result.high)


def share_interval(count: int, total: int) -> tuple[float, float]:
    """The 95 % Wilson interval of a probability, from `count` successes in `total` independent tries."""
    from scipy import stats  # slow to import

    found = stats.binomtest(count, total).proportion_ci(CONFIDENCE, method="wilson")
    return float(found.low), float(found.high)


def verdict(low: float, high: float, margin: float) -> Verdict:
    """What the interval of a difference says where more is better; differences up to the margin decide nothing."""
    if low > margin:
        return "better"
    if high < -margin:
        return "worse"
    return "cannot tell"
