"""Statistics over seeds and motions: interquartile means, profiles and paired improvements, each with its interval.

Samples are lists of arrays, one a motion, of one value a seed. Intervals are of 95 %, by the percentile bootstrap that
draws seeds again within each motion (stratified). A motion with a single seed has no interval, and so nothing with it.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from fmpjax.robustness import wilson

Samples = Sequence[np.ndarray]
RESAMPLES = 5000
CONFIDENCE = 0.95
_CUT = 0.25  # of the values, left out on either side


class Estimate(NamedTuple):
    """A figure and its 95 % interval; the interval is NaN where there is none."""

    value: float
    low: float
    high: float


def interquartile_mean(samples: Samples) -> Estimate:
    """Mean of the middle half of all values of all motions."""
    return _single(samples, lambda *parts, axis: stats.trim_mean(np.concatenate(parts, axis), _CUT, axis))


def mean(samples: Samples) -> Estimate:
    """Mean of all values of all motions."""
    return _single(samples, lambda *parts, axis: np.concatenate(parts, axis).mean(axis))


def share(samples: Samples) -> Estimate:
    """Mean of values from 0 to 1, of which an interquartile mean would make 0 or 1; Wilson's interval if all agree."""
    return _held(mean(samples), sum(map(len, samples)))


def profile(samples: Samples, thresholds: np.ndarray) -> list[Estimate]:
    """Share of the values that are at least each of the thresholds ``[K]``; Wilson's interval if all or none are."""
    above = [np.asarray(part) >= thresholds[:, None] for part in samples]  # [K, seeds] of each motion
    shares = _estimate(above, lambda *parts, axis: np.concatenate(parts, axis).mean(axis))
    count = sum(map(len, samples))
    return [_held(Estimate(*map(float, each)), count) for each in zip(*shares, strict=True)]


def improvement(ours: Samples, theirs: Samples) -> Estimate:
    """How often ours is more than theirs of the same seed and motion, a tie counting half; motions weigh the same.

    Where all pairs are alike, every resample is, too: the interval is then Wilson's of as many pairs.
    """
    pairs = zip(map(np.asarray, ours), map(np.asarray, theirs), strict=True)
    wins = [np.where(a == b, 0.5, a > b) for a, b in pairs]
    found = _single(wins, lambda *parts, axis: np.mean([part.mean(axis) for part in parts], axis=0))
    return _held(found, sum(map(len, wins)))


def sign_test(ours: Samples, theirs: Samples) -> float:
    """How likely as uneven wins are if neither is better: p of the exact two-sided sign test; ties are left out.

    Within a motion whose seeds all agree, the bootstrap sees no variance. This test counts pairs and does not need it.
    """
    off = np.concatenate([np.subtract(a, b) for a, b in zip(ours, theirs, strict=True)])
    wins, losses = int((off > 0).sum()), int((off < 0).sum())
    return float(stats.binomtest(wins, wins + losses).pvalue) if wins + losses else 1.0


def differs(estimate: Estimate, level: float = 0.5) -> bool:
    """Whether the interval leaves out a level; never without an interval."""
    return estimate.low > level or estimate.high < level


def _held(found: Estimate, count: int) -> Estimate:
    """An estimate of a share; Wilson's interval of ``count`` trials where no resample differs from another."""
    return Estimate(found.value, *wilson(found.value * count, count)) if found.low == found.high else found


def _single(samples: Samples, statistic: Callable) -> Estimate:
    """A statistic of samples of one value a seed; NaN where there are none."""
    if not samples or not all(len(part) for part in samples):
        return Estimate(math.nan, math.nan, math.nan)
    return Estimate(*map(float, _estimate(samples, statistic)))


def _estimate(samples: Samples, statistic: Callable) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A statistic of samples ``[..., seeds]`` and the ends of its intervals, each ``[...]``."""
    samples = [np.asarray(part, np.float64) for part in samples]
    value = np.asarray(statistic(*samples, axis=-1))
    if any(part.shape[-1] < 2 for part in samples):
        return value, np.full_like(value, np.nan), np.full_like(value, np.nan)
    found = stats.bootstrap(
        samples,
        statistic,
        axis=-1,
        vectorized=True,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return value, np.asarray(found.low), np.asarray(found.high)
