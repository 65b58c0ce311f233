"""The node filters against FilterPy, quadrature, and the printed equations in many digits."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import mpmath
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter as FilterPyFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from reference_tobit import (
    Example,
    event_error,
    exact_bound_update,
    exact_float,
    exact_matrix,
    kappas,
)
from scipy import stats

from fusion_gym import ConfigurationError
from fusion_gym.filters import (
    BoundConstants,
    BoundTobitFilter,
    EventError,
    KalmanFilter,
    NodeFilter,
    TobitKalmanFilter,
)
from fusion_gym.sensors import CensoredSensors

Array = NDArray[np.float64]
PAPER_EPSILON = (0.05,) * 5 + (0.7,) * 8 + (1.0,)
OTHER_EPSILON = tuple(np.linspace(0.1, 1.4, 14).tolist())
NEVER_CENSORED = -math.inf


class Problem(NamedTuple):
    """Sensors and priors: mean (sensors, n, N), covariance (sensors, n, n, N), held, value."""

    sensors: CensoredSensors
    mean: Array
    covariance: Array
    held: Array
    value: Array


def random_covariance(generator: np.random.Generator, size: int, lanes: int) -> Array:
    """Random positive definite matrices (size, size, lanes) with unequal scales."""
    factor = generator.normal(size=(size, size + 2, lanes))
    factor *= np.exp(generator.normal(size=(size, 1, lanes)))
    return np.einsum("ikn,jkn->ijn", factor, factor)


def random_problem(
    seed: int, size: int, states: int, lanes: int, threshold: Any = None, count: int = 2
) -> Problem:
    """Sensors that differ in everything, and a prior for each sensor and lane."""
    generator = np.random.default_rng(seed)
    if threshold is None:
        threshold = generator.normal(size=(count, size))
    sensors = CensoredSensors.create(
        generator.normal(size=(count, size, states)),
        np.exp(generator.normal(size=(count, size))),
        threshold,
        states,
    )
    low = np.maximum(sensors.threshold, -3.0)
    shape = (count, size, lanes)
    held = np.maximum(generator.normal(scale=2.0, size=shape), low)
    value = np.maximum(generator.normal(scale=2.0, size=shape), low)
    mean = generator.normal(scale=2.0, size=(count, states, lanes))
    spread = [random_covariance(generator, states, lanes) for _ in range(count)]
    return Problem(sensors, mean, np.stack(spread), held, value)


def outcomes(
    node_filter: NodeFilter, problem: Problem, time: int = 3
) -> tuple[Array, Array, Array, Array]:
    """Delivered mean and covariance, silent mean and covariance."""
    expectation = node_filter.expect(problem.mean)
    times = np.full(problem.mean.shape[-1], float(time))
    plan = node_filter.plan(problem.mean, problem.covariance, expectation, problem.held, times)
    innovation = problem.value - expectation.value
    delivered = problem.mean + np.einsum("smkN,smN->skN", plan.correction, innovation)
    return delivered, plan.delivered_covariance, plan.silent_mean, plan.silent_covariance


# --- uncensored filters against FilterPy -------------------------------------------------------


def filterpy_filter(problem: Problem, sensor: int, lane: int) -> Any:
    states, size = problem.mean.shape[1], problem.sensors.size
    other = FilterPyFilter(dim_x=states, dim_z=size)
    other.x = problem.mean[sensor, :, lane][:, None].copy()
    other.P = problem.covariance[sensor, :, :, lane].copy()
    other.H = problem.sensors.measurement_matrix[sensor, :, :, 0]
    other.R = np.diag(problem.sensors.variance[sensor, :, 0])
    return other


@pytest.mark.parametrize("kind", [KalmanFilter, TobitKalmanFilter])
@pytest.mark.parametrize(("size", "states"), [(1, 1), (1, 3), (2, 2), (2, 4), (3, 3), (3, 2)])
def test_one_uncensored_update_is_filterpys(kind: Any, size: int, states: int) -> None:
    problem = random_problem(size, size, states, lanes=20, threshold=NEVER_CENSORED)
    mean, covariance, silent_mean, silent_covariance = outcomes(kind(problem.sensors), problem)
    for sensor in range(2):
        for lane in range(20):
            other = filterpy_filter(problem, sensor, lane)
            other.update(problem.value[sensor, :, lane])
            np.testing.assert_allclose(mean[sensor, :, lane], other.x[:, 0], rtol=1e-10, atol=1e-10)
            np.testing.assert_allclose(
                covariance[sensor, :, :, lane], other.P, rtol=1e-10, atol=1e-10
            )
    assert np.array_equal(silent_mean, problem.mean)
    assert np.array_equal(silent_covariance, problem.covariance)


@pytest.mark.parametrize("kind", [KalmanFilter, TobitKalmanFilter])
def test_twenty_uncensored_steps_are_filterpys(kind: Any) -> None:
    problem = random_problem(8, 2, 3, lanes=6, threshold=NEVER_CENSORED)
    generator = np.random.default_rng(9)
    transition = np.linalg.qr(generator.normal(size=(3, 3)))[0] * 0.98
    process = np.diag([0.1, 0.2, 0.0])
    node_filter = kind(problem.sensors)
    others = [[filterpy_filter(problem, s, lane) for lane in range(6)] for s in range(2)]
    mean, covariance = problem.mean, problem.covariance
    for _ in range(20):
        mean = np.einsum("ij,sjN->siN", transition, mean)
        covariance = np.einsum("ij,sjkN,lk->silN", transition, covariance, transition)
        covariance = covariance + process[..., None]
        value = generator.normal(scale=3.0, size=problem.value.shape)
        arrived = generator.random((2, 6)) < 0.6
        step = problem._replace(mean=mean, covariance=covariance, value=value)
        delivered, bound, silent, silent_bound = outcomes(node_filter, step)
        mean = np.where(arrived[:, None], delivered, silent)
        covariance = np.where(arrived[:, None, None], bound, silent_bound)
        for sensor in range(2):
            for lane in range(6):
                other = others[sensor][lane]
                other.predict(F=transition, Q=process)
                other.update(value[sensor, :, lane] if arrived[sensor, lane] else None)
                np.testing.assert_allclose(
                    mean[sensor, :, lane], other.x[:, 0], rtol=1e-10, atol=1e-10
                )
                np.testing.assert_allclose(
                    covariance[sensor, :, :, lane], other.P, rtol=1e-10, atol=1e-10
                )


def test_a_censoring_threshold_matters_to_the_tobit_filter_only() -> None:
    free = random_problem(3, 2, 2, lanes=5, threshold=NEVER_CENSORED)
    censored = free._replace(
        sensors=CensoredSensors.create(
            free.sensors.measurement_matrix[..., 0], free.sensors.variance[..., 0], 0.5, 2
        )
    )
    same = outcomes(KalmanFilter(free.sensors), free)
    for left, right in zip(same, outcomes(KalmanFilter(censored.sensors), censored), strict=True):
        assert np.array_equal(left, right)
    tobit = outcomes(TobitKalmanFilter(censored.sensors), censored)
    assert not np.allclose(same[0], tobit[0], rtol=1e-2)
    assert not np.allclose(same[1], tobit[1], rtol=1e-2)


def test_a_component_without_threshold_beside_a_censored_one() -> None:
    # With C and P diagonal the components do not touch: one is FilterPy's, the other stands alone.
    sensors = CensoredSensors.create(np.eye(2)[None], 0.5, (NEVER_CENSORED, 1.0), 2)
    mean, spread = np.array([[[-40.0], [0.7]]]), (np.eye(2) * 0.3)[None, ..., None]
    problem = Problem(sensors, mean, spread, np.zeros((1, 2, 1)), np.array([[[-40.5], [1.4]]]))
    delivered, bound, _, _ = outcomes(TobitKalmanFilter(sensors), problem)
    other = FilterPyFilter(dim_x=1, dim_z=1)
    other.x, other.P = np.array([[-40.0]]), np.array([[0.3]])
    other.H, other.R = np.eye(1), np.array([[0.5]])
    other.update(-40.5)
    assert delivered[0, 0, 0] == pytest.approx(other.x[0, 0], rel=1e-12)
    assert bound[0, 0, 0, 0] == pytest.approx(other.P[0, 0], rel=1e-12)
    lone = Problem(
        CensoredSensors.create([[[1.0]]], 0.5, 1.0, 1),
        *(value[:, 1:] for value in (mean, spread[:, :, 1:], problem.held, problem.value)),
    )
    lone_delivered, lone_bound, _, _ = outcomes(TobitKalmanFilter(lone.sensors), lone)
    assert delivered[0, 1] == pytest.approx(lone_delivered[0, 0], rel=1e-12)
    assert bound[0, 1, 1] == pytest.approx(lone_bound[0, 0, 0], rel=1e-12)
    assert bound[0, 1, 1, 0] > bound[0, 0, 0, 0]  # a censored component tells less


# --- the expectation against quadrature ----------------------------------------------------------


@pytest.mark.parametrize("latent", [-4.0, -1.3, 0.0, 0.4, 2.5, 9.0])
@pytest.mark.parametrize("threshold", [-1.0, 0.0, 0.75])
@pytest.mark.parametrize("variance", [0.09, 0.5, 4.0])
def test_expectation_is_that_of_the_censored_normal(
    latent: float, threshold: float, variance: float
) -> None:
    sensors = CensoredSensors.create([[[2.0]]], variance, threshold, 1)
    expectation = TobitKalmanFilter(sensors).expect(np.array([[[latent / 2.0]]]))
    found = {name: float(value[0, 0, 0]) for name, value in expectation._asdict().items()}
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
        wanted = {
            "latent": latent,
            "uncensored_probability": float(inside),
            "value": float(mean),
            "noise_variance": float(total_variance),
            "hazard": float((truncated_mean - latent) / root),
            "truncated_variance": float(truncated_variance / variance),
        }
    assert found == pytest.approx(wanted, rel=1e-8, abs=1e-14)
    assert found["uncensored_probability"] == pytest.approx(float(inside), rel=1e-9, abs=0.0)


def test_expectation_of_a_kalman_filter_is_that_of_no_threshold() -> None:
    problem = random_problem(2, 2, 3, lanes=4, threshold=NEVER_CENSORED)
    ignoring = KalmanFilter(problem.sensors).expect(problem.mean)
    tobit = TobitKalmanFilter(problem.sensors).expect(problem.mean)
    for name, value in ignoring._asdict().items():
        np.testing.assert_allclose(value, getattr(tobit, name), rtol=1e-15, err_msg=name)


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
    "young": (1.5, 2.0),
    "sensors": 3,
}


def test_event_error_follows_its_recursion() -> None:
    found = EventError.create(**PAPER_TRIGGER).at(np.arange(1.0, 101.0))
    for sensor in range(3):
        for time in (1, 2, 3, 10, 50, 100):
            wanted = event_error(Example(), sensor, time)
            assert found[sensor, time - 1] == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize(
    "decay",
    [0.0, 0.1, 0.28, math.sqrt(0.08), 0.28284271247461895, 0.2828427, 0.29, 0.4],
    ids=lambda v: f"decay {v}",
)
def test_event_error_follows_its_recursion_for_every_growth(decay: float) -> None:
    # The growth 7.5 λ² + 0.4 is below, at and above one.
    error = EventError.create(**(PAPER_TRIGGER | {"decay": decay}))
    found = error.at(np.array([1.0, 2.0, 30.0, 100.0]))
    example = Example(decay=(decay,) * 3)
    for sensor in range(3):
        for place, time in enumerate((1, 2, 30, 100)):
            wanted = event_error(example, sensor, time)
            assert found[sensor, place] == pytest.approx(wanted, rel=1e-9)


def test_event_error_with_a_growth_of_exactly_one() -> None:
    error = EventError(np.array([[1.0]]), np.array([[0.25]]), np.array([[2.0]]))
    assert error.at(np.array([1.0, 7.0])).tolist() == [[2.25, 3.75]]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"threshold": -0.1}, "trigger_threshold"),
        ({"decay": (0.1, 0.1)}, "trigger_decay"),
        ({"divisor": 0.0}, "trigger_divisor"),
        ({"initial": math.nan}, "trigger_initial"),
        ({"young": (0.0, 1.0)}, "bound_young"),
    ],
)
def test_bad_trigger_numbers_are_refused(change: dict[str, Any], field: str) -> None:
    with pytest.raises(ConfigurationError, match=rf"^{field} = .* is not allowed"):
        EventError.create(**(PAPER_TRIGGER | change))


# --- the paper's filter against the printed equations ------------------------------------------


def make_bound_filter(
    sensors: CensoredSensors,
    with_event_error: bool = True,
    epsilon: tuple[float, ...] = PAPER_EPSILON,
    hold: bool = True,
) -> BoundTobitFilter:
    trigger = {
        "threshold": np.linspace(0.1, 0.3, sensors.count),
        "decay": np.linspace(0.1, 0.25, sensors.count),
        "divisor": np.linspace(4.0, 6.0, sensors.count),
        "initial": np.linspace(1.0, 2.0, sensors.count),
    }
    error = EventError.create(**trigger, young=(1.5, 2.0), sensors=sensors.count)
    constants = BoundConstants.create(epsilon)
    return BoundTobitFilter(sensors, constants, error if with_event_error else None, hold)


def check_against_print(
    problem: Problem,
    with_event_error: bool = True,
    epsilon: tuple[float, ...] = PAPER_EPSILON,
    digits: int = 80,
    tolerance: float = 1e-8,
) -> None:
    """Both outcomes at every sensor and lane, mean and bound, against (22), (30) and (37)."""
    sensors, time = problem.sensors, 3
    found = outcomes(make_bound_filter(sensors, with_event_error, epsilon), problem, time)
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
                mean = found[2 * silent][sensor, :, lane]
                bound = found[2 * silent + 1][sensor, :, :, lane]
                where = f"sensor {sensor}, lane {lane}, {'held' if silent else 'delivered'}"
                prior = problem.mean[sensor, :, lane]
                wanted = exact_float(exact_mean)[:, 0]
                room = tolerance * np.abs(wanted - prior).max() + 1e-12 * np.abs(prior).max()
                assert np.abs(mean - wanted).max() <= room, f"mean: {where}"
                # Relative in every direction: the eigenvalues of wanted⁻¹ found are all one.
                wanted = exact_float(exact_bound)
                scale = 1.0 / np.sqrt(np.diagonal(wanted))
                root = np.linalg.cholesky(scale[:, None] * wanted * scale)
                excess = scale[:, None] * (bound - wanted) * scale
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


def test_paper_filter_is_the_printed_one_for_other_constants() -> None:
    check_against_print(random_problem(5, 2, 2, lanes=5), epsilon=OTHER_EPSILON)


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
@pytest.mark.parametrize("level", [0.0, 2.0, -1.5])
@pytest.mark.parametrize("size", [1, 2, 3])
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
    assert np.array_equal(predicted[3], problem.covariance)
    assert not np.allclose(held[2], problem.mean)


def test_the_event_error_only_costs_certainty() -> None:
    problem = random_problem(7, 2, 2, lanes=6)
    with_error = outcomes(make_bound_filter(problem.sensors, True), problem)
    without = outcomes(make_bound_filter(problem.sensors, False), problem)
    gap = np.moveaxis(with_error[1] - without[1], -1, 1)
    assert np.linalg.eigvalsh(gap).min() >= -1e-12
    assert np.linalg.eigvalsh(gap).max() > 1e-3
    assert np.array_equal(with_error[3], without[3])


def test_holding_needs_independent_rows() -> None:
    sensors = CensoredSensors.create([[[1.0, 0.0], [2.0, 0.0]]], 0.5, 0.0, 2)
    with pytest.raises(ConfigurationError, match=r"measurement_matrices with row ranks \[1\]"):
        make_bound_filter(sensors, hold=True)
    assert make_bound_filter(sensors, hold=False).sensors is sensors


# --- Joseph form -------------------------------------------------------------------------------


def joseph(correction: Array, weighted: Array, covariance: Array, noise: Array) -> Array:
    gain = correction.T
    keep = np.eye(len(covariance)) - gain @ weighted
    return keep @ covariance @ keep.T + gain @ noise @ gain.T


@pytest.mark.parametrize("kind", [KalmanFilter, TobitKalmanFilter])
def test_posterior_equals_its_joseph_form(kind: Any) -> None:
    problem = random_problem(12, 2, 3, lanes=10, threshold=0.3)
    node_filter = kind(problem.sensors)
    expectation = node_filter.expect(problem.mean)
    plan = node_filter.plan(
        problem.mean, problem.covariance, expectation, problem.held, np.ones(10)
    )
    for sensor in range(2):
        matrix = problem.sensors.measurement_matrix[sensor, :, :, 0]
        for lane in range(10):
            q = expectation.uncensored_probability[sensor, :, lane]
            v = expectation.truncated_variance[sensor, :, lane]
            wanted = joseph(
                plan.correction[sensor, :, :, lane],
                q[:, None] * matrix,
                problem.covariance[sensor, :, :, lane],
                np.diag(problem.sensors.variance[sensor, :, 0] * v),
            )
            found = plan.delivered_covariance[sensor, :, :, lane]
            np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-12)
            assert np.array_equal(found, found.T)


@pytest.mark.parametrize("kind", ["kalman", "tobit", "paper"])
def test_a_delivered_gain_is_the_best_one(kind: str) -> None:
    """Any other gain has a larger bound: the posterior is at the minimum over the gains."""
    problem = random_problem(14, 2, 2, lanes=1, threshold=0.0, count=1)
    sensors, covariance = problem.sensors, problem.covariance[0, :, :, 0]
    node_filter: NodeFilter = {
        "kalman": KalmanFilter(sensors),
        "tobit": TobitKalmanFilter(sensors),
        "paper": make_bound_filter(sensors),
    }[kind]
    expectation = node_filter.expect(problem.mean)
    plan = node_filter.plan(problem.mean, problem.covariance, expectation, problem.held, np.ones(1))
    correction, posterior = plan.correction[0, ..., 0], plan.delivered_covariance[0, ..., 0]
    grow = BoundConstants.create(PAPER_EPSILON).kappa[0] if kind == "paper" else 1.0
    q = expectation.uncensored_probability[0, :, 0]
    weighted = q[:, None] * sensors.measurement_matrix[0, :, :, 0]
    # From P' = κ₁ P - κ₁ P C̃ᵀ K: the total Φ behind the gain, and so the bound of any gain.
    total = grow * np.linalg.lstsq(correction.T, covariance @ weighted.T, rcond=None)[0]
    noise = total - grow * weighted @ covariance @ weighted.T
    assert np.allclose(total, total.T, rtol=1e-8)
    generator = np.random.default_rng(1)
    for _ in range(20):
        other = correction + 0.1 * generator.normal(size=correction.shape)
        bound = joseph(other, weighted, grow * covariance, noise)
        assert np.linalg.eigvalsh(bound - posterior).min() > -1e-10
        assert np.trace(bound) > np.trace(posterior)
    np.testing.assert_allclose(
        joseph(correction, weighted, grow * covariance, noise), posterior, rtol=1e-8
    )
