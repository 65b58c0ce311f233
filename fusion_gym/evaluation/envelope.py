"""The lower envelope of many policies in the plane of transmission rate and error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.evaluation.intervals import Interval, mean_interval
from fusion_gym.validation import ConfigurationError


class EnvelopePoint(NamedTuple):
    """A policy on the envelope: its name, mean rate per sensor and step, mean squared error."""

    name: str
    rate: float
    mse: float


def lower_envelope(results: Mapping[str, EpisodeResults]) -> list[EnvelopePoint]:
    """The lower convex hull of the policies' points, by rising rate and strictly falling error.

    Every point between two policies is reached by drawing one of them for each episode, and
    every point to the right of one by that one itself; so nothing that the policies offer,
    mixtures included, lies below the envelope.

    Raises:
        ConfigurationError: there are no policies.
    """
    if not results:
        raise ConfigurationError("policies = {} is not allowed: an envelope needs at least one")
    points = sorted(
        EnvelopePoint(name, float(r.rate.mean()), float(r.mse.mean()))
        for name, r in results.items()
    )
    points.sort(key=lambda point: (point.rate, point.mse))
    hull: list[EnvelopePoint] = []
    for point in points:
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


class Comparison(NamedTuple):
    """A policy against the envelope at its own rate, over paired episodes.

    ``difference`` is the policy's MSE minus the envelope's, ``envelope`` the envelope's MSE,
    ``between`` the policies that were mixed.
    """

    difference: Interval
    envelope: float
    between: tuple[str, ...]


def compare_with_envelope(
    results: EpisodeResults, baselines: Mapping[str, EpisodeResults]
) -> Comparison:
    """Paired difference of the MSE to the baselines' lower envelope at the policy's own rate.

    Raises:
        ConfigurationError: no baselines, other numbers of episodes, or a rate below every
            baseline's (there the envelope does not exist).
    """
    hull = lower_envelope(baselines)
    rate = float(results.rate.mean())
    if rate < hull[0].rate:
        raise ConfigurationError(
            f"rate = {rate:.4f} is below every baseline's (the smallest is {hull[0].rate:.4f}): "
            "add 'never' to the baselines"
        )
    left = max((p for p in hull if p.rate <= rate), key=lambda p: p.rate)
    further = [p for p in hull if p.rate > rate]
    mixture: Sequence[tuple[EnvelopePoint, float]] = [(left, 1.0)]
    if further:
        right = further[0]
        share = (rate - left.rate) / (right.rate - left.rate)
        mixture = [(left, 1.0 - share), (right, share)]
    parts = [(baselines[point.name], share) for point, share in mixture]
    if any(part.episodes != results.episodes for part, _ in parts):
        raise ConfigurationError(
            "episodes differ between policy and baselines: they must be paired"
        )
    envelope = np.sum([share * part.mse for part, share in parts], axis=0)
    return Comparison(
        difference=mean_interval(results.mse - envelope),
        envelope=float(envelope.mean()),
        between=tuple(point.name for point, share in mixture if share > 0.0),
    )
