"""The values of ``"auto"`` options: the scale of the reward, and the range of prices.

Seeded simulations of the assumed plant determine both; each simulation runs once.
"""

import json
import math
import warnings
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from fusion_gym import linalg, seeds, validation
from fusion_gym.arrays import Array
from fusion_gym.core import code_cache
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.network import Network
from fusion_gym.core.task import CommonOptions, Scenario, Task
from fusion_gym.declaration import plain_options
from fusion_gym.errors import ConfigurationError, DivergenceError, display, forbidden

Build = Callable[[Any], Scenario]
_RUNS, _STEPS = len(seeds.SCALE), 200
_TRIAL = 8  # steps of a rehearsal
_WORK = 200  # sensors · states² up to which a sweep has all its rules and runs
# Allowance for rounding, because 49 · (1/49) < 1.
_ROUNDING = 1e-9
# Shares of the sustained packets at the lowest and highest price; packets per sensor and episode.
_MOST, _LEAST, _PACKETS = 0.6, 0.12, 2.0
_STORED: dict[tuple[Any, ...], Any] = {}


def resolve(options: CommonOptions, build: Build) -> tuple[CommonOptions, Array | None]:
    """Return the options with numbers for ``"auto"``, and the nominal error or ``None``."""
    error, factor = None, options.reward_scale
    if factor is not None:
        error, whole = _stored(nominal_error, options.nominal(), build)
        if not _is_auto(factor):
            factor = validation.number("reward_scale", factor, above=0.0)
        elif options.state_weights is not None:
            factor = 1.0
        elif 0.0 < whole < np.inf:
            factor = _rounded(1.0 / whole)
        else:
            raise ConfigurationError(
                "reward_scale = 'auto' is not allowed here: packets at an even pace leave mean "
                f"squared errors of {display(error)}, whose cost {whole:g} must be finite and > 0"
            )
        options = replace(options, reward_scale=factor)
    if _is_auto(options.price_range):
        rules = replace(
            options.nominal(),
            delay=0,  # a late packet has no value of one step
            memory=True,
            error_weight=options.error_weight,
            state_weights=options.state_weights,
            reward_scale=options.reward_scale,
        )
        options = replace(options, price_range=_stored(price_range, rules, build))
    return options, error


def rehearse(task: Task) -> None:
    """Check that runs without, with all and with alternating requests remain finite."""
    sensors = np.arange(task.sensors)
    try:
        batch = EpisodeBatch.seeded(task.with_options(backend="numpy"), 3, seed=0)
        for step in range(min(_TRIAL, task.horizon)):
            batch.observe()
            requests = np.stack([sensors < 0, sensors >= 0, (sensors + step) % 2 == 0], axis=-1)
            batch.step(requests)
        batch.observe()
    except DivergenceError as error:
        raise ConfigurationError(
            f"these numbers together are not allowed: {error}; they lie too far apart or make a "
            "covariance singular"
        ) from None


def nominal_rate(network: Network) -> float:
    """Return packets per sensor and step: half of the sustained rate, or a quarter if unlimited."""
    return sustained_rate(network) / (4.0 if network.bucket.unlimited else 2.0)


def sustained_rate(network: Network) -> float:
    """Return the packets per sensor and step that the network sustains."""
    return float(_packets(network).mean())


def _packets(network: Network) -> Array:
    """Return the packets per step of each sensor, (buckets, 1) or one number."""
    bucket, rule, packets = network.bucket, network.rule, network.sensors
    if rule.turn is not None or rule.limited:
        packets = network.slots
    elif rule.contended:
        packets = min(network.options.channels, packets)
    most = packets / network.sensors
    paid = np.inf if bucket.unlimited else bucket.rate / bucket.round_cost
    result: Array = np.minimum(most, paid)
    return result


def sustained_tokens(task: Task) -> float:
    """Return the tokens per step that the network lets all sensors spend in the long run."""
    return float((_packets(task.network) * task.network.bucket.round_cost).sum())


def nominal_error(task: Task) -> tuple[Array, float]:
    """Return each state's mean squared error (n,) with requests at an even pace, and its cost."""
    rate, sensors, weights = nominal_rate(task.network), task.sensors, task.reward.state_weights
    steered, separate = task.objective == "control", False
    if not steered:
        separate = weights.ndim == 2
    if rate == 0.0 and separate:
        return task.open_loop[:, 0], float(weights[:, 0] @ task.open_loop[:, 0])
    batch, cost = _batch(task, _RUNS, 1), 0.0
    total = np.zeros(len(task.open_loop))
    due = np.repeat(np.arange(sensors)[:, None] / sensors + _ROUNDING, _RUNS, axis=1)
    for _ in range(batch.task.horizon):
        due += rate
        requests = (due >= 1.0) & batch.admitted()
        due -= requests
        outcome = batch.step(requests)
        total += outcome.squared_error.mean(-1)
        each: Any = outcome.control_cost
        if not steered:
            each = linalg.weighted_square(outcome.error, weights)
        cost += float(np.mean(each))
    error, steps = total / batch.task.horizon, batch.task.horizon
    return error, float(weights[:, 0] @ error) if separate else cost / steps


def price_range(task: Task) -> tuple[float, float]:
    """Return the prices at which value of information sends 60 and 12 % of the sustained rate.

    The lower rate is at least two packets per sensor and episode. Each price belongs to the
    threshold of the least cost: prices are slopes of the lower envelope of error against tokens.

    Args:
        task: The task.
    """
    sustained = sustained_tokens(task)
    least = _PACKETS * float(task.network.bucket.cost.sum()) / task.horizon
    shares = np.array([sustained * _MOST, max(sustained * _LEAST, least)])
    low, high = prices_at(*_sweep(task), shares).tolist()
    return _rounded(low), _rounded(max(high, 2.0 * low))


def prices_at(spent: Array, error: Array, tokens: Array) -> Array:
    """Return the slopes of the lower envelope where the best policy spends ``tokens``."""
    vertices = lower_hull(spent, error)
    spent, error = spent[vertices], error[vertices]
    if len(vertices) < 3:
        reason = "transmissions do not lower the error"
        raise forbidden("price_range", "auto", reason, "here")
    middle = np.sqrt(spent[1:] * np.maximum(spent[:-1], 0.25 * spent[1]))
    slopes = np.log(np.diff(-error) / np.diff(spent))
    return np.exp(np.interp(np.log(tokens), np.log(middle), slopes))


def _sweep(task: Task) -> tuple[Array, Array]:
    """Return tokens and error per step (rules,) of value-of-information rules on the same noise."""
    share = _WORK / (task.sensors * len(task.open_loop) ** 2)
    runs = int(np.clip(_RUNS * share, 4, _RUNS))
    ratio, count = (2, 21) if runs > 4 else (4, 9)
    error, whole = nominal_error(task)
    usual = task.reward.error_weight * (whole or float(task.reward.diagonal[:, 0] @ error))
    levels = usual / float(task.network.bucket.cost.mean()) * np.geomspace(3e-3, 3e2, count)
    counts = ratio ** np.arange(1 + int(math.log(task.sensors, ratio)))
    least = np.tile(np.repeat(levels, runs), len(counts)) * task.network.bucket.cost
    most = np.repeat(counts, len(levels) * runs)
    batch = _batch(task, runs, len(levels) * len(counts))
    total = np.zeros((2, len(most)))
    for _ in range(batch.task.horizon):
        value = task.error_scale * batch.beliefs().value
        rank = np.argsort(np.argsort(-value, axis=0), axis=0)
        outcome = batch.step((value >= least) & (rank < most))
        total += outcome.cost, -outcome.reward_error
    spent, left = total.reshape(2, -1, runs).mean(-1) / batch.task.horizon
    return spent, left


def lower_hull(rate: Array, error: Array) -> list[int]:
    """Return the vertices of the lower convex hull, by rising rate and strictly falling error."""
    hull: list[int] = []
    for point in np.lexsort((error, rate)).tolist():
        if hull and error[point] >= error[hull[-1]]:
            continue
        while len(hull) > 1 and _above(hull[-2], hull[-1], point, rate, error):
            hull.pop()
        hull.append(point)
    return hull


def _above(left: int, middle: int, right: int, rate: Array, error: Array) -> bool:
    """Return whether the middle point lies on or above the line between the others."""
    rise = (error[middle] - error[left]) * (rate[right] - rate[left])
    return bool(rise >= (error[right] - error[left]) * (rate[middle] - rate[left]))


def _batch(task: Task, runs: int, copies: int) -> EpisodeBatch:
    """Return a batch of ``copies`` copies of the simulation's runs, at the typical token rate."""
    bucket = task.network.bucket
    typical = {} if bucket.rate_range is None else {"token_rate": bucket.rate}
    task = task.with_options(horizon=min(task.horizon, _STEPS), **typical)
    batch = EpisodeBatch(task, runs * copies)
    batch.seed(np.arange(runs * copies), [*seeds.SCALE[:runs]] * copies)
    batch.reset()
    return batch


def _stored(simulate: Callable[[Task], Any], options: CommonOptions, build: Build) -> Any:
    """Return the result of a simulation of options, from this process or an earlier one."""
    key = simulate, build, json.dumps(plain_options(asdict(options)), default=repr)
    if key not in _STORED:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            task = Task.create(build(options))
            parts = simulate.__name__, task
            _STORED[key] = code_cache.stored("values", parts, lambda: simulate(task))
    return _STORED[key]


def _rounded(value: float) -> float:
    """Round to three digits, so that all machines give the same value."""
    return float(f"{value:.3g}")


def _is_auto(value: Any) -> bool:
    return isinstance(value, str) and value == "auto"
