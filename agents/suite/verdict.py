"""The benchmark's verdict: learned fronts against tuned baselines, at the agents' own rates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from fusion_gym.arrays import Array
from fusion_gym.evaluation.envelope import envelope_mse
from fusion_gym.evaluation.episodes import EpisodeResults

RESAMPLES = 2000
MIDDLE = (0.05, 0.5)  # of the rate that transmitting always gets: the middle of the front


def judge(
    agents: Sequence[Sequence[EpisodeResults]],
    prices: Sequence[float],
    baselines: Mapping[str, EpisodeResults],
    references: Mapping[str, EpisodeResults],
    always: float,
    clairvoyant: Mapping[str, EpisodeResults] | None = None,
) -> dict[str, Any]:
    """Points and verdict of one front.

    ``agents[seed][price]`` are test results of one training seed at one price. A point has the
    mean rate and MSE over seeds, the envelopes of baselines and references there, and the relative
    difference of the MSE to the baselines' envelope: interquartile mean over seeds with a 95 %
    interval, bootstrapped over seeds and (paired) episodes at once. The verdict does the same over
    all points in the middle of the front, stratified by price, where the rate is between 5 % and
    50 % of ``always``, the rate that always transmitting gets. ``clairvoyant`` has results of
    schedules made in hindsight, on the first of the episodes: points have their MSE at the same
    rate, as a share of the baselines' envelope on the same episodes times that on all.
    """
    points, inside = [], []
    for place, price in enumerate(prices):
        column = [seed[place] for seed in agents]
        rates = [float(found.rate.mean()) for found in column]
        learned = np.array([found.mse for found in column])
        rate = float(np.mean(rates))
        point: dict[str, Any] = {"price": price, "rate": rate, "mse": float(learned.mean())}
        floors = [envelope_mse(baselines, own) for own in rates]
        if all(floor is not None for floor in floors):
            envelope = np.array(floors)
            point["envelope"] = float(envelope.mean())
            point["difference"] = _interval([(learned, envelope)])
            if MIDDLE[0] * always <= rate <= MIDDLE[1] * always:
                inside.append((learned, envelope))
            known = [envelope_mse(references, own) for own in rates] if references else []
            sound = [found.mean() for found in known if found is not None]
            if sound and len(sound) == len(rates):
                point["reference"] = float(np.mean(sound))
            ahead = envelope_mse(clairvoyant, rate) if clairvoyant else None
            if ahead is not None:
                share = ahead.mean() / envelope[:, : len(ahead)].mean()
                point["hindsight"] = float(share * envelope.mean())
        points.append(point)
    verdict: dict[str, Any] = {"points": points, "seeds": len(agents)}
    if inside:
        verdict["middle"] = _interval(inside)
    gaps = [p for p in points if "reference" in p and _in_middle(p, always)]
    room = sum(p["envelope"] - p["reference"] for p in gaps)
    if room > 0.0:
        verdict["room"] = room / sum(p["envelope"] for p in gaps)
        verdict["closed"] = sum(p["envelope"] - p["mse"] for p in gaps) / room
    loose = [p for p in points if "hindsight" in p and _in_middle(p, always)]
    if loose:
        part = sum(p["hindsight"] for p in loose) / sum(p["envelope"] for p in loose)
        verdict["hindsight_room"] = 1.0 - part
    return verdict


def _in_middle(point: Mapping[str, float], always: float) -> bool:
    return MIDDLE[0] * always <= point["rate"] <= MIDDLE[1] * always


def _interval(strata: Sequence[tuple[Array, Array]]) -> dict[str, float]:
    """Relative difference of the means: interquartile mean over seeds and strata, its interval.

    Each stratum is a pair of (seeds, episodes): the agents' MSE and the envelope's. A resample
    draws the episodes once for all (they are paired) and the seeds anew in every stratum.
    """

    def middle(shares: Array) -> float:
        return float(stats.trim_mean(shares, 0.25))

    def relative(learned: Array, envelope: Array) -> Array:
        return np.asarray(learned.mean(-1) / envelope.mean(-1) - 1.0)

    found = middle(np.concatenate([relative(*stratum) for stratum in strata]))
    generator = np.random.default_rng(0)
    seeds, episodes = strata[0][0].shape
    drawn = np.empty(RESAMPLES)
    for place in range(RESAMPLES):
        counts = generator.multinomial(episodes, np.full(episodes, 1.0 / episodes))
        shares = []
        for learned, envelope in strata:
            chosen = generator.integers(0, seeds, seeds)
            shares.append((learned[chosen] @ counts) / (envelope[chosen] @ counts) - 1.0)
        drawn[place] = middle(np.concatenate(shares))
    low, high = np.quantile(drawn, (0.025, 0.975))
    return {"mean": found, "low": float(low), "high": float(high)}
