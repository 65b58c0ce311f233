"""Silence as information: against quadrature, a particle filter and the filters that ignore it."""

import itertools
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.estimator import Reception
from fusion_gym.core.task import Task
from fusion_gym.evaluation import run_episodes, summarise
from fusion_gym.validation import ConfigurationError

LINEAR = "fusion_gym/LinearFusion-v2"
REMOTE = "fusion_gym/RemoteEstimation-v1"
FREE = {"tokens": "unlimited"}


def make(trigger: str = "send_on_delta", threshold: Any = 2.0, **options: Any) -> Task:
    truncated = {"filter": "truncated", "trigger": trigger, "trigger_threshold": threshold}
    return fusion_gym.make_task(LINEAR, **truncated | options)


def moments(low: Any, high: Any, mean: Any, deviation: Any) -> tuple[Any, Any]:
    """Mean and variance of N(mean, deviation²) between two ends, by Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(200)
    ends = np.clip([low, high], mean - 12.0 * deviation, mean + 12.0 * deviation)
    y = ends.mean(0) + 0.5 * np.diff(ends, axis=0)[0] * nodes[:, None]
    weights = weights[:, None] * np.exp(-0.5 * ((y - mean) / deviation) ** 2)
    first = (weights * y).sum(0) / weights.sum(0)
    return first, (weights * (y - first) ** 2).sum(0) / weights.sum(0)


@pytest.mark.parametrize("trigger", ["send_on_delta", "report_on_change", "innovation_threshold"])
def test_a_silent_update_is_the_truncation_by_quadrature(trigger: str) -> None:
    batch = EpisodeBatch.seeded(make(trigger, (0.7, 1e6), **FREE), 50, 0)
    for step in range(20):
        state, sensors = batch.state.estimate, batch.task.estimator.centre.sensors
        row = sensors.measurement_matrix[0, 0, :, 0]
        across = np.einsum("ijn,j->in", state.prior_covariance, row)
        variance = row @ across + sensors.variance[0, 0, 0]
        mean = row @ state.prior_mean
        middle = mean if trigger == "innovation_threshold" else state.held[0, 0]
        width = 0.7 if trigger == "innovation_threshold" else 0.7 * (1.0 - 1e-6)
        first, second = moments(middle - width, middle + width, mean, variance**0.5)
        gain = across / variance
        sent = np.zeros((2, 50), dtype=np.bool_)
        silent = batch.task.estimator.update(state, Reception(sent))
        expected = state.prior_mean + gain * (first - mean)
        np.testing.assert_allclose(silent.mean, expected, atol=1e-8)
        loss = gain[:, None] * gain * (variance - second)
        np.testing.assert_allclose(silent.covariance, state.prior_covariance - loss, atol=1e-8)
        sent[step % 2] = np.arange(50) % 5 == step % 5
        batch.step(sent)


def test_two_silent_sensors_are_the_truncation_by_quadrature() -> None:
    """Within half a hundredth of a deviation, beside a delivery and a threshold of zero."""
    options = {
        "measurement_matrices": [[[1.0, 0.0], [0.9, 0.3]], [[1.0, 0.2]], [[0.0, 1.0]]],
        "measurement_covariances": [0.05, 0.1, 0.1],
    }
    runs, thresholds = 10, (0.6, 0.6, 0.8)
    batch = EpisodeBatch.seeded(
        make("report_on_change", (0.6, 0.8, 0.0), **options, **FREE), runs, 0
    )
    estimator = batch.task.estimator
    sensors, line = estimator.centre.sensors, np.linspace(-7.0, 7.0, 201)
    grid = np.stack(np.meshgrid(line, line)).reshape(2, -1)
    rows = sensors.measurement_matrix.reshape(-1, 2)[[0, 1, 2, 4]]
    deviations = sensors.deviation.reshape(-1)[[0, 1, 2, 4]]
    for step in range(8):
        state, sent = batch.state.estimate, np.zeros((3, runs), dtype=np.bool_)
        sent[2] = step % 3 == 1
        silent = estimator.update(state, Reception(sent))
        for run in range(runs):
            root = np.linalg.cholesky(state.prior_covariance[..., run])
            x = state.prior_mean[:, run, None] + root @ grid
            weight, z = norm.pdf(grid).prod(0), rows @ x
            held = state.held.reshape(-1, runs)[[0, 1, 2, 4], run]
            for row in range(3):
                ends = [
                    (held[row] + s * thresholds[row] - z[row]) / deviations[row] for s in (1, -1)
                ]
                weight *= norm.cdf(ends[0]) - norm.cdf(ends[1])
            if sent[2, run]:
                weight *= norm.pdf(state.measurement[2, 0, run], z[3], deviations[3])
            weight /= weight.sum()
            apart = x - (mean := x @ weight)[:, None]
            whiten = np.linalg.inv(np.linalg.cholesky(apart * weight @ apart.T))
            np.testing.assert_allclose(whiten @ (silent.mean[:, run] - mean), 0.0, atol=0.005)
            spread = whiten @ silent.covariance[..., run] @ whiten.T
            np.testing.assert_allclose(spread, np.eye(2), atol=0.006)
        batch.step(sent | (np.arange(runs) % 4 == step % 4))


def test_silence_of_a_lossy_source_is_a_mixture_by_quadrature() -> None:
    """Inside the interval silence is certain, outside it has the probability of a loss."""
    options = {"channel": "independent", "drop_probability": 0.3, "coefficient": 0.9}
    task = fusion_gym.make_task(
        REMOTE, filter="truncated", trigger="send_on_delta", trigger_threshold=1.4, **options
    )
    batch = EpisodeBatch.seeded(task, 40, 0)
    nodes, weights = np.polynomial.legendre.leggauss(400)
    width = 1.4 * (1.0 - 1e-6)
    for step in range(12):
        state = batch.state.estimate
        mean, deviation = state.prior[0], state.prior_variance[0] ** 0.5
        middle, total = state.held[0], np.zeros((3, 40))
        edges = [mean - 12 * deviation, middle - width, middle + width, mean + 12 * deviation]
        for low, high in itertools.pairwise(np.sort(edges, axis=0)):
            x = 0.5 * (low + high) + 0.5 * (high - low) * nodes[:, None]
            density = norm.pdf(x, mean, deviation) * np.where(abs(x - middle) < width, 1.0, 0.3)
            mass = 0.5 * (high - low) * weights[:, None] * density
            total += [(mass * x**k).sum(0) for k in range(3)]
        first = total[1] / total[0]
        reception = Reception(np.zeros((1, 40), dtype=np.bool_), failure=np.full((1, 40), 0.3))
        silent = task.estimator.update(state, reception)
        np.testing.assert_allclose(silent.mean[0], first, atol=1e-8)
        np.testing.assert_allclose(silent.variance[0], total[2] / total[0] - first**2, atol=1e-8)
        batch.step((np.arange(40) % 6 == step % 6)[None])


def test_the_variance_of_a_silent_source_is_its_squared_error() -> None:
    for options in ({}, {"channel": "independent"}):
        results = []
        for name in ("truncated", "symmetric"):
            trigger: dict[str, Any] = {"trigger": "send_on_delta", "trigger_threshold": 2.0}
            chosen = trigger if name == "truncated" else {}
            task = fusion_gym.make_task(REMOTE, filter=name, **chosen, **options)
            results.append(figures(task, "send_on_delta:threshold=2"))
        ours, theirs = (result["mse"]["mean"] for result in results)
        assert ours == pytest.approx(theirs, rel=1e-9)  # a symmetric interval leaves the mean
        claimed = [result["bound_trace"]["mean"] for result in results]
        assert abs(claimed[0] / ours - 1.0) < 0.15 < abs(claimed[1] / ours - 1.0)


def test_silence_without_tokens_is_no_information() -> None:
    options: dict[str, Any] = {"token_rate": 1.0, "initial_tokens": 6.0}
    task, plain = make(**options), fusion_gym.make_task(LINEAR, **options)
    batches = [EpisodeBatch.seeded(t, 4, 0) for t in (task, plain)]
    for batch in batches:
        batch.step(np.ones((2, 4), dtype=np.bool_))  # six tokens, of which one returns
        batch.step(np.zeros((2, 4), dtype=np.bool_))
    ours, theirs = (batch.delivered.estimate for batch in batches)
    np.testing.assert_allclose(ours.mean, theirs.mean, atol=1e-12)
    np.testing.assert_allclose(ours.covariance, theirs.covariance, atol=1e-12)


def figures(task: Task, rule: str, episodes: int = 1000) -> dict[str, Any]:
    return summarise(run_episodes(task, fusion_gym.make_policy(rule, task), episodes, 0))


@pytest.mark.parametrize("threshold", [1.0, 2.1])
def test_silence_beats_hold_and_a_filter_that_ignores_it(threshold: float) -> None:
    """At rates .22 and .05; the lead exceeds a fifth at .05, and the covariance is honest."""
    rule = f"send_on_delta:threshold={threshold}"
    truncated = figures(make(threshold=threshold, **FREE), rule)
    assert 0.9 < truncated["nees"]["mean"] < 1.15
    for kind in ("hold", "kalman"):
        other = figures(fusion_gym.make_task(LINEAR, filter=kind, **FREE), rule)
        np.testing.assert_allclose(other["rate"], truncated["rate"], atol=1e-12)
        assert truncated["mse"]["high"] < 0.8 * other["mse"]["low"]


def test_denied_requests_leave_the_covariance_honest() -> None:
    task = make(threshold=1.5, token_rate=1.0, initial_tokens=3.0, token_capacity=6.0)
    result = figures(task, "send_on_delta")
    denied = np.sum(result["denied"]["mean"]) / np.sum(result["requests"])
    assert 0.1 < denied < 0.2
    assert 0.8 < result["nees"]["mean"] < 1.35


@pytest.mark.slow
@pytest.mark.parametrize("threshold", [1.0, 2.0])
def test_the_error_is_that_of_a_particle_filter(threshold: float) -> None:
    """Within 2 %, on the same 150 runs of 60 steps with 1,500 particles each."""
    runs, particles, task = 150, 1500, make(threshold=threshold, **FREE)
    batch, model = EpisodeBatch.seeded(task, runs, 0), task.estimator.model
    rule, rng = fusion_gym.make_policy("send_on_delta", task), np.random.default_rng(0)
    transition = model.transition[..., 0]
    factor = np.linalg.cholesky(model.process_covariance[..., 0])
    deviation = task.estimator.centre.sensors.deviation[:, 0, 0]
    start = batch.state.estimate.held[:, 0]  # both states are measured at the start
    gain = 1.0 / (1.0 + deviation**2)[:, None]
    mean, spread = gain * start, (1.0 - gain[:, 0]) ** 0.5
    cloud = mean[..., None] + spread[:, None, None] * rng.normal(size=(2, runs, particles))
    errors = np.zeros(2)
    for _ in range(60):
        noise = np.tensordot(factor, rng.normal(size=cloud.shape), 1)
        cloud = np.tensordot(transition, cloud, 1) + noise
        state = batch.state.estimate
        held, measurement = state.held[:, 0], state.measurement[:, 0]
        requests = rule(batch.signals())
        batch.step(requests)
        weights = np.ones((runs, particles))
        for s in range(2):
            ends = (held[s][:, None] + side * threshold for side in (-1.0, 1.0))
            low, high = (norm.cdf((end - cloud[s]) / deviation[s]) for end in ends)
            density = norm.pdf((measurement[s][:, None] - cloud[s]) / deviation[s])
            weights *= np.where(requests[s][:, None], density, high - low)
        weights /= weights.sum(1, keepdims=True)
        state = batch.delivered.estimate
        for place, estimate in enumerate((state.mean, (weights * cloud).sum(-1))):
            errors[place] += ((batch.delivered.plant.truth - estimate) ** 2).sum()
        steps = (rng.random((runs, 1)) + np.arange(particles)) / particles
        chosen = [
            np.searchsorted(np.cumsum(w), x).clip(max=particles - 1)
            for w, x in zip(weights, steps, strict=True)
        ]
        cloud = np.take_along_axis(cloud, np.stack(chosen)[None], axis=-1)
    assert errors[0] / errors[1] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"trigger": None}, ("trigger = None", "filter='truncated'")),
        ({"trigger_threshold": -1.0}, ("trigger_threshold = -1.0", ">= 0")),
        ({"trigger_threshold": [1.0, 2.0, 3.0]}, ("trigger_threshold", "shape (2,)")),
        ({"censoring_threshold": 0.0}, ("filter = 'truncated'", "censored")),
        ({"measurement_matrices": [[[1, 0], [0, 1]]]}, ("trigger", "'report_on_change'")),
        ({"filter": "kalman"}, ("trigger = 'send_on_delta'", "filter='kalman'")),
    ],
)
def test_what_does_not_fit_is_refused(options: dict[str, Any], words: tuple[str, ...]) -> None:
    with pytest.raises(ConfigurationError) as error:
        make(**options)
    assert all(word in str(error.value) for word in words)


@pytest.mark.parametrize(
    "rule",
    ["always", "send_on_delta:threshold=1", "send_on_delta:min_interval=2", "report_on_change"],
)
def test_other_policies_are_refused(rule: str) -> None:
    with pytest.raises(ConfigurationError, match=r"^policy = .*truncated.*SendOnDelta"):
        fusion_gym.make_policy(rule, make())
    fusion_gym.make_policy("send_on_delta:max_interval=9", make())
