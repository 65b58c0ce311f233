"""The paper's filter against its printed equations in many digits, and the Tobit expectation."""

import math
from typing import Any

import mpmath
import numpy as np
import pytest
from filter_problems import (
    PAPER_EPSILON,
    Problem,
    make_bound_filter,
    outcomes,
    random_covariance,
    random_problem,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_tobit import (
    Example,
    event_error,
    exact_bound_update,
    exact_float,
    exact_matrix,
    kappas,
)
from scipy import stats

import fusion_gym
from fusion_gym import ConfigurationError
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.systems.tobit.filters import BoundConstants, EventError, TobitKalmanFilter
from fusion_gym.systems.tobit.sensors import CensoredSensors

OTHER_EPSILON = tuple(np.linspace(0.1, 1.4, 14).tolist())
NEVER_CENSORED = -math.inf


# --- the paper's constants -----------------------------------------------------------------------


def test_kappas_of_the_paper() -> None:
    constants = BoundConstants.create(PAPER_EPSILON)
    printed = (1.25, 26.714, 1.7, 23.1, 23.829, 21.7, 24.557, 2.429)
    assert constants.kappa == pytest.approx(printed, abs=5e-4)
    assert constants.second_moment == (2.0, 2.0)


@pytest.mark.parametrize("epsilon", [PAPER_EPSILON, OTHER_EPSILON])
def test_kappas_of_any_epsilon(epsilon: tuple[float, ...]) -> None:
    constants = BoundConstants.create(epsilon)
    assert constants.kappa == pytest.approx(kappas(epsilon), rel=1e-14)
    assert constants.second_moment == pytest.approx((1 + epsilon[13], 1 + 1 / epsilon[13]))


@pytest.mark.parametrize(
    ("epsilon", "value"),
    [((0.1,) * 13, "0.1"), ((0.1,) * 13 + (0.0,), " 0.0]"), ((-1.0,) * 14, "-1.0"), (0.1, "0.1")],
)
def test_bad_epsilons_are_refused(epsilon: Any, value: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        BoundConstants.create(epsilon)
    field, _, rest = str(refused.value).partition(" = ")
    assert field == "bound_epsilon"
    assert value in rest
    assert " is not allowed: " in rest


PAPER_TRIGGER = {
    "threshold": (0.1, 0.2, 0.3),
    "decay": (0.1, 0.2, 0.1),
    "divisor": 5.0,
    "initial": 1.5,
}


@pytest.mark.parametrize(
    "decay",
    [0.0, 0.1, 0.28, math.sqrt(0.08), 0.28284271247461895, 0.2828427, 0.29, 0.4],
    ids=lambda v: f"decay {v}",
)
def test_event_error_follows_its_recursion_for_every_growth(decay: float) -> None:
    # The growth 7.5 λ² + 0.4 is below, at and above one.
    error = EventError.create(PAPER_TRIGGER | {"decay": decay}, (1.5, 2.0), 3)
    values = error.at(np.array([1.0, 2.0, 30.0, 100.0]))
    example = Example(decay=(decay,) * 3)
    for sensor in range(3):
        for place, time in enumerate((1, 2, 30, 100)):
            expected = event_error(example, sensor, time)
            assert values[sensor, place] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "young", "field"),
    [({"threshold": -0.1}, (1.5, 2.0), "trigger_threshold"), ({}, (0.0, 1.0), "bound_young")],
)
def test_bad_trigger_numbers_are_refused(
    change: dict[str, Any], young: tuple[float, float], field: str
) -> None:
    with pytest.raises(ConfigurationError, match=rf"^{field} = .* is not allowed"):
        EventError.create(PAPER_TRIGGER | change, young, 3)


# --- the paper's filter against the printed equations ------------------------------------------


def check_against_print(
    problem: Problem,
    with_event_error: bool = True,
    epsilon: tuple[float, ...] = PAPER_EPSILON,
    digits: int = 80,
    tolerance: float = 1e-8,
) -> None:
    """Both outcomes at every sensor and lane, mean and bound, against (22), (30) and (37)."""
    sensors, time = problem.sensors, 3
    result = outcomes(make_bound_filter(sensors, with_event_error, epsilon), problem, time)
    count = sensors.count
    example = Example(
        matrices=(np.eye(1),) * count,
        sigma=tuple(np.linspace(0.1, 0.3, count)),
        decay=tuple(np.linspace(0.1, 0.25, count)),
        chi=tuple(np.linspace(4.0, 6.0, count)),
        eta=tuple(np.linspace(1.0, 2.0, count)),
    )
    for sensor in range(count):
        event = event_error(example, sensor, time) if with_event_error else 0.0
        for lane in range(problem.mean.shape[-1]):
            for silent in (False, True):
                received = (problem.held if silent else problem.value)[sensor, :, lane]
                with mpmath.workdps(digits):
                    exact_mean, exact_bound = exact_bound_update(
                        exact_matrix(problem.mean[sensor, :, lane]),
                        exact_matrix(problem.covariance[sensor, :, :, lane]),
                        exact_matrix(sensors.measurement_matrix[sensor, :, :, 0]),
                        sensors.variance[sensor, :, 0],
                        sensors.threshold[sensor, :, 0],
                        exact_matrix(received),
                        silent,
                        kappas(epsilon),
                        epsilon[13],
                        event,
                    )
                mean = result[2 * silent][sensor, :, lane]
                bound = result[2 * silent + 1][sensor, :, :, lane]
                where = f"sensor {sensor}, lane {lane}, {'held' if silent else 'delivered'}"
                prior = problem.mean[sensor, :, lane]
                expected = exact_float(exact_mean)[:, 0]
                room = tolerance * np.abs(expected - prior).max() + 1e-12 * np.abs(prior).max()
                assert np.abs(mean - expected).max() <= room, f"mean: {where}"
                # Relative in every direction: the eigenvalues of wanted⁻¹ found are all one.
                expected = exact_float(exact_bound)
                scale = 1.0 / np.sqrt(np.diagonal(expected))
                root = np.linalg.cholesky(scale[:, None] * expected * scale)
                excess = scale[:, None] * (bound - expected) * scale
                excess = np.linalg.solve(root, np.linalg.solve(root, excess).T)
                assert np.abs(excess).max() <= tolerance, f"bound: {where}"


@pytest.mark.parametrize("with_event_error", [True, False])
@pytest.mark.parametrize("threshold", [0.0, None], ids=["thresholds zero", "thresholds differ"])
@pytest.mark.parametrize(("size", "states"), [(1, 1), (1, 2), (2, 2), (2, 3), (3, 3)])
def test_paper_filter_is_the_printed_one(
    size: int, states: int, threshold: Any, with_event_error: bool
) -> None:
    problem = random_problem(10 * size + states, size, states, lanes=5, threshold=threshold)
    check_against_print(problem, with_event_error)


def test_paper_filter_is_the_printed_one_without_a_threshold() -> None:
    check_against_print(random_problem(6, 2, 2, lanes=5, threshold=NEVER_CENSORED))
    mixed = np.array([[NEVER_CENSORED, 0.3], [-0.2, NEVER_CENSORED]])
    check_against_print(random_problem(6, 2, 2, lanes=5, threshold=mixed))


@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.integers(1, 3),
    depth=st.lists(st.floats(-8.0, 10.0), min_size=3, max_size=3),
    level=st.floats(-5.0, 5.0),
    held_at_threshold=st.booleans(),
)
@settings(max_examples=40, deadline=None, derandomize=True)
def test_paper_filter_is_the_printed_one_wherever_the_prior_lies(
    seed: int, size: int, depth: list[float], level: float, held_at_threshold: bool
) -> None:
    """Every component its own standardised distance below the threshold."""
    problem = placed_problem(seed, size, depth[:size], level, held_at_threshold)
    check_against_print(problem, digits=200)


def placed_problem(
    seed: int, size: int, depth: list[float], level: float, held_at_threshold: bool
) -> Problem:
    """One sensor and lane, with the prior ``depth`` noise deviations below the thresholds.

    The measurement matrix is well conditioned, the held value lies at the threshold or above.
    """
    generator = np.random.default_rng(seed)
    matrix = np.eye(size) + 0.3 * generator.uniform(-1, 1, size=(size, size))
    variance = np.exp(generator.uniform(-1.0, 1.0, size))
    threshold = np.full(size, level)
    sensors = CensoredSensors.create(matrix[None], variance, threshold, size)
    latent = threshold - np.array(depth) * np.sqrt(variance)
    mean = np.linalg.solve(matrix, latent)[None, :, None]
    held = threshold + (0.0 if held_at_threshold else 1.0) * np.exp(generator.normal(size=size))
    value = threshold + np.maximum(generator.normal(size=size), 0.0)
    covariance = random_covariance(generator, size, 1)
    return Problem(sensors, mean, covariance[None], held[None, :, None], value[None, :, None])


# Standardised distances with probabilities of an uncensored value from 0.02 down to 1e-200.
DEPTHS = {0.02: 2.05, 1e-8: 5.61, 1e-12: 7.03, 1e-20: 9.26, 1e-60: 16.37, 1e-200: 30.21}


@pytest.mark.parametrize("probability", DEPTHS)
@pytest.mark.parametrize("held_at_threshold", [True, False], ids=["held at τ", "held above τ"])
@pytest.mark.parametrize("level", [0.0, -1.5])
@pytest.mark.parametrize("size", [2])
def test_paper_filter_is_the_printed_one_deep_in_censoring(
    size: int, level: float, held_at_threshold: bool, probability: float
) -> None:
    """All components far below their thresholds, then one only, then one at another depth."""
    deep = DEPTHS[probability]
    assert stats.norm.sf(deep) == pytest.approx(probability, rel=0.1)
    for depth in ([deep] * size, [deep, 0.3, -1.0][:size], [deep, 0.8 * deep, 0.5][:size]):
        problem = placed_problem(size, size, depth, level, held_at_threshold)
        check_against_print(problem, digits=600)


@pytest.mark.parametrize("spread", [1e-4, 1e4, 8e6])
def test_paper_filter_is_the_printed_one_for_starved_and_certain_priors(spread: float) -> None:
    problem = random_problem(31, 2, 2, lanes=4, threshold=0.0)
    check_against_print(problem._replace(covariance=spread * problem.covariance), tolerance=2e-8)


def test_holding_and_predicting_differ_only_without_a_delivery() -> None:
    problem = random_problem(7, 2, 2, lanes=6)
    held = outcomes(make_bound_filter(problem.sensors, hold=True), problem)
    predicted = outcomes(make_bound_filter(problem.sensors, hold=False), problem)
    assert np.array_equal(held[0], predicted[0])
    assert np.array_equal(held[1], predicted[1])
    assert np.array_equal(predicted[2], problem.mean)
    np.testing.assert_allclose(predicted[3], problem.covariance, rtol=1e-12)
    assert not np.allclose(held[2], problem.mean)


def test_holding_needs_independent_rows() -> None:
    sensors = CensoredSensors.create([[[1.0, 0.0], [2.0, 0.0]]], 0.5, 0.0, 2)
    with pytest.raises(ConfigurationError, match=r"measurement_matrices with row ranks \[1\]"):
        make_bound_filter(sensors, hold=True)
    assert make_bound_filter(sensors, hold=False).sensors is sensors


@pytest.mark.parametrize("kind", ["kalman", "tobit", "adf", "stochastic"])
def test_other_filters_take_two_equal_rows_for_one_of_half_the_variance(kind: str) -> None:
    weight = {"stochastic_weight": 1.0} if kind == "stochastic" else {}
    free = weight | {"filter": kind, "censoring_threshold": -np.inf}
    covariances = []
    for channels in (1, 2):
        rows, variance = [[[1.0, 0.0]] * channels], 0.5 * channels
        options = free | {"measurement_matrices": rows, "measurement_variance": variance}
        task = fusion_gym.make_task("fusion_gym/TobitOscillator-v1", **options)
        batch = EpisodeBatch.seeded(task, 1, seed=0)
        for _ in range(9):
            batch.step(np.ones((1, 1), dtype=np.bool_))
        covariances.append(batch.delivered.estimate.covariance)
    np.testing.assert_allclose(*covariances, rtol=1e-12)
    with pytest.raises(ConfigurationError, match="row ranks"):
        fusion_gym.make_task("fusion_gym/TobitOscillator-v1", measurement_matrices=rows)


@pytest.mark.parametrize("latent", [-4.0, -1.3, 0.0, 0.4, 2.5, 9.0])
@pytest.mark.parametrize("threshold", [-1.0, 0.0, 0.75])
@pytest.mark.parametrize("variance", [0.09, 0.5, 4.0])
def test_expectation_is_that_of_the_censored_normal(
    latent: float, threshold: float, variance: float
) -> None:
    sensors = CensoredSensors.create([[[2.0]]], variance, threshold, 1)
    expectation = TobitKalmanFilter(sensors).expect(np.array([[[latent / 2.0]]]))
    result = {name: float(value[0, 0, 0]) for name, value in expectation._asdict().items()}
    with mpmath.workdps(30):
        root = mpmath.sqrt(variance)
        nearest = mpmath.mpf(max(latent, threshold))
        ends = [nearest + root * step for step in (0, 0.1, 0.2, 0.4, 0.8, 1.6, 4, 20)]
        ends = [threshold, *ends] if threshold < latent else ends

        def beyond(power: int, about: Any) -> Any:
            """∫ over y > τ of (y - about)^power times the density."""
            return mpmath.quad(lambda y: (y - about) ** power * mpmath.npdf(y, latent, root), ends)

        inside, censored = beyond(0, 0), mpmath.ncdf(threshold, latent, root)
        mean = censored * threshold + beyond(1, 0)
        total_variance = censored * (threshold - mean) ** 2 + beyond(2, mean)
        truncated_mean = beyond(1, 0) / inside
        truncated_variance = beyond(2, truncated_mean) / inside
        expected = {
            "latent": latent,
            "uncensored_probability": float(inside),
            "value": float(mean),
            "noise_variance": float(total_variance),
            "hazard": float((truncated_mean - latent) / root),
            "truncated_variance": float(truncated_variance / variance),
        }
    assert result == pytest.approx(expected, rel=1e-8, abs=1e-14)
    assert result["uncensored_probability"] == pytest.approx(float(inside), rel=1e-9, abs=0.0)
