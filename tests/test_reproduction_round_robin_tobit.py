"""The page of the round-robin paper against a fresh quick run, and the parts that it is made of."""

from dataclasses import replace

import numpy as np
import pytest
from reproduction_checks import SEED
from scipy import stats

import fusion_gym
from fusion_gym.agents.papers.round_robin_tobit_runs import (
    OSCILLATOR,
    ROUND_ROBIN_READINGS,
    TRACKING,
    PrintedTobitFilter,
    SingleSensor,
    always_below,
    armse,
    censored,
    explained,
    floor,
    increase,
    reading_task,
    round_robin,
    squares,
)
from fusion_gym.agents.papers.round_robin_tobit_theorems import (
    Censoring,
    Lower,
    Upper,
    matrix_below,
)
from fusion_gym.evaluation.episodes import run_episodes


def test_squared_errors_are_those_of_the_evaluation() -> None:
    task = fusion_gym.make_task(OSCILLATOR)
    result = squares(task, round_robin(task), 5, SEED)
    results = run_episodes(task, round_robin(task), 5, SEED)
    np.testing.assert_allclose(result.mean(0), results.squared_error, rtol=1e-12)
    np.testing.assert_allclose(result.sum(2).mean(1), results.mse, rtol=1e-12)
    np.testing.assert_allclose(armse(result)["mean"], np.sqrt(results.squared_error).mean(0))


def test_a_single_sensor_transmits_at_its_turns_alone() -> None:
    task = fusion_gym.make_task(OSCILLATOR)
    for sensor in range(2):
        rate = run_episodes(task, SingleSensor(round_robin(task), sensor), 2, 0).rate
        np.testing.assert_allclose(rate.mean(0), np.eye(2)[sensor] / 2)


def test_no_filter_is_below_the_floor() -> None:
    """The floor is the Riccati equation's; uncensored, the Kalman filter has it."""
    task = fusion_gym.make_task(TRACKING)
    system = censored(task)
    transition = system.plant.transition[..., 0]
    covariance, process = system.plant.initial_covariance[..., 0], system.plant.process_covariance
    roots = []
    for step in range(task.horizon):
        covariance = transition @ covariance @ transition.T + process[..., 0]
        row = system.centre.sensors.measurement_matrix[step % 2, 0, :, 0]
        gain = covariance @ row / (row @ covariance @ row + (0.1, 0.3)[step % 2])
        covariance = covariance - np.outer(gain, row @ covariance)
        roots.append(np.sqrt(np.diag(covariance)))
    np.testing.assert_allclose(floor(TRACKING), np.mean(roots, axis=0), rtol=1e-9)
    result = armse(squares(task, round_robin(task), 400, SEED))
    np.testing.assert_allclose(result["mean"], floor(TRACKING), rtol=0.08)
    assert floor(OSCILLATOR)[2] > 0.5  # √Ξ
    assert np.all(np.less(floor(OSCILLATOR, access="any"), floor(OSCILLATOR)))


def test_intervals_of_the_armse_cover() -> None:
    """Gaussian errors of deviation 2: the ARMSE is 2; 4.5 errors of 100 samples."""
    rng, covered, spreads, visible = np.random.default_rng(3), 0, [], []
    for _ in range(100):
        result = armse((2.0 * rng.normal(size=(400, 3, 1))) ** 2)
        covered += result["low"][0] <= 2.0 <= result["high"][0]
        spreads.append(result["spread"][0])
        visible.append(result["mean"][0])
    assert covered >= 95 - 4.5 * np.sqrt(100 * 0.95 * 0.05)
    # Of 1,000 runs, where these have 400.
    assert np.mean(spreads) == pytest.approx(np.std(visible) * np.sqrt(0.4), rel=4.5 / np.sqrt(200))


def test_a_paired_increase_is_reported_from_none() -> None:
    rng = np.random.default_rng(4)
    errors = rng.normal(size=(300, 5, 3)) ** 2
    values = increase(errors, errors * np.array([1.0, 1.02, 0.98]))
    assert values["low"][0] == values["high"][0] == 0.0
    assert values["low"][1] > 0.0
    assert values["high"][2] < 0.0


def test_curves_are_judged_by_what_is_clear() -> None:
    error = np.full((100, 2), 1.0)
    assert always_below(np.stack([-5 * error, error]))[0] == "holds"
    one_above = np.where(np.arange(100)[:, None] == 3, 5.0, -5.0) * error
    assert always_below(np.stack([one_above, error]))[0] == "holds partly"
    assert always_below(np.stack([0.5 * error, error]))[0] == "does not hold"
    assert always_below(np.stack([5 * error, error]))[0] == "does not hold"
    assert explained([1.0, 3.0], [2.0, 3.0]) == pytest.approx([0.75, 0.0])


@pytest.mark.parametrize("latent", [-6.0, -1.0, 0.2, 5.5])
def test_printed_equations_are_as_printed(latent: float) -> None:
    """Against plain normal distributions, for the oscillator's R = 0.6 and ±5."""
    sensors = censored(fusion_gym.make_task(OSCILLATOR)).centre.sensors
    mean = np.zeros((2, 3, 1))
    mean[:, 0] = mean[:, 1] = latent
    root = np.sqrt(0.6)

    def printed(name: str) -> tuple[float, float]:
        result = PrintedTobitFilter(sensors, name).expect(mean)
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


def test_readings_are_run() -> None:
    """Each is another filter or another system; the first is the environment's own."""
    errors = {}
    for reading in ROUND_ROBIN_READINGS:
        task = reading_task(reading)
        name = "always" if task.access == "any" else "round_robin"
        errors[reading] = squares(task, fusion_gym.make_policy(name, task), 3, 0).mean()
    assert len(set(errors.values())) == len(ROUND_ROBIN_READINGS)
    own = fusion_gym.make_task(OSCILLATOR)
    assert errors["corrected equations"] == squares(own, round_robin(own), 3, 0).mean()


def test_bounds_of_a_filter_that_is_never_censored() -> None:
    """With ᾱ = β̄ = 0 the upper bound in its own correction is the Riccati equation itself."""
    task = fusion_gym.make_task(TRACKING)
    system = censored(task)
    covariance = system.plant.initial_covariance.copy()
    upper, lower = Upper(task, 0, 1.0, -1.0, True), Lower(task, 0, 1.0, False, False)
    observed = Censoring(np.zeros(1), np.ones(1), np.zeros(1))
    upper.begin(covariance)
    lower.begin(covariance)
    transition, process = system.plant.transition[..., 0], system.plant.process_covariance[..., 0]
    for step in range(6):
        plain = covariance[..., 0]
        if step % 2 == 0:
            gain = plain[:, 0] / (plain[0, 0] + 0.1)
            plain = plain - np.outer(gain, plain[0])
        upper.advance(covariance, observed, step % 2 == 0)
        lower.advance(covariance, observed, step % 2 == 0)
        covariance = (transition @ plain @ transition.T + process)[..., None]
        np.testing.assert_allclose(upper.value, covariance, rtol=1e-9)
        np.testing.assert_allclose(lower.value[..., 0], process, atol=1e-12)
        assert upper.holds(covariance).all()
        assert lower.holds(covariance).all()
        assert not upper.holds(1.001 * covariance).any()
        other = replace(lower)
        other.value = 1.001 * covariance
        assert not other.holds(covariance).any()


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
