"""Rules over their first parameter, for comparisons at an equal rate or at an equal price."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fusion_gym import seeds
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.entries import Plain
from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.evaluation.metrics import Interval, lower_envelope, mean_interval, mixture
from fusion_gym.evaluation.rule_search import try_thresholds
from fusion_gym.policies.base import SHARED_THRESHOLD, SearchRange
from fusion_gym.policies.registry import (
    make_policy,
    policy_names,
    policy_parameters,
    search_ranges,
    with_settings,
)

_COARSE, _EPISODES = 33, 16  # values over the whole range, to see where the tokens change
_LEFT = 0.02  # share of the most tokens within which the tokens hardly change
Curve = Mapping[str, EpisodeResults]


def sweep(task: Task, text: str, count: int = 24) -> list[str]:
    """Return the texts of a rule over its first parameter where that changes the tokens.

    A text that sets this parameter, an agent and a rule without parameters are single policies.
    """
    name = text.partition(":")[0]
    bare = text if "=" not in text else text.rpartition(":")[0]
    every, rest = search_ranges(bare), search_ranges(text)
    others = {*policy_names()} - {*policy_names("agent")}
    if name in others and "price" in policy_parameters(name):
        every = {"price": SHARED_THRESHOLD}
        rest = every if "price=" not in text else {}
    parameter, own = next(iter(every.items()), ("", SHARED_THRESHOLD))
    if parameter not in rest:
        make_policy(text, task)
        return [text]
    template = with_settings(text, {parameter: "{value}"})
    grid = _values(own, own[:2], _COARSE)
    trials = try_thresholds(task, template, grid.tolist(), _EPISODES, seeds.TUNING.start)
    share = np.array([trial.tokens for trial in trials])
    share /= share.max() or 1.0
    places = np.flatnonzero((share > _LEFT) & (share < 1.0 - _LEFT))
    first, last = (places[0] - 1, places[-1] + 1) if len(places) else (0, len(grid) - 1)
    ends = grid[max(first, 0)], grid[min(last, len(grid) - 1)]
    return [template.replace("{value}", f"{value:.4g}") for value in _values(own, ends, count)]


def _values(own: SearchRange, ends: Sequence[float], count: int) -> Array:
    first, last = own.coordinate(np.array(ends))
    return np.unique(own.value(np.linspace(first, last, count)))


class Comparison(NamedTuple):
    """A policy's mean, and its paired difference to the least mean of all policies."""

    mean: float
    difference: Interval

    def plain(self) -> Plain:
        """Return the comparison as JSON."""
        return {"mean": self.mean, "difference": self.difference._asdict()}


def compare(samples: Mapping[str, Array | None]) -> dict[str, Comparison | None]:
    """Return the comparison of policies by their samples, one per episode."""
    least = min((s for s in samples.values() if s is not None), key=lambda own: float(own.mean()))
    return {
        name: None if own is None else Comparison(float(own.mean()), mean_interval(own - least))
        for name, own in samples.items()
    }


def error_at_rate(curve: Curve, rate: float) -> Array | None:
    """Return the MSE (E,) of the curve's lower envelope at a rate, ``None`` to its left."""
    shares = mixture(lower_envelope(curve), rate)
    if shares is None:
        return None
    return np.asarray(sum(share * curve[name].mse for name, share in shares.items()))


def cost_at_price(curve: Curve, price: float) -> Array:
    """Return the cost (E,) of the curve's policy that costs least at a price of a token."""
    return min((item.cost(price) for item in curve.values()), key=lambda cost: float(cost.mean()))


def usual_prices(task: Task, results: Curve) -> tuple[float, float]:
    """Return a tenth and ten times the task's price, or what a token saves at most without one."""
    errors, tokens = np.array([(r.error_cost.mean(), r.tokens.mean()) for r in results.values()]).T
    price = task.reward.price.middle or float(np.ptp(errors) / (tokens.max() or 1.0)) or 1.0
    return price / 10.0, price * 10.0
