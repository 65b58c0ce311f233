"""Lemma 1, the theorems and the remarks of round_robin_tobit in simulated episodes."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import fusion_gym
from agents.papers import round_robin_tobit_runs as measures
from agents.papers.numbers import Number, grid
from agents.papers.paper import Data, Settings
from agents.papers.round_robin_tobit_runs import FREE, OSCILLATOR, TRACKING, censored
from agents.papers.walk import SomeSensors, walk_in_parts
from fusion_gym import gaussian, linalg
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.entries import Options, Plain
from fusion_gym.policies.base import Policy
from fusion_gym.systems.tobit.tobit_filter import expect_censored

PLACES = (-7.0, -5.0, -4.0, 0.0, 4.5, 5.0, 6.0)  # true x1 at which Lemma 1 is tried
_DRAWS = 200  # measurements an episode, at each of them
SHARES = ((0.5, 0.5), (0.9, 0.1), (0.1, 0.9))
SURE = 0.05  # predicted probability of no censoring, at most, of a surprise
# Where the bounds are tried: a head of the table, and what it stands for.
EXAMPLES: dict[str, tuple[str, Options]] = {
    "oscillator": (OSCILLATOR, {}),
    "oscillator, [-0.5, 0.5]": (OSCILLATOR, {"censoring_threshold": -0.5, "censoring_upper": 0.5}),
    "target, uncensored": (TRACKING, {}),
}
_CLEAR = 4.0  # standard errors
# Where the text leaves a choice: the sign of φ (Theorem 4 adds it, (15) with an infinite right
# threshold subtracts it), and whether the correction holds the filter's covariance, as printed, or
# the bound itself.
UPPER = {
    "as printed": (1.0, False), "the sign of φ as in (15)": (-1.0, False),
    "the bound in its own correction": (1.0, True), "both": (-1.0, True),
}  # fmt: skip
# And for the lower bound whether the factor 1 - (1 - ᾱ - β̄)² stands at every step, as printed, or
# at the sensor's turns alone, and whether the process covariance stands whole or, as in (49), with
# the factor (1 - ᾱ - β̄)².
LOWER = {
    "as printed": (False, False), "at the sensor's turns": (True, False),
    "as in (49)": (False, True),
}  # fmt: skip
SHARE = 0.5  # ε of a node, the paper's 1/p


def simulate_theory(episodes: int, seed: int, settings: Settings) -> Data:
    """Return the data for the claims of Lemma 1, Theorems 1 and 2 and the remarks."""
    return {
        **_lemma(episodes, seed),
        **{
            f"{name}_{key}": value
            for name, env in (("oscillator", OSCILLATOR), ("target", TRACKING))
            for key, value in _errors(env, episodes, seed).items()
        },
        **_fusion(min(episodes, 200), seed), **_worth(episodes, seed),
    }  # fmt: skip


def _lemma(episodes: int, seed: int) -> Plain:
    """Mean and variance of y at fixed states: simulated, with standard errors, and by Lemma 1."""
    sensors = censored(fusion_gym.make_task(OSCILLATOR)).centre.sensors
    places, draws = np.array(PLACES), episodes * _DRAWS
    truth = np.zeros((3, len(places)))
    truth[0] = places
    noise = np.random.default_rng(seed).standard_normal((sensors.noise_channels, draws))
    repeated = (np.repeat(truth[:, [i]], draws, axis=1) for i in range(len(places)))
    drawn = np.stack([sensors.measure(state, noise)[0, 0] for state in repeated])
    spread = drawn.var(1, ddof=1)
    fourth = ((drawn - drawn.mean(1, keepdims=True)) ** 4).mean(1)
    means = np.broadcast_to(truth, (sensors.count, *truth.shape))
    right = expect_censored(sensors, means)
    printed = measures.PrintedTobitFilter(sensors, "theta").expect(means)
    return {
        "mean": drawn.mean(1), "mean_error": np.sqrt(spread / draws), "variance": spread,
        "variance_error": np.sqrt(np.maximum(fourth - spread**2, 0.0) / draws),
        "equation_12": right.value[0, 0], "equation_12_printed": printed.value[0, 0],
        "equation_13": sensors.variance[0, 0] * right.truncated_variance[0, 0],
        "total_variance": right.noise_variance[0, 0],
    }  # fmt: skip


def _errors(env: str, episodes: int, seed: int) -> Plain:
    """Consistency, censoring probabilities and correlation in time, along the round robin."""
    task = fusion_gym.make_task(env)
    names = ("nees", "predicted", "uncensored", "sure", "surprised", "product", "first", "second")
    values = {name: np.zeros(episodes) for name in names}
    last = np.zeros((episodes, 3))

    for step, runs, batch, requests in walk_in_parts(task, "round_robin", episodes, seed):
        error = batch.state.plant.truth - batch.state.estimate.prior_mean
        if step:
            earlier = last[runs].T
            values["product"][runs] += error[2] * earlier[2]
            values["first"][runs] += earlier[2] ** 2
            values["second"][runs] += error[2] ** 2
        last[runs] = error.T
        sensor = step % task.sensors
        signals = batch.signals()
        inside = np.asarray(signals["uncensored_probability"])[sensor, 0]
        free = ~np.asarray(signals["censored"])[sensor, 0]
        sure = inside < SURE
        values["predicted"][runs] += inside
        values["uncensored"][runs] += free
        values["sure"][runs] += np.where(sure, inside, 0.0)
        values["surprised"][runs] += sure & free
        outcome = batch.step(requests)
        assert np.all(np.argmax(outcome.granted, axis=0) == sensor)
        truth, estimate, *_ = batch.delivered
        error = task.plant.truth(truth) - task.estimator.mean(estimate)
        covariance = task.estimator.covariance(estimate)
        values["nees"][runs] += linalg.dot(error, linalg.solve_vector(covariance, error)) / 3.0
    for name in ("nees", "predicted", "uncensored"):
        values[name] /= task.horizon
    return values


def _fusion(episodes: int, seed: int) -> Plain:
    """Return the change of the fused estimate with the shares ε, and with B = 0 with the bias."""
    split = [fusion_gym.make_task(OSCILLATOR, information_shares=[*each]) for each in SHARES]
    means = [_means(task, episodes, seed) for task in split]
    no_bias: Options = {"access": "any", "bias_gain": [[0.0], [0.0]]}
    tasks = [fusion_gym.make_task(OSCILLATOR, bias_aware=own, **no_bias) for own in (True, False)]
    without = [_means(task, episodes, seed, "always")[..., :2, :] for task in tasks]
    return {
        "shares_gap": float(max(np.abs(other - means[0]).max() for other in means[1:])),
        "without_gap": float(np.abs(without[0] - without[1]).max()),
    }


def _means(task: Any, episodes: int, seed: int, policy: str = "round_robin") -> Array:
    values = np.empty((task.horizon, 3, episodes))
    for step, runs, batch, requests in walk_in_parts(task, policy, episodes, seed):
        batch.step(requests)
        values[step, :, runs] = task.estimator.mean(batch.delivered.estimate)
    return values


def _worth(episodes: int, seed: int) -> Options:
    """Return squared errors (episodes,), summed over states, of other filters on the same data."""
    settings: dict[str, Plain] = {
        "paper": {}, "adf": {"filter": "adf"}, "kalman": {"filter": "kalman"},
        "free": {"filter": "kalman"} | FREE, "calm": {"bias_noise_covariance": [[0.0025]]},
    }  # fmt: skip
    data: Plain = {}
    for name, options in settings.items():
        task = fusion_gym.make_task(OSCILLATOR, **options)
        errors = measures.squares(task, "round_robin", episodes, seed)
        data[f"mse_{name}"] = errors.sum(2).mean(1)
        data[f"armse_{name}"] = measures.armse(errors)["mean"]
    return data


# --- the bounds of Theorems 4 and 5 ---


class Censoring(NamedTuple):
    """A sensor's prediction, (N,): α, 1 - α - β, and φ of Theorem 4 without its sign."""

    left: Array
    inside: Array
    narrowing: Array


@dataclass
class MatrixBound:
    """A bound (states, states, N) of a sensor's covariance P⁻.

    P^u or P^l of Theorem 4, in a ``reading`` of :data:`UPPER` or :data:`LOWER`. ``inflation`` is 1
    for a single filter and ε⁻¹ for a node, whose process covariance is Q/ε by (27).
    """

    task: Task
    sensor: int
    inflation: float
    upper: bool
    reading: tuple[Any, bool]
    value: Array = field(default_factory=lambda: np.zeros(0), init=False)

    def begin(self, covariance: Array) -> None:
        """Start the bound as the proof does: P^u = P⁻ and P^l = 0."""
        self.value = covariance.copy() if self.upper else np.zeros_like(covariance)

    def holds(self, covariance: Array) -> NDArray[np.bool_]:
        """Return whether (N,) it bounds P⁻."""
        least, most = (covariance, self.value) if self.upper else (self.value, covariance)
        return matrix_below(least, most)

    def advance(self, covariance: Array, observed: Censoring, turn: bool) -> None:
        """Move to the next step, given P⁻, the prediction, and whether this sensor has its turn."""
        model = censored(self.task).model
        stored, share = (self._updated_upper if self.upper else self._updated_lower)(
            covariance, observed, turn
        )
        process = model.process_covariance * self.inflation
        self.value = linalg.congruence(model.transition, stored) + share * process

    def _updated_upper(
        self, covariance: Array, observed: Censoring, turn: bool
    ) -> tuple[Array, Array | float]:
        sign, own = self.reading
        sensors = censored(self.task).centre.sensors
        if not turn:
            return self.value, 1.0
        row = sensors.measurement_matrix[self.sensor, 0]
        cross = linalg.matvec(self.value if own else covariance, row)
        noise = sensors.variance[self.sensor, 0] * (1.0 + sign * observed.narrowing)
        weight = (1.0 - observed.left) ** 2
        innovation = weight * linalg.dot(row, cross) + noise
        return self.value - linalg.outer(cross, cross) * weight / innovation, 1.0

    def _updated_lower(
        self, covariance: Array, observed: Censoring, turn: bool
    ) -> tuple[Array, Array | float]:
        turns, part = self.reading
        inside = observed.inside**2 if turn or not turns else np.zeros_like(observed.inside)
        return (1.0 - inside) * self.value, inside if part else 1.0


def failures(
    task: Task, policy: Policy | str, episodes: int, seed: int, bounds: Sequence[MatrixBound]
) -> tuple[Array, Array]:
    """Return shares of an episode's steps in which a bound fails.

    Of Theorem 4, (bounds, episodes); of Theorem 5, (pairs, episodes), for pairs of bounds of both
    sensors in their order.
    """
    pairs = [bounds[i : i + 2] for i in range(0, len(bounds) - 1, 2)]
    local, fused = np.zeros((len(bounds), episodes)), np.zeros((len(pairs), episodes))

    for step, runs, batch, requests in walk_in_parts(task, policy, episodes, seed):
        covariance = batch.state.estimate.prior_covariance
        observed = [_prediction(task, batch, sensor) for sensor in range(task.sensors)]
        for place, bound in enumerate(bounds):
            own = covariance * bound.inflation
            if step == 0:
                bound.begin(own)
            local[place, runs] += ~bound.holds(own)
        for place, pair in enumerate(pairs if step else []):
            ends = _joined([item.value for item in pair]), covariance[:2, :2]
            low, high = ends[::-1] if pair[0].upper else ends
            fused[place, runs] += ~matrix_below(low, high)
        for bound in bounds:
            turn = step % task.sensors == bound.sensor
            bound.advance(covariance * bound.inflation, observed[bound.sensor], turn)
        batch.step(requests)
    return local / (task.horizon - 1), fused / (task.horizon - 1)


def _bounds(task: Task, sensor: int, inflation: float) -> dict[str, MatrixBound]:
    """Return both bounds of a sensor in all their readings."""
    return {
        f"{end}/{name}": MatrixBound(task, sensor, inflation, end == "upper", reading)
        for end, readings in (("upper", UPPER), ("lower", LOWER))
        for name, reading in readings.items()
    }


def _prediction(task: Task, batch: EpisodeBatch, sensor: int) -> Censoring:
    sensors = censored(task).centre.sensors
    expected = batch.state.estimate.prediction.expectation
    limit, deviation = sensors.threshold[sensor, 0], sensors.deviation[sensor, 0]
    low = (limit - expected.latent[sensor, 0]) / deviation
    hazard = gaussian.hazard(low)
    inside = expected.uncensored_probability[sensor, 0]
    return Censoring(gaussian.upper_tail(-low), inside, hazard * (hazard - low))


def matrix_below(first: Array, second: Array) -> NDArray[np.bool_]:
    """Return whether (N,) ``first`` ≤ ``second`` (n, n, N) up to rounding; false for NaN."""
    scale = np.maximum(linalg.trace(np.abs(first)), linalg.trace(np.abs(second)))
    gap = linalg.add_diagonal(second - first, np.broadcast_to(1e-9 * scale, second.shape[1:]))
    return np.asarray(np.isfinite(linalg.cholesky(gap)).all((0, 1)))


def _joined(parts: list[Array]) -> Array:
    """Return (Σ P_m⁻¹)⁻¹ of x, as Theorem 5 joins the bounds; NaN for an indefinite bound."""
    return linalg.inverse(sum((linalg.inverse(part) for part in parts), np.zeros(1)))[:2, :2]


def simulate_bounds(episodes: int, seed: int, settings: Settings) -> Data:
    """Return failures of the bounds of Theorems 4 and 5, also in the narrow interval.

    Shares of failures (episodes,) by example, theorem, end, reading and sensor.
    """
    data: Data = {}
    for example, (env, options) in EXAMPLES.items():
        task = fusion_gym.make_task(env, **options)
        for sensor in range(2):
            single = _bounds(task, sensor, 1.0)
            policy = SomeSensors(fusion_gym.make_policy("periodic:period=2", task), {sensor})
            local, _ = failures(task, policy, episodes, seed, list(single.values()))
            for name, sample in zip(single, local, strict=True):
                data[f"{example}:4/{name}/{sensor}"] = sample
        nodes = [_bounds(task, sensor, 1.0 / SHARE) for sensor in range(2)]
        bounds = [node[name] for name in nodes[0] for node in nodes]
        _, fused = failures(task, "round_robin", episodes, seed, bounds)
        for name, sample in zip(nodes[0], fused, strict=True):
            data[f"{example}:5/{name}"] = sample
    return data


def summarise_theory(data: Data) -> Data:
    """Return the numbers of Lemma 1, Theorems 1 and 2 and the remarks."""
    numbers = {
        "NEES of the fused estimate, oscillator": "oscillator_nees",
        "NEES of the fused estimate, target": "target_nees",
        "share of uncensored packets, predicted by (9)": "oscillator_predicted",
        "share of uncensored packets, simulated": "oscillator_uncensored",
    }
    comparisons = {
        "right": ("mean", "equation_12"), "printed": ("mean", "equation_12_printed"),
        "values": ("variance", "equation_13"), "total": ("variance", "total_variance"),
    }  # fmt: skip
    off = {}
    for name, (value, against) in comparisons.items():
        error = np.maximum(data[f"{value}_error"], 1e-12)
        off[name] = int((np.abs(data[value] - data[against]) > _CLEAR * error).sum())
    own, free, calm = (np.array(data[f"armse_{name}"]) for name in ("paper", "free", "calm"))
    theory = [Number.from_sample(what, data[name]) for what, name in numbers.items()]
    return {
        "tables": {"theory": theory},
        "places": PLACES, "off": off,
        "worst": int(np.argmax(np.abs(data["mean"] - data["equation_12_printed"]))),
        "most": int(np.argmax(np.abs(data["variance"] - data["equation_13"]))),
        "sure_below": SURE, "correlation": _correlation(data), "node_shares": SHARES,
        "gap": data["oscillator_predicted"] - data["oscillator_uncensored"],
        "times": data["oscillator_surprised"].sum() / data["oscillator_sure"].sum(),
        "worse": own / free, "calmer": own / calm,
    }  # fmt: skip


def _correlation(data: Data) -> Data:
    """The bias's correlation of successive errors by example: its interval's ends and median."""
    weights = measures.resampled(len(data["oscillator_nees"]))
    result = {}
    for name in ("oscillator", "target"):
        parts = (f"{name}_{part}" for part in ("product", "first", "second"))
        product, first, second = (weights @ data[part] for part in parts)
        result[name] = np.quantile(product / np.sqrt(first * second), [0.025, 0.5, 0.975])
    return result


def summarise_bounds(data: Data) -> Data:
    """Return the failure rates of the bounds of Theorems 4 and 5, by reading."""
    rows = {}
    for name in (key.partition(":")[2] for key in data if key.startswith("oscillator:")):
        theorem, end, reading, *sensor = name.split("/")
        which = f", sensor {int(sensor[0]) + 1}" if sensor else ""
        samples = [100 * data[f"{example}:{name}"] for example in EXAMPLES]
        rows[f"Theorem {theorem}, {end} bound, {reading}{which}"] = samples
    return {
        "examples": list(EXAMPLES),
        "tables": {"bounds": grid(EXAMPLES, rows, "%")},
        "ends": {
            f"{end}_{theorem}": _summarise_bound(data, f"{theorem}/{end}")
            for theorem in (4, 5)
            for end in ("upper", "lower")
        },
    }


def _summarise_bound(data: Data, bound: str) -> Data:
    by: dict[str, list[float]] = {}
    for reading in UPPER if bound.endswith("upper") else LOWER:
        for example in EXAMPLES:
            start = f"{example}:{bound}/{reading}/"
            shares = [data[key].mean() for key in data if f"{key}/".startswith(start)]
            by.setdefault(reading, []).append(float(max(shares)))
    best = min(by, key=lambda reading: sum(by[reading]))
    return {"printed": by["as printed"], "readings": len(by), "best": best, "shares": by[best]}
