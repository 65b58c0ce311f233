"""The lower envelope of many policies in the plane of transmission rate and error."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fusion_gym.arrays import Array
from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.evaluation.intervals import Interval, mean_interval
from fusion_gym.validation import ConfigurationError

FAR_APART = 1.5


class EnvelopePoint(NamedTuple):
    """A policy on the envelope: its name, mean rate per sensor and step, mean squared error."""

    name: str
    rate: float
    mse: float


def points_of(results: Mapping[str, EpisodeResults]) -> list[EnvelopePoint]:
    """Each policy's mean rate and error, by rising rate (of equal ones: by rising error)."""
    points = [
        EnvelopePoint(name, float(r.rate.mean()), float(r.mse.mean()))
        for name, r in results.items()
    ]
    return sorted(points, key=lambda point: (point.rate, point.mse, point.name))


def lower_envelope(results: Mapping[str, EpisodeResults]) -> list[EnvelopePoint]:
    """The lower convex hull of the policies' points, by rising rate and strictly falling error.

    Every point between two policies is reached by drawing one of them for each episode, and
    every point to the right of one by that one itself; so nothing that the policies offer,
    mixtures included, lies below the envelope.

    Raises:
        ConfigurationError: there are no policies.
    """
    return lower_hull(points_of(results))


def lower_hull(points: Iterable[EnvelopePoint]) -> list[EnvelopePoint]:
    """The points of :func:`lower_envelope`, of points in any order.

    Raises:
        ConfigurationError: there are none.
    """
    ordered = sorted(points, key=lambda point: (point.rate, point.mse, point.name))
    if not ordered:
        raise ConfigurationError("policies = {} is not allowed: an envelope needs at least one")
    hull: list[EnvelopePoint] = []
    for point in ordered:
        if hull and point.mse >= hull[-1].mse:
            continue
        while len(hull) >= 2 and _above(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    return hull


def _above(left: EnvelopePoint, middle: EnvelopePoint, right: EnvelopePoint) -> bool:
    """Whether ``middle`` lies on or above the line from ``left`` to ``right``."""
    rise = (middle.mse - left.mse) * (right.rate - left.rate)
    return rise >= (right.mse - left.mse) * (middle.rate - left.rate)


def mixture(hull: Sequence[EnvelopePoint], rate: float) -> dict[str, float] | None:
    """The policies of an envelope, by rising rate, and their shares at a rate.

    ``None`` left of it; right of it the last policy alone.
    """
    if rate < hull[0].rate:
        return None
    left = max((p for p in hull if p.rate <= rate), key=lambda p: p.rate)
    right = min((p for p in hull if p.rate > rate), key=lambda p: p.rate, default=None)
    if right is None:
        return {left.name: 1.0}
    share = (rate - left.rate) / (right.rate - left.rate)
    return {left.name: 1.0 - share, right.name: share}


def _mixed(results: Mapping[str, EpisodeResults], shares: Mapping[str, float]) -> Array:
    return np.asarray(sum(share * results[name].mse for name, share in shares.items()))


class BaselineComparison(NamedTuple):
    """A policy against the envelope at its own rate, over paired episodes.

    ``difference`` is the policy's MSE minus the envelope's, ``envelope`` the envelope's MSE,
    ``between`` the policies that were mixed. ``far_apart`` says that their rates differ by more
    than ``FAR_APART`` times: a rule between them would lie below the line.
    """

    difference: Interval
    envelope: float
    between: tuple[str, ...]
    far_apart: bool = False


def compare_with_envelope(
    results: EpisodeResults, baselines: Mapping[str, EpisodeResults]
) -> BaselineComparison:
    """Paired difference of the MSE to the baselines' lower envelope at the policy's own rate.

    Raises:
        ConfigurationError: no baselines, other numbers of episodes, or a rate below every
            baseline's (there the envelope does not exist).
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
    envelope = _mixed(baselines, shares)
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

    ``difference`` is the policy's cost minus the cost of the baseline ``best``, in the mean
    ``cost``. Negative: the policy is better.
    """

    price: float
    best: str
    cost: float
    difference: Interval

    @property
    def relative(self) -> float:
        """The difference as a share of the baseline's cost."""
        return self.difference.mean / self.cost


def compare_at_price(
    results: EpisodeResults, baselines: Mapping[str, EpisodeResults], price: float
) -> PriceComparison:
    """Return the paired difference of cost = error + price · tokens, a step, to the best baseline.

    The baseline of the least mean on these episodes, which favours the baselines.

    Raises:
        ConfigurationError: no baselines, or other numbers of episodes.
    """
    _check_pairs(results, baselines)
    costs = {name: item.error_cost + price * item.tokens for name, item in baselines.items()}
    best = min(costs, key=lambda name: float(costs[name].mean()))
    difference = results.error_cost + price * results.tokens - costs[best]
    return PriceComparison(price, best, float(costs[best].mean()), mean_interval(difference))


def _check_pairs(results: EpisodeResults, baselines: Mapping[str, EpisodeResults]) -> None:
    if not baselines:
        raise ConfigurationError("policies = {} is not allowed: at least one baseline is needed")
    if any(item.episodes != results.episodes for item in baselines.values()):
        raise ConfigurationError(
            "episodes differ between policy and baselines: they must be paired"
        )
