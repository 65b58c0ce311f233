"""Lemma 1, the theorems and the remarks of round_robin_tobit in simulated episodes."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

import fusion_gym
from agents.papers import round_robin_tobit_runs as measures
from agents.papers.numbers import Number, grid
from agents.papers.paper import Data, Settings
from agents.papers.round_robin_tobit_runs import FREE, OSCILLATOR, TRACKING, censored
from agents.papers.walk import SomeSensors, record, walk
from fusion_gym import gaussian, linalg
from fusion_gym.arrays import Array
from fusion_gym.core.task import Task
from fusion_gym.entries import Options, Plain
from fusion_gym.policies.base import Policy
from fusion_gym.systems.tobit.filters import TobitKalmanFilter

PLACES = (-7.0, -5.0, -4.0, 0.0, 4.5, 5.0, 6.0)  # true x1 at which Lemma 1 is tried
_DRAWS = 200  # measurements an episode, at each of them
SHARES = ((0.5, 0.5), (0.9, 0.1), (0.1, 0.9))
SURE = 0.05  # predicted probability of no censoring, at most, of a surprise
# Filters on the same packets.
_SETTINGS: dict[str, Options] = {
    "paper": {}, "adf": {"filter": "adf"}, "kalman": {"filter": "kalman"},
    "free": {"filter": "kalman"} | FREE, "calm": {"bias_noise_covariance": [[0.0025]]},
}  # fmt: skip
# Where the bounds are tried: a head of the table, and what it stands for.
EXAMPLES: dict[str, tuple[str, Options]] = {
    "oscillator": (OSCILLATOR, {}),
    "oscillator, [-0.5, 0.5]": (OSCILLATOR, {"censoring_threshold": -0.5, "censoring_upper": 0.5}),
    "target, uncensored": (TRACKING, {}),
}
_ENVIRONMENTS = {"oscillator": OSCILLATOR, "target": TRACKING}
# Where the text leaves a choice. Upper bound: the sign of φ (Theorem 4 adds it, (15) with an
# infinite right threshold subtracts it), and whether the correction holds the filter's covariance,
# as printed, or the bound itself. Lower bound: whether the factor 1 - (1 - ᾱ - β̄)² stands at every
# step, as printed, or at the sensor's turns alone, and whether the process covariance stands whole
# or, as in (49), with the factor (1 - ᾱ - β̄)².
BOUNDS: tuple[tuple[str, str, tuple[Any, bool]], ...] = (
    ("upper", "as printed", (1.0, False)), ("upper", "the sign of φ as in (15)", (-1.0, False)),
    ("upper", "the bound in its own correction", (1.0, True)), ("upper", "both", (-1.0, True)),
    ("lower", "as printed", (False, False)), ("lower", "at the sensor's turns", (True, False)),
    ("lower", "as in (49)", (False, True)),
)  # fmt: skip
SHARE = 0.5  # ε of a node, the paper's 1/p


def simulate_theory(episodes: int, seed: int, settings: Settings) -> Data:
    """Return the data for the claims of Lemma 1, Theorems 1 and 2 and the remarks."""
    data = _lemma(episodes, seed) | _fusion(min(episodes, 200), seed)
    for example, env in _ENVIRONMENTS.items():
        values = _errors(env, episodes, seed)
        data |= {f"{example}_{name}": value for name, value in values.items()}
    for name, options in _SETTINGS.items():
        task = fusion_gym.make_task(OSCILLATOR, **options)
        errors = measures.squares(task, "round_robin", episodes, seed)
        data[f"mse_{name}"] = errors.sum(2).mean(1)
        data[f"armse_{name}"] = measures.armse(errors)["mean"]
    return data


def _lemma(episodes: int, seed: int) -> Plain:
    """Mean and variance of y at fixed states: simulated, with standard errors, and by Lemma 1."""
    sensors = censored(fusion_gym.make_task(OSCILLATOR)).centre.sensors
    draws, truth = episodes * _DRAWS, np.array([PLACES, *np.zeros((2, len(PLACES)))])
    noise = np.random.default_rng(seed).standard_normal((sensors.noise_channels, draws))
    repeated = (np.repeat(state[:, None], draws, axis=1) for state in truth.T)
    drawn = np.array([sensors.measure(state, noise)[0, 0] for state in repeated])
    spread, fourth = drawn.var(1, ddof=1), stats.moment(drawn, 4, axis=1)
    means = np.broadcast_to(truth, (sensors.count, *truth.shape))
    right = TobitKalmanFilter(sensors).expect(means)
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
    task, rows = fusion_gym.make_task(env), []
    for step, (batch, requests) in enumerate(walk(task, "round_robin", episodes, seed)):
        sensor, signals = step % task.sensors, batch.signals()
        prior = batch.state.plant.truth - batch.state.estimate.prior_mean
        values = signals["uncensored_probability"], np.logical_not(signals["censored"])
        inside, free = (np.array(value)[sensor, 0] for value in values)
        batch.step(requests)
        truth, estimate, *_ = batch.delivered
        error = task.plant.truth(truth) - task.estimator.mean(estimate)
        covariance = task.estimator.covariance(estimate)
        nees = linalg.dot(error, linalg.solve_vector(covariance, error)) / 3.0
        rows.append((prior[2], inside, free, nees))
    bias, inside, free, nees = map(np.array, zip(*rows, strict=True))
    return {
        "nees": nees.mean(0), "predicted": inside.mean(0), "uncensored": free.mean(0),
        "sure": (inside * (inside < SURE)).sum(0), "surprised": ((inside < SURE) & free).sum(0),
        "product": (bias[1:] * bias[:-1]).sum(0), "first": (bias[:-1] ** 2).sum(0),
        "second": (bias[1:] ** 2).sum(0),
    }  # fmt: skip


def _fusion(episodes: int, seed: int) -> Plain:
    """Return the change of the fused estimate with the shares ε, and with B = 0 with the bias."""

    def means(policy: str = "round_robin", **options: Any) -> Array:
        task = fusion_gym.make_task(OSCILLATOR, **options)
        mean = task.estimator.mean
        return record(task, policy, episodes, seed, lambda state: mean(state.estimate))

    split = np.array([means(information_shares=shares) for shares in SHARES])
    no_bias: Options = {"access": "any", "bias_gain": [[0.0], [0.0]]}
    without = [means("always", bias_aware=aware, **no_bias)[:, :2] for aware in (True, False)]
    return {
        "shares_gap": float(np.abs(split[1:] - split[0]).max()),
        "without_gap": float(np.abs(without[0] - without[1]).max()),
    }


# --- the bounds of Theorems 4 and 5 ---


class MatrixBound(NamedTuple):
    """A bound of a sensor's covariance P⁻: P^u or P^l of Theorem 4, in a reading.

    ``inflation`` is 1 for a single filter and ε⁻¹ for a node, whose process covariance is Q/ε by
    (27); ``reading`` is an entry of BOUNDS for its ``end``.
    """

    task: Task
    sensor: int
    inflation: float
    end: str
    reading: tuple[Any, bool]

    def advance(
        self, value: Array, covariance: Array, censoring: tuple[Array, Array, Array], turn: bool
    ) -> Array:
        """Return the next step's bound (states, states, N) from this one's.

        Args:
            value: The bound, (states, states, N).
            covariance: P⁻ of the filter, (states, states, N).
            censoring: α, 1 - α - β and φ of Theorem 4 without its sign, (sensors, N).
            turn: Whether the sensor has its turn.
        """
        estimator, (first, second) = censored(self.task), self.reading
        left, inside, narrowing = (value[self.sensor] for value in censoring)
        model, sensors, share = estimator.model, estimator.centre.sensors, np.ones(1)
        if self.end == "lower":
            inside = inside**2 * (turn or not first)
            value, share = (1.0 - inside) * value, inside if second else share
        elif turn:
            row = sensors.measurement_matrix[self.sensor, 0]
            cross = linalg.matvec(value if second else covariance, row)
            weight = (1.0 - left) ** 2
            noise = sensors.variance[self.sensor, 0] * (1.0 + first * narrowing)
            innovation = weight * linalg.dot(row, cross) + noise
            value = value - linalg.outer(cross, cross) * weight / innovation
        process = model.process_covariance * self.inflation * share
        return linalg.congruence(model.transition, value) + process


def failures(
    task: Task, policy: Policy | str, episodes: int, seed: int, sensors: list[int]
) -> Array:
    """Return shares (bounds, episodes) of an episode's steps in which each of BOUNDS fails.

    Of one sensor by Theorem 4; of both nodes by Theorem 5, which joins their bounds. The proof
    starts with P^u = P⁻ and P^l = 0.
    """
    joined, node = len(sensors) > 1, censored(task).centre.sensors
    inflation = 1.0 / SHARE if joined else 1.0
    bounds = [[MatrixBound(task, m, inflation, row[0], row[2]) for m in sensors] for row in BOUNDS]
    failed = np.zeros((len(bounds), episodes))
    for step, (batch, requests) in enumerate(walk(task, policy, episodes, seed)):
        covariance = batch.state.estimate.prior_covariance
        own, expected = covariance * inflation, batch.state.estimate.prediction.expectation
        low = (node.threshold - expected.latent) / node.deviation
        hazard, inside = gaussian.hazard(low), expected.uncensored_probability
        censoring = gaussian.upper_tail(-low)[:, 0], inside[:, 0], (hazard * (hazard - low))[:, 0]
        if step == 0:
            values = [[own * (item.end == "upper") for item in items] for items in bounds]
        for i, items in enumerate(bounds):
            if step:
                limit = _joined(values[i]) if joined else values[i][0]
                ends = limit, covariance[:2, :2] if joined else own
                failed[i] += ~matrix_below(*ends[:: -1 if items[0].end == "upper" else 1])
            values[i] = [
                item.advance(value, own, censoring, step % task.sensors == item.sensor)
                for item, value in zip(items, values[i], strict=True)
            ]
        batch.step(requests)
    return failed / (task.horizon - 1)


def matrix_below(first: Array, second: Array) -> NDArray[np.bool_]:
    """Return whether (N,) ``first`` ≤ ``second`` (n, n, N) up to rounding; false for NaN."""
    scale = np.maximum(linalg.trace(np.abs(first)), linalg.trace(np.abs(second)))
    gap = linalg.add_diagonal(second - first, np.broadcast_to(1e-9 * scale, second.shape[1:]))
    return np.asarray(np.isfinite(linalg.cholesky(gap)).all((0, 1)))


def _joined(parts: list[Array]) -> Array:
    """Return (Σ P_m⁻¹)⁻¹ of x, as Theorem 5 joins the bounds; NaN for an indefinite bound."""
    return linalg.inverse(sum(map(linalg.inverse, parts), np.zeros(1)))[:2, :2]


def simulate_bounds(episodes: int, seed: int, settings: Settings) -> Data:
    """Return shares of failures (examples, cases, bounds, episodes), also in the narrow interval.

    The cases are Theorem 4 at both sensors, and Theorem 5.
    """
    shares = []
    for env, options in EXAMPLES.values():
        task = fusion_gym.make_task(env, **options)
        turns = fusion_gym.make_policy("periodic:period=2", task)
        single = [failures(task, SomeSensors(turns, {m}), episodes, seed, [m]) for m in range(2)]
        shares.append([*single, failures(task, "round_robin", episodes, seed, [0, 1])])
    return {"shares": np.array(shares)}


def summarise_theory(data: Data) -> Data:
    """Return the table of the filter's consistency."""
    numbers = {
        **{f"NEES of the fused estimate, {name}": f"{name}_nees" for name in _ENVIRONMENTS},
        "share of uncensored packets, predicted by (9)": "oscillator_predicted",
        "share of uncensored packets, simulated": "oscillator_uncensored",
    }
    theory = [Number.from_sample(what, data[name]) for what, name in numbers.items()]
    return {"tables": {"theory": theory}}


def summarise_bounds(data: Data) -> Data:
    """Return the failure rates of the bounds of Theorems 4 and 5, by reading."""
    rows = {
        f"Theorem {theorem}, {end} bound, {reading}{which}": 100 * data["shares"][:, case, bound]
        for case, (theorem, which) in enumerate(((4, ", sensor 1"), (4, ", sensor 2"), (5, "")))
        for bound, (end, reading, _) in enumerate(BOUNDS)
    }
    return {"tables": {"bounds": grid(EXAMPLES, rows, "%")}}
