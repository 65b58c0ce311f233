"""Parts of the Markov jump system against plain loops, closed forms and samples."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from reference_markov_jump import PAPER, Dense, best_weights, options, random_model

from fusion_gym.fusion.rules import MatrixWeightedFusion
from fusion_gym.systems.markov_jump.environment import MarkovJumpTrackingOptions
from fusion_gym.systems.markov_jump.linear_minimum_variance import (
    AugmentedModel,
    LagRecursion,
    LocalFilters,
)
from fusion_gym.systems.markov_jump.plant import FadingSensors, MarkovJumpPlant

Array = NDArray[np.float64]


def parts(model: dict[str, Any]) -> tuple[MarkovJumpPlant, FadingSensors]:
    own = MarkovJumpTrackingOptions(**options(model))
    plant = MarkovJumpPlant.create(own)
    return plant, FadingSensors.create(own, plant)


def filters_of(model: dict[str, Any], horizon: int = 50) -> LocalFilters:
    return LocalFilters.create(AugmentedModel.create(*parts(model)), horizon)


# --- plant and sensors ---------------------------------------------------------------------------


def test_paper_plant_is_mean_square_stable_though_one_motion_is_not() -> None:
    plant, sensors = parts(PAPER)
    assert np.abs(np.linalg.eigvals(PAPER["transitions"][1])).max() == pytest.approx(1.0)
    assert plant.second_moment_radius() == pytest.approx(0.8365, abs=5e-5)
    squares = AugmentedModel.create(plant, sensors).state_moments(200)[1]
    assert squares[-1].sum() == pytest.approx(6.81, abs=5e-3)


def test_moments_and_modes_of_samples_follow_an_asymmetric_chain() -> None:
    model, runs, steps = random_model(3), 200_000, 6
    plant, sensors = parts(model)
    draw = np.random.default_rng(1)
    state, mode = plant.start(draw.standard_normal((plant.size + 1, runs)))
    noise = plant.process_noise(draw.standard_normal((plant.noise_channels, runs)))
    share = model["pi"]
    for _ in range(steps):
        state = plant.advance(state, mode, noise)
        mode = plant.jump(mode, draw.standard_normal(runs))
        noise = plant.process_noise(draw.standard_normal((plant.noise_channels, runs)))
        share = share @ model["chain"]
    means, squares = AugmentedModel.create(plant, sensors).state_moments(steps)
    deviation = state.std(1) / np.sqrt(runs)
    assert (np.abs(state.mean(1) - means[-1]) <= 5 * deviation).all()
    spread = (state**2).std(1) / np.sqrt(runs)
    assert (np.abs((state**2).mean(1) - squares[-1]) <= 5 * spread).all()
    values = np.bincount(mode, minlength=3) / runs
    np.testing.assert_allclose(values, share, atol=5 * 0.5 / np.sqrt(runs))
    # The other direction of the chain would not fit.
    wrong = model["pi"] @ np.linalg.matrix_power(model["chain"].T, steps)
    assert np.abs(values - wrong).max() > 0.05


def test_fading_has_the_papers_moments_and_frequencies() -> None:
    _, sensors = parts(PAPER)
    np.testing.assert_allclose(sensors.fading_mean, [0.65, 0.39, 0.45])
    np.testing.assert_allclose(sensors.fading_variance, [0.09, 0.0499, 0.0585])
    runs = 100_000
    fading = sensors.fading(np.random.default_rng(2).standard_normal((3, runs)))
    for sensor in range(3):
        for value, share in zip(PAPER["values"][sensor], PAPER["shares"][sensor], strict=True):
            result = (fading[sensor] == value).mean()
            assert result == pytest.approx(share, abs=5 * 0.5 / np.sqrt(runs))


def test_measurements_carry_the_noise_that_moves_the_plant_next() -> None:
    model, runs = random_model(4), 200_000
    plant, sensors = parts(model)
    draw = np.random.default_rng(5)
    normals = draw.standard_normal((plant.noise_channels, runs))
    noise = plant.process_noise(normals)
    mode = np.zeros(runs, dtype=np.int64)
    zero = np.zeros((plant.size, runs))
    own = draw.standard_normal((sensors.noise_channels, runs))
    values = np.cov(np.concatenate((noise, sensors.measure(zero, mode, noise, own))))
    q, alpha = model["noise"], model["coupling"]
    expected = np.block([[q, q @ alpha.T], [alpha @ q, alpha @ q @ alpha.T]])
    expected[2:, 2:] += np.diag(model["variance"])
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (np.abs(values - expected) / scale).max() <= 5 * np.sqrt(2 / runs)
    state = draw.standard_normal((plant.size, runs))
    for number in range(plant.modes):
        mode[:] = number
        observed = sensors.measure(state, mode, 0.0 * noise, own)
        observed -= sensors.deviation * own[sensors.count :]
        matrix = model["matrices"][:, number]
        np.testing.assert_allclose(
            observed, sensors.fading(own[: sensors.count]) * (matrix @ state), atol=1e-12
        )


# --- local filters -------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_gains_are_the_best_linear_ones(seed: int) -> None:
    """Errors are orthogonal to the innovation, and what is predicted from it too."""
    filters = filters_of(random_model(seed))
    for node in range(4):
        sampled = np.abs(filters.gain[node]).max(0) > 0.0
        assert sampled.any()
        scale = np.abs(filters.covariance[node, node]).max()
        for cross in (filters.filtered_cross, filters.predicted_cross):
            assert np.abs(cross[node, node][:, sampled]).max() <= 1e-10 * scale


def test_steady_traces_of_the_paper() -> None:
    traces = LagRecursion.create(filters_of(PAPER), 2).local_trace
    last = traces[:, -6:]
    np.testing.assert_allclose(last[0], 1.684, atol=5e-4)
    np.testing.assert_allclose(np.unique(last[1].round(3)), [1.905, 2.223])
    np.testing.assert_allclose(np.unique(last[2].round(3)), [2.491, 2.654, 3.219])


def test_tables_end_when_periodic_and_stand_for_all_later_times() -> None:
    short, long = filters_of(PAPER, 5), filters_of(PAPER, 5000)
    assert short.length == long.length < 250
    assert short.period == 6
    times = np.arange(0, 3000, 7)
    place = short.at(times)
    assert place.max() < short.length
    assert ((place - times) % 6 == 0).all()
    np.testing.assert_array_equal(place[times < short.length], times[times < short.length])
    # Periods whose common multiple is longer than any episode.
    slow = filters_of(PAPER | {"periods": [47, 53, 59]}, 20)
    assert slow.length > 1000
    assert (slow.at(np.array([10**6])) < slow.length).all()


# --- the joint recursion -------------------------------------------------------------------------


def compare(model: dict[str, Any], pattern: NDArray[np.bool_], tolerance: float = 1e-9) -> None:
    """Library against the dense recursion; ``pattern`` (steps, sensors, runs) of packets."""
    n, runs = len(model["mean"]), pattern.shape[-1]
    recursion = LagRecursion.create(filters_of(model, len(pattern)), n)
    fusion, dense = MatrixWeightedFusion(), [Dense(model) for _ in range(runs)]
    lags = recursion.start(runs)
    for time, sent in enumerate(pattern):
        place = recursion.filters.at(np.full(runs, time))
        joint = recursion.prediction(lags, place).joint(sent)
        fused = fusion.fuse(np.zeros((len(sent), n, runs)), joint).covariance
        for run, other in enumerate(dense):
            expected = other.copies(sent[:, run])
            result = joint[..., run].transpose(0, 2, 1, 3).reshape(expected.shape)
            scale = np.abs(expected).max()
            np.testing.assert_allclose(result, expected, atol=tolerance * scale)
            assert np.linalg.eigvalsh(result)[0] >= -1e-10 * scale
            best = best_weights(expected, n)[1]
            np.testing.assert_allclose(fused[..., run], best, atol=1e-3 * scale)
            assert np.trace(fused[..., run]) <= np.trace(best) + 2e-5 * scale
            other.send(sent[:, run])
        lags = recursion.predict(lags, sent, place)


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10**6), rate=st.floats(0.0, 1.0))
def test_joint_covariance_of_the_paper_agrees_with_dense_matrices(seed: int, rate: float) -> None:
    compare(PAPER, np.random.default_rng(seed).random((25, 3, 3)) < rate)


@pytest.mark.parametrize(("modes", "n", "r", "sensors"), [(3, 2, 2, 4), (2, 3, 1, 2), (1, 1, 2, 1)])
def test_joint_covariance_of_other_sizes(modes: int, n: int, r: int, sensors: int) -> None:
    for seed in range(3):
        model = random_model(seed, modes, n, r, sensors)
        draw = np.random.default_rng(seed)
        compare(model, draw.random((20, sensors, 2)) < draw.random((sensors, 1)))


# --- fusion --------------------------------------------------------------------------------------


def random_joint(seed: int, sensors: int, n: int, runs: int, rank: int) -> Array:
    draw = np.random.default_rng(seed)
    root = draw.normal(size=(sensors, n, rank, runs))
    return np.einsum("iakr,jbkr->ijabr", root, root)


def as_matrix(joint: Array, run: int) -> Array:
    sensors, _, n, _, _ = joint.shape
    return joint[..., run].transpose(0, 2, 1, 3).reshape(sensors * n, sensors * n)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    sensors=st.integers(1, 4),
    n=st.integers(1, 3),
    exponent=st.integers(-6, 6),
)
def test_weights_are_optimal_for_a_regular_joint_covariance(
    seed: int, sensors: int, n: int, exponent: int
) -> None:
    units = 10.0 ** (exponent * np.arange(n) / 3)  # states in very different units
    joint = random_joint(seed, sensors, n, 3, sensors * n + 2)
    joint *= (units[:, None] * units)[..., None]
    means = np.random.default_rng(seed).normal(size=(sensors, n, 3)) * units[:, None]
    fused = MatrixWeightedFusion().fuse(means, joint)
    mean, covariance = fused.mean, fused.covariance
    e = np.kron(np.ones((sensors, 1)), np.eye(n))
    scale = np.kron(np.ones(sensors), units)
    for run in range(3):
        sigma = as_matrix(joint, run) / np.outer(scale, scale)
        information = np.linalg.inv(sigma)
        best = np.linalg.inv(e.T @ information @ e)
        expected = best @ e.T @ information @ (means[..., run].reshape(-1) / scale)
        result = covariance[..., run] / np.outer(units, units)
        np.testing.assert_allclose(result, best, rtol=1e-6, atol=1e-7 * np.abs(best).max())
        np.testing.assert_allclose(mean[:, run] / units, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("rank", [1, 2, 3, 4, 5])
def test_singular_joint_covariances_agree_with_pseudo_inverses(rank: int) -> None:
    joint = random_joint(rank, 3, 2, 50, rank)
    weights = MatrixWeightedFusion().weights(joint)
    covariance = MatrixWeightedFusion().fuse(np.zeros((3, 2, 50)), joint).covariance
    whole = np.eye(2)[..., None].repeat(50, 2)
    np.testing.assert_allclose(weights.sum(0), whole, atol=1e-12 * np.abs(weights).max())
    for run in range(50):
        expected = best_weights(as_matrix(joint, run), 2)[1]
        np.testing.assert_allclose(covariance[..., run], expected, atol=1e-6)


def test_an_estimate_that_comes_twice_changes_nothing() -> None:
    joint = random_joint(1, 2, 2, 4, 6)
    means = np.random.default_rng(0).normal(size=(2, 2, 4))
    pair = MatrixWeightedFusion().fuse(means, joint)
    for order in ([0, 1, 1], [0, 0, 1], [1, 0, 1], [1, 1, 0, 0]):
        many = MatrixWeightedFusion().fuse(means[order], joint[np.ix_(order, order)])
        np.testing.assert_allclose(many.mean, pair.mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(many.covariance, pair.covariance, rtol=1e-9, atol=1e-9)
