"""Policies over a parameter, for comparisons at equal rates and at equal prices."""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from fusion_gym import seeds
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.entries import Plain
from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.evaluation.metrics import Interval, envelope_error, mean_interval
from fusion_gym.evaluation.rule_search import try_thresholds
from fusion_gym.policies.base import SHARED_THRESHOLD, SearchRange
from fusion_gym.policies.registry import (
    make_policy,
    policy_names,
    policy_parameters,
    search_ranges,
)
from fusion_gym.validation import ConfigurationError

_COARSE, _EPISODES = 33, 16  # values over the whole range, to see where the tokens change
_LEFT = 0.02  # share of the most tokens within which the tokens hardly change
Curve = Mapping[str, EpisodeResults]


def sweep(task: Task, text: str, prices: Sequence[float], count: int = 24) -> list[str]:
    """Return the policies of a curve.

    They have values of ``{value}`` in the text, or else of the rule's ``price`` or first parameter,
    where it changes the tokens. An agent or an optimum of several prices runs at ``prices``. Other
    policies, and rules whose text sets that parameter, are alone.
    """
    make_policy(text.replace("{value}", "1"), task)
    template, own = _template(text)
    if "{value}" not in template:
        return [text]
    if own is None:
        with suppress(ConfigurationError):  # of an agent of one price
            texts = [template.replace("{value}", repr(price)) for price in prices]
            for each in texts:
                make_policy(each, task)
            return texts or [text]
        return [text]
    grid = _values(own, own[:2], _COARSE)
    trials = try_thresholds(task, template, grid.tolist(), _EPISODES, seeds.TUNING.start)
    share = np.array([trial.tokens for trial in trials])
    share /= np.nanmax(share) or 1.0
    places = np.flatnonzero((share > _LEFT) & (share < 1.0 - _LEFT))
    first, last = (places[0] - 1, places[-1] + 1) if len(places) else (0, len(grid) - 1)
    ends = grid[max(first, 0)], grid[min(last, len(grid) - 1)]
    return [template.replace("{value}", f"{value:.4g}") for value in _values(own, ends, count)]


def _template(text: str) -> tuple[str, SearchRange | None]:
    """Return the text with ``{value}`` for the parameter of its curve, and the parameter's range.

    ``None`` stands for the prices.
    """
    if "{value}" in text:
        return text, SHARED_THRESHOLD
    name, _, settings = text.partition(":")
    priced = name in policy_names() and "price" in policy_parameters(name)
    if name not in policy_names():  # module:Rule
        kind, _, settings = settings.partition(":")
        name = f"{name}:{kind}"
    every = search_ranges(name)
    parameter, own = next(iter(every.items()), ("", SHARED_THRESHOLD))
    if priced:
        parameter, own = "price", SHARED_THRESHOLD
    if not parameter or re.search(f"[:,]{parameter}=", text):
        return text, None
    entries = [entry for entry in (f"{parameter}={{value}}", settings) if entry]
    if name in policy_names("agent"):  # its file comes first; the text of a base comes last
        entries.reverse()
    return f"{name}:{','.join(entries)}", own if every else None


def _values(own: SearchRange, ends: Sequence[float], count: int) -> Array:
    first, last = own.coordinate(np.array(ends))
    return np.unique(own.value(np.linspace(first, last, count)))


class PairedComparison(NamedTuple):
    """A policy's mean, and its paired difference to the least mean of the other policies."""

    mean: float
    difference: Interval

    @property
    def relative(self) -> Interval:
        """The difference as shares of that least mean."""
        least = self.mean - self.difference.mean
        return Interval(*(end / least if least else np.nan for end in self.difference))

    def plain(self) -> Plain:
        """Return the comparison as JSON."""
        return {"mean": self.mean, "difference": self.difference._asdict()}


def compare(samples: Mapping[str, Array | None]) -> dict[str, PairedComparison | None]:
    """Return the comparison of policies by their samples, one per episode."""
    known: dict[str, Any] = {name: own for name, own in samples.items() if own is not None}
    order = sorted(known, key=lambda name: _mean(known[name]))
    result: dict[str, PairedComparison | None] = dict.fromkeys(samples)
    for name, own in known.items():
        least = known[next((other for other in order if other != name), name)]
        result[name] = PairedComparison(_mean(own), mean_interval(own - least))
    return result


def _mean(samples: Array) -> float:
    """Return the mean without lost episodes."""
    return float(np.nanmean(samples))


def error_at_rate(curve: Curve, rate: float) -> Array | None:
    """Return the MSE (E,) of the curve's lower envelope at a rate, ``None`` to its left."""
    least = min(_mean(item.rate) for item in curve.values())
    return envelope_error(curve, rate) if rate >= least else None


def cost_at_price(curve: Curve, price: float) -> Array:
    """Return the cost (E,) of the curve's policy that costs least at a price of a token."""
    return min((item.cost(price) for item in curve.values()), key=_mean)


def usual_prices(task: Task, results: Curve) -> tuple[float, float]:
    """Return a tenth and ten times the task's price, or what a token saves at most without one."""
    errors, tokens = np.array([(_mean(r.error_cost), _mean(r.tokens)) for r in results.values()]).T
    price = task.reward.price.middle or float(np.ptp(errors) / (tokens.max() or 1.0)) or 1.0
    return price / 10.0, price * 10.0
