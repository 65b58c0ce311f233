"""What the pages of the papers are computed by: recordings, measures, printed equations, bounds."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import minimize_scalar

import fusion_gym
from agents.papers import adaptive_innovation, markov_jump, unknown_input
from agents.papers import round_robin_tobit_runs as biased
from agents.papers import tobit_token_bucket_runs as runs
from agents.papers.adaptive_innovation_runs import Lane, TriggerReading, _largest, steps
from agents.papers.claims import DEPENDS, FAILS, HOLDS, UNDECIDED, outcome, verdict
from agents.papers.markov_jump import example, period_of, run_markov_jump, trigger
from agents.papers.markov_jump_covariances import covariances, iterated_gap
from agents.papers.numbers import (
    above_zero,
    always,
    below,
    cite,
    percent,
)
from agents.papers.paper import NAMES
from agents.papers.round_robin_tobit_theorems import MatrixBound, matrix_below
from agents.papers.unknown_input_recursion import gains, models
from agents.papers.walk import SomeSensors
from agents.papers.whitening import whitened_square
from fusion_gym.core.task import Task
from fusion_gym.evaluation import run_episodes
from fusion_gym.evaluation.metrics import Interval

SEED = 1_000_000


def record(paper: str) -> tuple[Task, str, NDArray[np.float64], NDArray[np.float64]]:
    """A paper's task and policy, the squared errors (H, n, E) recorded of it, and the rates."""
    if paper == "markov_jump":
        task, policy = example(), trigger(0.9)
        run = run_markov_jump(task, policy, 4, SEED)
        return task, policy, run.squared, np.tile(run.sent.mean(0), (4, 1))
    if paper == "tobit_token_bucket":
        task, policy = runs.scheme(), runs.TRIGGER
        history = runs.record_history(task, 4, SEED)
        return task, policy, np.square(history.truth - history.mean), history.granted.mean(0).T
    if paper == "unknown_input":
        task, policy = unknown_input.make_example()[0], "adaptive_threshold"
        stored = unknown_input.record_run(task, policy, 4, SEED)
        return task, policy, np.square(stored.errors[:, 0]), stored.granted.mean(0).T
    task, policy = fusion_gym.make_task(biased.OSCILLATOR), "round_robin"
    square = biased.squares(task, policy, 4, SEED).transpose(1, 2, 0)
    return task, policy, square, np.full((4, 2), 0.5)


@pytest.mark.parametrize("paper", [name for name in NAMES if name != "adaptive_innovation"])
def test_recorded_episodes_are_those_of_the_evaluation(paper: str) -> None:
    task, policy, square, rate = record(paper)
    results = run_episodes(task, fusion_gym.make_policy(policy, task), 4, SEED)
    size = results.squared_error.shape[-1]
    np.testing.assert_allclose(square[:, :size].mean(2), results.squared_error, rtol=1e-12)
    np.testing.assert_array_equal(rate, results.rate)


# --- the token bucket ---------------------------------------------------------------------------


def test_a_wrong_gain_is_reported_from_the_best() -> None:
    task = runs.scheme()
    history = runs.record_history(task, 3, 0)
    results = runs.terms(task, history)
    least = results.bound(results.gain)
    assert np.all(results.bound(1.01 * results.gain) > least)
    assert np.all(results.bound(np.zeros_like(results.gain)) > least)
    result = runs.perturbed(results, history, 0)
    assert result["larger"] == pytest.approx(np.ones(3))
    assert result["difference"].max() < 1e-9


def test_a_bound_that_is_too_small_is_found() -> None:
    rng = np.random.default_rng(0)
    root = np.array([[2.0, 0.0], [1.0, 0.5]])
    error = (root @ rng.normal(size=(2, 20_000)))[None]
    bound = np.broadcast_to((root @ root.T)[None, :, :, None], (1, 2, 2, 20_000))
    for factor in (0.5, 1.0, 2.0):
        value, deviation = runs.claimed(error, factor * bound)
        assert value[0] == pytest.approx(1.0 / factor, abs=5.0 * deviation[0] + 0.02 / factor)
        assert 0.0 < deviation[0] < 0.03 / factor


def test_verdicts_and_their_words() -> None:
    assert verdict([1.0, 1.0]) == HOLDS
    assert verdict([0.0, 0.0]) == FAILS
    assert verdict([1.0, math.nan, 0.0]) == DEPENDS
    assert verdict([1.0, math.nan]) == verdict([0.0, math.nan]) == UNDECIDED
    assert outcome([True, np.array([1.0, 1.0])]) == 1.0
    assert outcome([math.nan, np.array([1.0, 0.0])]) == 0.0
    assert math.isnan(outcome([math.nan, True]))
    assert above_zero([0.1, -0.1, -0.2], [0.3, 0.1, 0.0]) == pytest.approx(
        [1, np.nan, 0], nan_ok=True
    )
    assert always([0.99, 1.0], 200).tolist() == [0.0, 1.0]
    assert always([0.99, 1.0], 100) == pytest.approx([0.0, np.nan], nan_ok=True)
    assert pytest.approx(0.02, abs=5e-4) == 1.0 - 0.025 ** (1.0 / 185)
    assert cite(Interval(0.7, 0.6991, 100.0)) == "0.700 [0.699, 100]"
    assert percent((0.0, 0.4567, 0.9996, 1.0)) == "0 %, 46 %, 99.96 %, 100 %"
    assert percent(0.0004) == "0.04 %"


def test_the_limit_is_the_fixed_point_of_the_bound() -> None:
    """(43) of a scalar system with the same gain at every step."""
    first, process, noise, bound = 1.2, 0.3, 0.8, 1.0

    def terms() -> runs.Terms:
        one = np.ones((1, 1, 1))
        prior, matrix = (bound + process) * one[..., None], np.ones((1, 1, 1, 1))
        silent = np.zeros(one.shape, dtype=bool)[..., 0]
        return runs.Terms(first, prior, matrix, one, noise * matrix, 0.0 * one, silent)

    for _ in range(200):
        bound = terms().bound(terms().gain).item()
    assert terms().contraction.item() < 1.0
    assert terms().limit(np.array([[process]])).item() == pytest.approx(bound)


def test_other_filters_have_the_moments_of_a_clipped_value() -> None:
    """Exact far from the threshold; at it, the unscented points are 0 and ±√(3 P)."""
    covariance, matrix = np.array([[[0.4, 0.1], [0.1, 0.3]]]), np.array([[1.0, 0.5], [0.0, 2.0]])
    cross = covariance @ matrix.T
    for moments in (runs.extended, runs.unscented):
        results = moments(np.full((1, 2), 50.0), covariance, matrix)
        expected = (np.array([[75.0, 100.0]]), cross, matrix @ cross)
        for value, own in zip(results, expected, strict=True):
            np.testing.assert_allclose(value, own, rtol=1e-9)
    start = np.zeros((1, 2)), np.eye(2)[None], np.eye(2)
    assert np.abs(np.concatenate([np.ravel(item) for item in runs.extended(*start)])).max() == 0.0
    np.testing.assert_allclose(runs.unscented(*start)[0], np.sqrt(3.0) / 6.0, rtol=1e-12)


def test_a_linear_filter_of_the_deliveries_is_the_federated_kalman_filter() -> None:
    task = runs.scheme(filter="kalman")
    history = runs.record_history(task, 3, 0)

    def linear(
        mean: NDArray[np.float64], covariance: NDArray[np.float64], matrix: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        cross = covariance @ matrix.T
        return mean @ matrix.T, cross, matrix @ cross

    np.testing.assert_allclose(
        runs.filter_errors(task, history, linear), history.fused_error.mean(0), rtol=1e-6
    )


def test_operations_of_a_product_of_three() -> None:
    """A (x, w) by (w, w) by (w, x) product takes x w (2 w - 1) + x² (2 w - 1) operations."""
    count = runs.count_operations()
    assert count == {"xxx": 10, "wwx": 2, "wxx": 2, "wx": -1}
    for x, w in ((2, 1), (3, 4)):
        own = count["wwx"] * x * w**2 + count["wxx"] * x**2 * w + count["wx"] * x * w - x**2
        assert own == x * w * (2 * w - 1) + x**2 * (2 * w - 1)


# --- the biased oscillator ----------------------------------------------------------------------


@pytest.mark.parametrize("sensors", [{0}, {1}, {0, 1}])
def test_some_sensors_transmit_as_in_the_whole_policy_and_the_others_never(
    sensors: set[int],
) -> None:
    task = fusion_gym.make_task(biased.OSCILLATOR)
    policy = SomeSensors(fusion_gym.make_policy("periodic:period=2", task), sensors)
    rate = run_episodes(task, policy, 2, 0).rate
    np.testing.assert_allclose(rate, [[0.5 * (sensor in sensors) for sensor in range(2)]] * 2)


def test_no_filter_is_below_the_floor() -> None:
    """The floor is the Riccati equation's; uncensored, the Kalman filter has it."""
    task = fusion_gym.make_task(biased.TRACKING)
    estimator = biased.censored(task)
    model = estimator.model
    transition = model.transition[..., 0]
    covariance, process = model.initial_covariance[..., 0], model.process_covariance
    roots = []
    for step in range(task.horizon):
        covariance = transition @ covariance @ transition.T + process[..., 0]
        row = estimator.centre.sensors.measurement_matrix[step % 2, 0, :, 0]
        gain = covariance @ row / (row @ covariance @ row + (0.1, 0.3)[step % 2])
        covariance = covariance - np.outer(gain, row @ covariance)
        roots.append(np.sqrt(np.diag(covariance)))
    floor = biased.floor(biased.TRACKING)
    np.testing.assert_allclose(floor, np.mean(roots, axis=0), rtol=1e-9)
    result = biased.armse(biased.squares(task, "round_robin", 400, SEED))
    np.testing.assert_allclose(result["mean"], floor, rtol=0.08)
    turns, any_time = (biased.floor(biased.OSCILLATOR, access=a) for a in ("single", "any"))
    assert turns[2] > 0.5  # √Ξ
    assert np.all(np.less(any_time, turns))


def test_intervals_of_the_armse_cover() -> None:
    """Gaussian errors of deviation 2: the ARMSE is 2; 4.5 errors of 100 samples."""
    rng, covered, spreads, visible = np.random.default_rng(3), 0, [], []
    for _ in range(100):
        result = biased.armse((2.0 * rng.normal(size=(400, 3, 1))) ** 2)
        covered += result["low"][0] <= 2.0 <= result["high"][0]
        spreads.append(result["spread"][0])
        visible.append(result["mean"][0])
    assert covered >= 95 - 4.5 * np.sqrt(100 * 0.95 * 0.05)
    # Of 1,000 runs, where these have 400.
    assert np.mean(spreads) == pytest.approx(np.std(visible) * np.sqrt(0.4), rel=4.5 / np.sqrt(200))


def test_a_paired_increase_is_reported_from_none() -> None:
    rng = np.random.default_rng(4)
    errors = rng.normal(size=(300, 5, 3)) ** 2
    values = biased.increase(errors, errors * np.array([1.0, 1.02, 0.98]))
    assert values["low"][0] == values["high"][0] == 0.0
    assert values["low"][1] > 0.0
    assert values["high"][2] < 0.0


def test_one_point_above_is_told_from_all_below() -> None:
    error = np.full((100, 2), 1.0)
    one_above = np.where(np.arange(100)[:, None] == 3, 5.0, -5.0) * error
    one_open = np.where(np.arange(100)[:, None] == 3, 0.0, -5.0) * error
    assert biased.always_below(np.stack([-5.0 * error, error]))[0] == 1.0
    assert biased.always_below(np.stack([one_above, error]))[0] == 0.0
    assert math.isnan(biased.always_below(np.stack([one_open, error]))[0])


@pytest.mark.parametrize("points", [1, 20])
def test_below_is_wrong_in_at_most_a_fortieth_of_the_samples(points: int) -> None:
    """Of equal means of any number of points; a difference and its median decide."""
    rng, wrong = np.random.default_rng(0), 0
    for _ in range(1000):
        result = below(rng.normal(size=(points, 60)), rng.normal(size=(points, 60)))
        wrong += bool((result == 1.0).any())
    assert wrong <= 25 + 3 * math.sqrt(25)
    far = rng.normal(size=(points, 60)) - 3.0
    assert (below(far, 0.0) == 1.0).all()
    assert (below(0.0, far) == 0.0).all()
    skewed = rng.exponential(size=200) ** 4 - 4.0  # its mean is above 0, its median below
    assert math.isnan(below(0.0, skewed))


@pytest.mark.parametrize("latent", [-6.0, -1.0, 0.2, 5.5])
def test_printed_equations_are_as_printed(latent: float) -> None:
    """Against plain normal distributions, for the oscillator's R = 0.6 and ±5."""
    sensors = biased.censored(fusion_gym.make_task(biased.OSCILLATOR)).centre.sensors
    mean = np.zeros((2, 3, 1))
    mean[:, 0] = mean[:, 1] = latent
    root = np.sqrt(0.6)

    def printed(name: str) -> tuple[float, float]:
        result = biased.PrintedTobitFilter(sensors, name).expect(mean)
        return float(result.value[0, 0, 0]), float(result.truncated_variance[0, 0, 0])

    for name, scale in (("theta", 0.6), ("sign", root), ("argument", root), ("variance", root)):
        low, high = (-5 - latent) / scale, (5 - latent) / scale
        inside = stats.norm.cdf(high) - stats.norm.cdf(low)
        ratio = (stats.norm.pdf(high) - stats.norm.pdf(low)) / inside  # (14)
        if name == "argument":
            width = high - low
            ratio = stats.norm.pdf(width) / stats.norm.sf(width)
        sign = 1.0 if name in ("sign", "argument") else -1.0
        value = -5 * stats.norm.cdf(low) + 5 * stats.norm.sf(high)
        value += inside * (latent + sign * root * ratio)
        assert printed(name)[0] == pytest.approx(value, rel=1e-6)
    drawn = np.clip(latent + root * np.random.default_rng(0).normal(size=400_000), -5, 5)
    assert 0.6 * printed("variance")[1] == pytest.approx(drawn.var(), rel=0.03)


def test_bounds_of_a_filter_that_is_never_censored() -> None:
    """With ᾱ = β̄ = 0 the upper bound in its own correction is the Riccati equation itself."""
    task = fusion_gym.make_task(biased.TRACKING)
    model = biased.censored(task).model
    covariance = model.initial_covariance.copy()
    observed = (np.zeros((1, 1)), np.ones((1, 1)), np.zeros((1, 1)))
    bounds = [
        (MatrixBound(task, 0, 1.0, "upper", (-1.0, True)), covariance),
        (MatrixBound(task, 0, 1.0, "lower", (False, False)), 0.0 * covariance),
    ]
    transition, process = model.transition[..., 0], model.process_covariance[..., 0]
    for step in range(6):
        plain = covariance[..., 0]
        if step % 2 == 0:
            gain = plain[:, 0] / (plain[0, 0] + 0.1)
            plain = plain - np.outer(gain, plain[0])
        bounds = [
            (item, item.advance(value, covariance, observed, step % 2 == 0))
            for item, value in bounds
        ]
        covariance = (transition @ plain @ transition.T + process)[..., None]
        (_, upper), (_, lower) = bounds
        np.testing.assert_allclose(upper, covariance, rtol=1e-9)
        np.testing.assert_allclose(lower[..., 0], process, atol=1e-12)
        assert matrix_below(lower, covariance).all()
        assert matrix_below(covariance, upper).all()
        assert not matrix_below(1.001 * covariance, upper).any()


def test_matrices_are_ordered_by_their_eigenvalues() -> None:
    rng = np.random.default_rng(0)
    first, gap = rng.normal(size=(2, 40, 3, 3))
    first, gap = first @ first.transpose(0, 2, 1), gap + gap.transpose(0, 2, 1)
    value = matrix_below(
        np.moveaxis(first, 0, -1), np.moveaxis(first + gap + 1.5 * np.eye(3), 0, -1)
    )
    expected = np.linalg.eigvalsh(gap + 1.5 * np.eye(3))[:, 0] >= 0
    assert 0 < expected.sum() < 40
    np.testing.assert_array_equal(value, expected)
    assert not matrix_below(np.eye(3)[..., None], np.full((3, 3, 1), np.nan)).any()


# --- the Markov jump system ---------------------------------------------------------------------


def test_the_trigger_is_a_schedule_that_no_seed_changes() -> None:
    task = example(horizon=30)
    for m in (0.9, 1.3):
        first, second = (run_markov_jump(task, trigger(m), 2, seed) for seed in (0, 99))
        np.testing.assert_array_equal(first.sent, second.sent)
        np.testing.assert_array_equal(first.trace, second.trace)


def test_printed_recursion_is_exact_where_its_third_term_is_put_right() -> None:
    task = example(horizon=20)
    estimator = task.estimator  # type: ignore[attr-defined]
    everything = np.ones((20, 3), dtype=bool)
    exact = estimator.recursion.local[..., estimator.filters.at(np.arange(21))]
    exact = exact.transpose(4, 0, 2, 1, 3).reshape(21, 6, 6)
    np.testing.assert_allclose(covariances(estimator, everything, False), exact, atol=1e-13)
    assert np.abs(covariances(estimator, everything, True) - exact).max() > 1e-3
    silent = run_markov_jump(task, trigger(0.9), 1, 0).sent
    printed = covariances(estimator, silent, False)
    np.testing.assert_allclose(printed, printed.transpose(0, 2, 1), atol=1e-13)
    assert np.linalg.eigvalsh(printed).min() < -1.0


@pytest.mark.parametrize("name", list(markov_jump.READINGS)[1:])
def test_references_of_the_readings_are_the_traces_of_the_fused_covariance(name: str) -> None:
    estimator = example().estimator
    filters, reading = estimator.filters, markov_jump.READINGS[name]  # type: ignore[attr-defined]
    traces = estimator.full_rate_traces()  # type: ignore[attr-defined]
    expected = traces.min()
    if reading.get("augmented"):
        local = filters.covariance[..., -6:].transpose(4, 0, 2, 1, 3).reshape(6, 12, 12)
        every = np.tile(np.eye(4), (3, 1))
        best = np.linalg.inv(every.T @ np.linalg.solve(local, every[None]))
        expected = np.trace(best, axis1=1, axis2=2).mean()
    assert reading["reference"] == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("node", [0, 1, 2])
def test_iterated_synchronisation_differs_from_another_covariance(node: int) -> None:
    estimator = example().estimator
    assert iterated_gap(estimator, node, 60) < 1e-12
    filters = estimator.filters  # type: ignore[attr-defined]
    other = replace(filters, covariance=1.01 * filters.covariance)
    changed = replace(estimator, filters=other)  # type: ignore[call-arg]
    assert iterated_gap(changed, node, 60) == pytest.approx(0.01 / 1.01)


def test_traces_of_the_augmented_state_are_the_triggers() -> None:
    settings = markov_jump.PAPER.settings({"augmented": True, "reference": 3.1346})
    task = markov_jump.read_example(settings, horizon=60)
    covariance = task.estimator.filters.covariance  # type: ignore[attr-defined]
    sent = run_markov_jump(task, trigger(0.9), 1, 0).sent[-6:].sum(0)
    level = np.einsum("iiaat->it", covariance)[:, -6:] >= 3.1346 + 0.9
    assert sent.tolist() == level.sum(1).tolist() == [0, 6, 6]
    own = example().policy_defaults["local_variance"]["reference"]
    assert np.einsum("iiaat->it", covariance)[:, -6:].min() > own + 1.5


@pytest.mark.parametrize("period", [1, 4, 6])
def test_period_is_found(period: int) -> None:
    pattern = np.random.default_rng(0).normal(size=period)
    values = np.resize(pattern, 300)
    start = np.exp(-np.arange(300.0))
    assert period_of(values + start) == period
    assert period_of(values + 1e-3 * np.arange(300)) == 0


# --- adaptive innovation, unknown input ----------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("ratios", [(1.0, 0.3, 0.0), (0.2, 1.0, 0.5), (0.5, 0.5, 0.5)])
def test_actual_covariances_are_those_of_the_errors(ratios: tuple[float, float, float]) -> None:
    """Of 20,000 errors of every estimate: within 5 standard errors; beside a lane at the bounds."""
    always = lambda signals, event: np.ones_like(event)  # noqa: E731
    lanes, settings = [Lane(rule=always), Lane(ratios, always)], adaptive_innovation.PAPER.settings
    options = {"horizon": 6, "track_actual": True, "fusion": "sici"}
    *_, last = steps(lanes, 20_000, 0, settings({}), **options)
    estimate, each = last.state.estimate, np.arange(4)
    claimed = np.stack([estimate.joint[each, each][..., place] for place in (0, -1)])
    errors = (last.state.plant.truth - estimate.means).reshape(4, 3, 2, -1)
    moments = np.einsum("jale,jble->ljab", errors, errors) / errors.shape[-1]
    scale = np.sqrt(np.einsum("ljaa->lja", claimed))
    apart = np.abs(moments - claimed) / (scale[..., None] * scale[..., None, :])
    assert apart.max() <= 5.0 * math.sqrt(2.0 / 20_000)
    np.testing.assert_allclose(claimed[0, 1:], estimate.covariances[1:, ..., 0], rtol=1e-9)


def test_readings_of_the_trigger_are_their_formulas() -> None:
    size = np.array([[0.5], [0.9]])
    signals = {"innovation": size[:, None], "start": np.array([True]), "age": np.ones((2, 1))}
    level = 0.6 * np.exp(-(0.2 + 0.9 * size))
    for changes, expected in (
        ({}, level), ({"sign": 1.0}, 0.6 * np.exp(-0.2 + 0.9 * size)),
        ({"power": 2.0}, 0.6 * np.exp(-(0.2 + 0.9 * size**2))), ({"same_step": True}, level),
    ):  # fmt: skip
        rule = TriggerReading(**changes)  # type: ignore[arg-type]
        rule.reset(1)
        np.testing.assert_allclose(rule.threshold_after(size), expected)
        first = level if rule.same_step else 0.6 * np.exp(-0.2)
        np.testing.assert_array_equal(rule(signals), size**2 >= first)  # type: ignore[arg-type]
    assert 0.6 * np.exp(-0.2) > 0.6**2 >= 0.6 * np.exp(-0.2 - 0.9 * 0.6)
    rule = TriggerReading(same_step=True)
    between = signals | {"innovation": np.full((2, 1, 1), 0.6)}
    assert rule(between).all()  # type: ignore[arg-type]


@pytest.mark.parametrize("fusion", adaptive_innovation.FUSIONS)
def test_inverses_are_those_of_the_printed_formulas(fusion: str) -> None:
    """(42) and (54) at the library's weight have its trace."""
    inverted = []

    def inverse(matrix: np.ndarray) -> np.ndarray:
        inverted.append(matrix)
        return np.linalg.inv(matrix)

    def trace(weight: float) -> float:
        information = inverse(first), inverse(second)
        if fusion == "sci":
            joint = weight * information[0] + (1.0 - weight) * information[1]
        else:
            joint = sum(information) - inverse(weight * first + (1.0 - weight) * second)
        return float(np.trace(inverse(joint)))

    first, second = np.diag([1.0, 4.0, 2.0]), np.diag([3.0, 1.0, 2.5])
    trace(0.5)
    assert len(inverted) == adaptive_innovation.INVERSES[fusion]
    task = fusion_gym.make_task("fusion_gym/CorrelatedTracking-v1", fusion=fusion)
    both = np.stack((first, second))[..., None]
    rule = replace(task.estimator.fusion, order=None)  # type: ignore[attr-defined]
    fused = rule.fuse(np.zeros((2, 3, 1)), both).covariance
    least = minimize_scalar(trace, bounds=(0.0, 1.0), method="bounded").fun
    assert np.trace(fused[..., 0]) == pytest.approx(least, rel=1e-6)


def test_a_bound_is_reported_from_what_is_none() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    claimed = root @ root.T + np.eye(3)
    direction = rng.normal(size=3)
    more = claimed + 0.3 * np.outer(direction, direction)
    ratio = 1.0 + 0.3 * direction @ np.linalg.solve(claimed, direction)
    both = np.stack((0.7 * claimed, more), axis=-1)
    values = _largest(both, np.stack((claimed, claimed), axis=-1))
    assert values == pytest.approx([0.7, ratio])


def test_whitened_errors_sum_to_the_normalised_square() -> None:
    rng = np.random.default_rng(1)
    root, error = rng.normal(size=(3, 3)), rng.normal(size=(3, 1))
    claimed = root @ root.T + np.eye(3)
    square = whitened_square(error, claimed[..., None])
    assert np.trace(square[..., 0]) == pytest.approx(
        float(error[:, 0] @ np.linalg.solve(claimed, error[:, 0]))
    )


def test_errors_of_the_bound_itself_fill_it() -> None:
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(2, 2, 40))
    bounds = np.einsum("ijh,kjh->ikh", roots, roots) + np.eye(2)[..., None]
    draws = rng.standard_normal((40, 2, 2000))
    errors = np.linalg.cholesky(np.moveaxis(bounds, -1, 0)) @ draws
    # 80,000 squares of standard normals have a mean within 0.03 of 1, the larger of two too.
    assert unknown_input.leading(errors, bounds).mean() == pytest.approx(1.0, abs=0.03)
    assert unknown_input.leading(0.5 * errors, bounds).mean() == pytest.approx(0.25, abs=0.01)


def test_no_gain_that_hides_the_input_has_a_smaller_bound() -> None:
    """(18) under random gains that meet (14), against the best one and the printed one."""
    _, plant = unknown_input.make_example(example=unknown_input.CARTS, filter="paper")
    model = models(plant, 0.2, 0.09)[0]
    values = gains(model, model.covariance[None], np.array([False]), 0.5)
    a, b, c = model.transition, model.inputs, model.matrix
    phi = 1.2 * a @ model.covariance @ a.T + model.process
    noise = model.noise + 6.0 * 0.09 * np.eye(2)
    free = np.linalg.svd(c @ b)[0][:, 1:]

    def trace(gain: np.ndarray) -> float:
        retention = np.eye(4) - gain @ c
        return float(np.trace(retention @ phi @ retention.T + gain @ noise @ gain.T))

    best = values["best"][0]
    assert trace(best) == pytest.approx(float(np.trace(values["best_bound"][0])))
    assert best @ c @ b == pytest.approx(b)
    assert values["gain"][0] @ c @ b == pytest.approx(b)
    rng = np.random.default_rng(1)
    for _ in range(200):
        other = best + 0.3 * rng.normal(size=(4, 1)) @ free.T
        assert trace(other) >= trace(best)
    assert trace(values["gain"][0]) > trace(best)
