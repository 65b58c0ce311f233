"""Bootstrap confidence intervals over episodes."""

from typing import NamedTuple

import numpy as np

from fusion_gym.arrays import Array

LEVEL = 0.95
RESAMPLES = 2000


class Interval(NamedTuple):
    """A mean with the ends of its confidence interval.

    Args:
        mean: mean of the samples.
        low: lower end.
        high: upper end.

    Example:
        >>> from fusion_gym.evaluation import Interval
        >>> Interval(mean=0.5, low=0.4, high=0.6).high
        0.6
    """

    mean: float
    low: float
    high: float


def mean_interval(samples: Array, seed: int = 0, level: float = LEVEL) -> Interval:
    """Return the mean of samples with its percentile bootstrap interval.

    A single sample, or equal samples, give the interval [mean, mean].

    Args:
        samples: one value per episode (E,).
        seed: seed of the resampling.
        level: confidence level, between 0 and 1.

    Returns:
        The mean and the ends of the interval, from 2,000 resamples.

    Example:
        >>> import numpy as np
        >>> from fusion_gym.evaluation import mean_interval
        >>> mean_interval(np.arange(10.0))
        Interval(mean=4.5, low=2.7, high=6.3)
    """
    mean = float(np.mean(samples))
    if len(samples) < 2 or float(np.ptp(samples)) == 0.0:
        return Interval(mean, mean, mean)
    from scipy import stats  # takes a third of a second

    low, high = stats.bootstrap(
        (samples,),
        np.mean,
        n_resamples=RESAMPLES,
        batch=200,
        confidence_level=level,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Interval(mean, float(low), float(high))
