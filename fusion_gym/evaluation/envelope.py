"""The lower envelope of many policies in the plane of transmission rate and error."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fusion_gym.core.scale import lower_hull
from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.evaluation.metrics import Interval, check_pair, mean_interval
from fusion_gym.validation import ConfigurationError

FAR_APART = 1.5


class EnvelopePoint(NamedTuple):
    """A policy on the envelope, with its means over episodes.

    Args:
        name: name of the policy.
        rate: transmissions per sensor and step.
        mse: squared error per step, summed over states, in squared units of the states.

    Example:
        >>> from fusion_gym.evaluation import EnvelopePoint
        >>> EnvelopePoint("always", 0.55, 0.106).rate
        0.55
    """

    name: str
    rate: float
    mse: float


def lower_envelope(results: Mapping[str, EpisodeResults]) -> list[EnvelopePoint]:
    """Return the lower convex hull of the policies' points (rate, MSE).

    A random choice between two policies for each episode reaches every point of the line between
    them. No policy and no mixture of policies lies below the hull.

    Args:
        results: results of each policy by name.

    Returns:
        The points of the hull, by rising rate and strictly falling error.

    Raises:
        ConfigurationError: no policies.

    Example:
        >>> from fusion_gym import make_policy, make_task
        >>> from fusion_gym.evaluation import lower_envelope, run_episodes
        >>> task = make_task("fusion_gym/TobitOscillator-v1", horizon=20)
        >>> names = ["never", "periodic:period=4", "always"]
        >>> results = {n: run_episodes(task, make_policy(n, task), 8, seed=0) for n in names}
        >>> [(point.name, round(point.rate, 2)) for point in lower_envelope(results)]
        [('never', 0.0), ('periodic:period=4', 0.25), ('always', 0.55)]
    """
    if not results:
        raise ConfigurationError("policies = {} is not allowed: an envelope needs at least one")
    points = [
        EnvelopePoint(name, float(result.rate.mean()), float(result.mse.mean()))
        for name, result in sorted(results.items())
    ]
    rates, errors = np.array([(point.rate, point.mse) for point in points]).T
    return [points[place] for place in lower_hull(rates, errors)]


def mixture(hull: Sequence[EnvelopePoint], rate: float) -> dict[str, float] | None:
    """Return the shares of policies of an envelope at a rate; ``None`` to the left of it."""
    if rate < hull[0].rate:
        return None
    left = max((p for p in hull if p.rate <= rate), key=lambda p: p.rate)
    right = min((p for p in hull if p.rate > rate), key=lambda p: p.rate, default=None)
    if right is None:
        return {left.name: 1.0}
    share = (rate - left.rate) / (right.rate - left.rate)
    return {left.name: 1.0 - share, right.name: share}


class BaselineComparison(NamedTuple):
    """A policy against the envelope at the policy's rate, over paired episodes.

    Args:
        difference: MSE of the policy minus MSE of the envelope, with its interval.
        envelope: MSE of the envelope at this rate.
        between: the policies of the mixture.
        far_apart: whether their rates differ by more than the factor ``FAR_APART``; a policy with a
            rate between them may lie below the line.
    """

    difference: Interval
    envelope: float
    between: tuple[str, ...]
    far_apart: bool = False


def compare_with_envelope(
    results: EpisodeResults, baselines: Mapping[str, EpisodeResults]
) -> BaselineComparison:
    """Return the paired difference of the MSE to the baselines' lower envelope.

    The envelope is taken at the mean rate of the policy. Negative: the policy is better.

    Args:
        results: results of the policy.
        baselines: results of the baselines by name, on the same episodes.

    Returns:
        The difference with its interval, the envelope's MSE and the mixed policies.

    Raises:
        ConfigurationError: no baselines, another number of episodes, or a rate below the rates of
            all baselines.

    Example:
        >>> from fusion_gym import make_policy, make_task
        >>> from fusion_gym.evaluation import compare_with_envelope, run_episodes
        >>> task = make_task("fusion_gym/TobitOscillator-v1", horizon=20)
        >>> names = ["never", "always", "periodic:period=8"]
        >>> results = {n: run_episodes(task, make_policy(n, task), 8, seed=0) for n in names}
        >>> comparison = compare_with_envelope(results.pop("periodic:period=8"), results)
        >>> round(comparison.difference.mean, 3), comparison.between
        (-0.011, ('never', 'always'))
    """
    _check_pairs(results, baselines)
    hull = lower_envelope(baselines)
    rate = float(results.rate.mean())
    shares = mixture(hull, rate)
    if shares is None:
        raise ConfigurationError(
            f"rate = {rate:.4f} is below every baseline's (the smallest is {hull[0].rate:.4f}): "
            "add 'never' to the baselines"
        )
    envelope = np.asarray(sum(share * baselines[name].mse for name, share in shares.items()))
    between = tuple(name for name, share in shares.items() if share > 0.0)
    rates = [float(baselines[name].rate.mean()) for name in between]
    return BaselineComparison(
        difference=mean_interval(results.mse - envelope),
        envelope=float(envelope.mean()),
        between=between,
        far_apart=max(rates) > FAR_APART * min(rates),
    )


class PriceComparison(NamedTuple):
    """A policy against the best baseline at one price of a token, over paired episodes.

    Args:
        price: price of a token.
        best: name of the best baseline.
        cost: mean cost of the best baseline per step.
        difference: cost of the policy minus ``cost``, with its interval; negative: the policy is
            better.
    """

    price: float
    best: str
    cost: float
    difference: Interval

    @property
    def relative(self) -> float:
        """The difference as a share of the baseline's cost; NaN if that is zero."""
        return self.difference.mean / (self.cost or np.nan)


def compare_at_price(
    results: EpisodeResults, baselines: Mapping[str, EpisodeResults], price: float
) -> PriceComparison:
    """Return the paired difference of the cost per step to the best baseline.

    The cost is error + price · tokens. The best baseline has the least mean cost on these episodes;
    this choice favours the baselines.

    Args:
        results: results of the policy.
        baselines: results of the baselines by name, on the same episodes.
        price: price of a token.

    Raises:
        ConfigurationError: no baselines, or another number of episodes.
    """
    _check_pairs(results, baselines)
    costs = {name: item.cost(price) for name, item in baselines.items()}
    best = min(costs, key=lambda name: float(costs[name].mean()))
    difference = results.cost(price) - costs[best]
    return PriceComparison(price, best, float(costs[best].mean()), mean_interval(difference))


def _check_pairs(results: EpisodeResults, baselines: Mapping[str, EpisodeResults]) -> None:
    if not baselines:
        raise ConfigurationError("policies = {} is not allowed: at least one baseline is needed")
    for item in baselines.values():
        check_pair(results, item)
