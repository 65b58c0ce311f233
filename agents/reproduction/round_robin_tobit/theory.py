"""What Lemma 1, the theorems and the remarks of round_robin_tobit are judged by."""

from typing import Any

import numpy as np

import fusion_gym
from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.runs import Outcome
from fusion_gym.systems.tobit.tobit_filter import expect_censored

from . import bounds
from .readings import PrintedTobitFilter
from .runs import FREE, OSCILLATOR, TRACKING, armse, censored, round_robin, scheduled, squares, walk

PLACES = (-7.0, -5.0, -4.0, 0.0, 4.5, 5.0, 6.0)  # true x1 at which Lemma 1 is tried
_DRAWS = 200  # measurements an episode, at each of them
SHARES = ((0.5, 0.5), (0.9, 0.1), (0.1, 0.9))
SURE = 0.05  # predicted probability of no censoring, at most, of a surprise
# Where the bounds are tried: a head of the table, and what it stands for.
EXAMPLES: dict[str, tuple[str, dict[str, Any]]] = {
    "oscillator": (OSCILLATOR, {}),
    "oscillator, [-0.5, 0.5]": (OSCILLATOR, {"censoring_threshold": -0.5, "censoring_upper": 0.5}),
    "target, uncensored": (TRACKING, {}),
}


def compute_theory(episodes: int, seed: int) -> dict[str, Any]:
    """What the claims of Lemma 1, Theorems 1 and 2 and the remarks are judged by."""
    return {
        **_lemma(episodes, seed),
        **{
            f"{name}_{key}": value
            for name, env in (("oscillator", OSCILLATOR), ("target", TRACKING))
            for key, value in _errors(env, episodes, seed).items()
        },
        **_fusion(min(episodes, 200), seed),
        **_worth(episodes, seed),
    }  # fmt: skip


def _lemma(episodes: int, seed: int) -> dict[str, Any]:
    """Mean and variance of y at fixed states: simulated, with standard errors, and by Lemma 1."""
    sensors = censored(fusion_gym.make_task(OSCILLATOR)).centre.sensors
    places, draws = np.array(PLACES), episodes * _DRAWS
    truth = np.zeros((3, len(places)))
    truth[0] = places
    noise = np.random.default_rng(seed).standard_normal((sensors.noise_channels, draws))
    drawn = np.stack(
        [
            sensors.measure(np.repeat(truth[:, [i]], draws, axis=1), noise)[0, 0]
            for i in range(len(places))
        ]
    )
    spread = drawn.var(1, ddof=1)
    fourth = ((drawn - drawn.mean(1, keepdims=True)) ** 4).mean(1)
    means = np.broadcast_to(truth, (sensors.count, *truth.shape))
    right = expect_censored(sensors, means)
    printed = PrintedTobitFilter(sensors, "theta").expect(means)
    return {
        "mean": drawn.mean(1),
        "mean_error": np.sqrt(spread / draws),
        "variance": spread,
        "variance_error": np.sqrt(np.maximum(fourth - spread**2, 0.0) / draws),
        "equation_12": right.value[0, 0],
        "equation_12_printed": printed.value[0, 0],
        "equation_13": sensors.variance[0, 0] * right.truncated_variance[0, 0],
        "total_variance": right.noise_variance[0, 0],
    }


def _errors(env: str, episodes: int, seed: int) -> dict[str, Any]:
    """Consistency, censoring probabilities and correlation in time, along the round robin."""
    task = fusion_gym.make_task(env)
    names = ("nees", "predicted", "uncensored", "sure", "surprised", "product", "first", "second")
    values = {name: np.zeros(episodes) for name in names}
    last = np.zeros((episodes, 3))

    def before(batch: EpisodeBatch, step: int, runs: slice) -> None:
        error = batch.state.truth - batch.state.prior_mean
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

    def look(batch: EpisodeBatch, outcome: Outcome, step: int, runs: slice) -> None:
        assert np.all(scheduled(outcome) == step % task.sensors)
        mean, covariance = task.system.fused(batch.delivered)
        error = task.system.truth(batch.delivered) - mean
        values["nees"][runs] += linalg.dot(error, linalg.solve_vector(covariance, error)) / 3.0

    walk(task, round_robin(task), episodes, seed, look, before)
    for name in ("nees", "predicted", "uncensored"):
        values[name] /= task.horizon
    return values


def _fusion(episodes: int, seed: int) -> dict[str, Any]:
    """How far the fused estimate moves with the shares ε, and with B = 0 with the bias."""
    means = []
    for shares in SHARES:
        task = fusion_gym.make_task(OSCILLATOR, information_shares=list(shares))
        means.append(_means(task, episodes, seed))
    without = [
        _means(
            fusion_gym.make_task(
                OSCILLATOR, access="any", bias_gain=[[0.0], [0.0]], bias_aware=aware
            ),
            episodes, seed, "always",
        )[..., :2, :]
        for aware in (True, False)
    ]  # fmt: skip
    return {
        "shares_gap": float(max(np.abs(other - means[0]).max() for other in means[1:])),
        "without_gap": float(np.abs(without[0] - without[1]).max()),
    }


def _means(task: Any, episodes: int, seed: int, policy: str = "round_robin") -> Array:
    values = np.empty((task.horizon, 3, episodes))

    def look(batch: EpisodeBatch, outcome: Outcome, step: int, runs: slice) -> None:
        values[step, :, runs] = task.system.fused(batch.delivered)[0]

    walk(task, fusion_gym.make_policy(policy, task), episodes, seed, look)
    return values


def _worth(episodes: int, seed: int) -> dict[str, Any]:
    """Squared errors (episodes,), summed over states, of other filters on the same measurements."""
    settings: dict[str, dict[str, Any]] = {
        "paper": {}, "adf": {"filter": "adf"}, "kalman": {"filter": "kalman"},
        "free": {"filter": "kalman"} | FREE, "calm": {"bias_noise_covariance": [[0.0025]]},
    }  # fmt: skip
    data: dict[str, Any] = {}
    for name, options in settings.items():
        task = fusion_gym.make_task(OSCILLATOR, **options)
        errors = squares(task, round_robin(task), episodes, seed)
        data[f"mse_{name}"] = errors.sum(2).mean(1)
        data[f"armse_{name}"] = armse(errors)["mean"]
    return data


def compute_bounds(episodes: int, seed: int) -> dict[str, Any]:
    """Failures of the bounds of Theorems 4 and 5 in both examples, and in the narrow interval."""
    return {
        f"{name}:{key}": value
        for name, (env, options) in EXAMPLES.items()
        for key, value in bounds.compute_bound_recursion(env, episodes, seed, **options).items()
    }
