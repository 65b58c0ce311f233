"""Bootstrap confidence intervals over episodes."""

from typing import NamedTuple

import numpy as np
from scipy import stats

from fusion_gym.arrays import Array

LEVEL = 0.95
RESAMPLES = 2000


class Interval(NamedTuple):
    """A mean with the ends of its confidence interval."""

    mean: float
    low: float
    high: float


def mean_interval(samples: Array, seed: int = 0, level: float = LEVEL) -> Interval:
    """Mean of the samples (episodes,) with a percentile bootstrap interval, by default of 95 %.

    A single episode, or episodes that all agree, have the interval [mean, mean]: nothing can be
    said about its width, and no width is invented.
    """
    mean = float(np.mean(samples))
    if len(samples) < 2 or float(np.ptp(samples)) == 0.0:
        return Interval(mean, mean, mean)
    result = stats.bootstrap(
        (samples,),
        np.mean,
        n_resamples=RESAMPLES,
        batch=200,
        confidence_level=level,
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    interval = result.confidence_interval
    return Interval(mean, float(interval.low), float(interval.high))
