"""A learned front, rate and error at several prices, measured while it is trained."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.beside import run_beside
from fusion_gym.evaluation.envelope import EnvelopePoint, height, lower_hull
from fusion_gym.policies.model import ModelPolicy

from ..training.config import Experiment
from ..training.monitor import Measure

Points = Sequence[Sequence[float]]  # (rate, MSE) at each price
WIDTH = 3.0  # the least factor between the rates of a front: less is hardly more than a point


def front_prices(price_range: tuple[float, float], count: int) -> list[float]:
    """Prices over the whole range, evenly in the logarithm, both ends exactly."""
    low, high = price_range
    return [min(max(float(price), low), high) for price in np.geomspace(low, high, count)]


def meter(experiment: Experiment, prices: Sequence[float], episodes: int) -> Measure:
    """What measures a training's ``front`` on its validation seeds, beside its ``cpu_seconds``."""
    task = make_task(experiment.environment.id, **experiment.environment.options)
    local, seed = experiment.environment.local, experiment.validation.seed

    def measure(model: BaseAlgorithm, seconds: float) -> dict[str, Any]:
        policies = [ModelPolicy(model, task, price=price, local=local) for price in prices]
        result = run_beside(task, policies, episodes, seed)
        points = [[float(brief.rate.mean()), float(brief.mse.mean())] for brief in result]
        return {"cpu_seconds": seconds, "front": points}

    return measure


def excess_over(front: Points, envelope: Sequence[EnvelopePoint]) -> float:
    """The most by which a front lies above an envelope over the front's range, as a share of it.

    Every point of the front counts at its own rate, and between its lowest and its highest rate
    the front's lower hull (mixtures of two prices) at each vertex of the envelope. Both are
    straight between these rates, so a share below zero says that the front is below the envelope
    everywhere in its range. Infinite where a rate is left of the envelope or an error not finite.
    """
    own = lower_hull(EnvelopePoint(str(place), *point) for place, point in enumerate(front))
    hull = lower_hull(envelope)
    low, high = range_of(front)
    pairs: list[tuple[float | None, float | None]]
    pairs = [(mse, height(hull, rate)) for rate, mse in front]
    pairs += [(height(own, v.rate), v.mse) for v in hull if low < v.rate < high]
    shares = [mse / above - 1.0 if mse is not None and above else np.inf for mse, above in pairs]
    result = float(np.max(shares))
    return result if np.isfinite(result) else np.inf


def is_below(front: Points, envelope: Sequence[EnvelopePoint], least: float) -> bool:
    """Whether a front is below an envelope over its whole range, and has one.

    A policy that does the same at every price would have no range to be above in, and one that
    sends next to nothing is as good as any rule there: the highest rate is at least three times
    the lowest, and three times the rate ``least``, below which the lowest is taken for it.
    """
    low, high = range_of(front)
    return excess_over(front, envelope) < 0.0 and high >= WIDTH * max(low, least)


def range_of(front: Points) -> tuple[float, float]:
    """The lowest and the highest rate."""
    rates = [rate for rate, _ in front]
    return min(rates), max(rates)
