"""Plants fitted to logs of known plants, and their criticism."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from command_runs import refusal, succeed
from numpy.typing import NDArray
from refusals import refused

import fusion_gym
from fusion_gym.recordings import FittedPlant, RecordedChannel, Recording, criticise, fit
from fusion_gym.recordings.fitting import (
    RATES,
    RATIOS,
    deviations,
    residual_correlations,
    warnings_of,
)

A = np.array([[0.92, 0.05, 0.0], [0.04, 0.9, 0.05], [0.0, 0.06, 0.93]])
W = np.array([[1.0, 0.2, 0.0], [0.2, 0.8, 0.1], [0.0, 0.1, 0.5]])


def simulate(rows: int, seed: int = 0, second: NDArray[np.float64] | None = None) -> np.ndarray:
    """A path of the tanks' plant; ``second`` is the coefficient of the second lag."""
    noise = np.random.default_rng(seed).multivariate_normal(np.zeros(3), W, rows)
    path = np.zeros((rows, 3))
    for row in range(2, rows):
        path[row] = A @ path[row - 1] + noise[row]
        path[row] += 0.0 if second is None else second @ path[row - 2]
    return path


def recording(values: np.ndarray, every: str = "1min") -> Recording:
    index = pd.date_range("2026-01-01", periods=len(values), freq=every)
    names = [f"c{place}" for place in range(values.shape[1])]
    return Recording(pd.DataFrame(values, index, names), tuple(map(RecordedChannel, names)))


def test_least_squares_finds_the_plant_within_its_intervals() -> None:
    path = simulate(40_000)
    plant = fit(recording(path), exact=True)
    assert plant.order == 1
    rows = 20_000
    spread = np.linalg.inv(plant.stationary_covariance).diagonal()
    error = np.sqrt(np.outer(W.diagonal(), spread) / rows)
    assert np.all(np.abs(plant.transition - A) < 4.0 * error)
    deviation = np.sqrt((np.outer(W.diagonal(), W.diagonal()) + W**2) / rows)
    assert np.all(np.abs(plant.process_covariance - W) < 4.0 * deviation)


@pytest.mark.slow
def test_likelihood_finds_the_plant_despite_gaps_and_two_rates() -> None:
    path = simulate(6000)
    path[np.random.default_rng(1).random(path.shape) < 0.1] = np.nan
    path[np.arange(6000) % 4 > 0, 2] = np.nan
    plant = fit(recording(path), exact=True)
    deviation = np.sqrt((np.outer(W.diagonal(), W.diagonal()) + W**2) / 3000)
    deviation[2], deviation[:, 2] = 3.0 * deviation[2], 3.0 * deviation[:, 2]  # a quarter is seen
    assert np.all(np.abs(plant.process_covariance - W) < 4.0 * deviation)
    assert np.abs(plant.transition - A).max() < 0.06


def test_likelihood_is_least_squares_without_gaps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Up to the degrees of freedom: 299 steps and three coefficients a channel."""
    own = recording(simulate(600))
    squares = fit(own, exact=True, order=1)
    monkeypatch.setattr("fusion_gym.recordings.fitting._is_complete", lambda values: False)
    likelihood = fit(own, exact=True, order=1)
    assert likelihood.transition == pytest.approx(squares.transition, abs=1e-7)
    expected = squares.process_covariance * (299 - 3) / 299
    assert likelihood.process_covariance == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_criticism_of_white_noise_has_a_closed_form() -> None:
    """What is not sent has its whole error; two sensors take turns, each in every fourth step."""
    variance, step = np.array([4.0, 9.0]), np.arange(200)
    values = np.random.default_rng(0).normal(size=(200, 2)) * np.sqrt(variance)
    values[7, 1] = np.nan
    plant = FittedPlant(("a", "b"), np.zeros((2, 2)), np.diag(variance), np.full(2, 1e-9), 1)
    silent = np.stack([step % 4 != 0, step % 4 != 2], axis=1)
    squares = values**2 / variance
    always, fourth = criticise(plant, values, (1.0, 0.25))
    assert (always.real, always.model, always.nees) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    assert fourth.real == pytest.approx(np.nansum(squares * silent) / 399)
    assert fourth.model == pytest.approx(299 / 399)
    assert fourth.nees == pytest.approx(np.nansum(squares * silent) / 299)


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_criticism_finds_the_noise_of_the_part_that_was_not_fitted(factor: float) -> None:
    """An honest plant has a NEES of one and no warning; doubled noise has one at each rate."""
    path = simulate(40_000)
    path[20_000:] *= factor
    own = recording(path)
    plant, (values, rows) = fit(own, exact=True), deviations(own, 0.5)
    criticism = criticise(plant, values[rows:])
    assert [row.rate for row in criticism] == list(RATES)
    for row in criticism:
        assert (row.nees, row.ratio) == pytest.approx((factor**2,) * 2, rel=0.05 * factor)
    warnings = warnings_of(plant, values[rows:], criticism)
    assert len(warnings) >= len(RATES) if factor > 1.0 else not warnings


def test_a_second_lag_is_fitted_where_it_helps() -> None:
    second = -0.5 * np.eye(3)
    plant = fit(recording(simulate(20_000, second=second)), exact=True)
    assert plant.order == 2
    assert plant.transition[:3, 3:] == pytest.approx(second, abs=0.05)
    task = fusion_gym.make_task("fusion_gym/LinearFusion-v2", **plant.options)
    assert task.plant.state_names[3:] == ("c0_lag1", "c1_lag1", "c2_lag1")
    assert not task.reward.state_weights[3:].any()


def test_the_order_is_chosen_on_rows_that_were_not_fitted() -> None:
    """The second lag ends with the fitted two thirds, and is of no use after them."""
    draw, path = np.random.default_rng(0).normal(size=2400), np.zeros((2400, 1))
    for row in range(2, 2400):
        lags = (1.2, -0.6) if row < 800 else (0.75, 0.0)
        path[row] = lags @ path[[row - 1, row - 2]] + draw[row]
    assert fit(recording(path), exact=True).order == 1


def test_an_explosive_fit_is_damped_and_has_the_residuals_of_its_regression() -> None:
    """Least squares by definition: W with n - k degrees of freedom, all poles times one factor."""
    path = 1.02 ** np.arange(800)[:, None] + np.random.default_rng(0).normal(size=(800, 1))
    plant = fit(recording(path), exact=True, order=2)
    values = deviations(recording(path), 0.5)[0][:400, 0]
    lags = np.stack([values[1:-1], values[:-2]], axis=1)
    coefficients, squares, *_ = np.linalg.lstsq(lags, values[2:])
    assert plant.process_covariance[0, 0] == pytest.approx(float(squares[0]) / (398 - 2), rel=1e-9)
    poles = np.sort_complex(np.roots([1.0, *-coefficients]))
    assert np.abs(poles).max() > 1.001
    damped = np.sort_complex(np.linalg.eigvals(plant.transition))
    assert damped == pytest.approx(poles * 0.9999 / np.abs(poles).max(), rel=1e-9)


def test_changes_and_weights_have_a_closed_form() -> None:
    """Two channels x' = a x + w: a change in ten steps has variance 2 P (1 - a^10)."""
    a, variance = np.array([0.9, 0.5]), np.array([4.0, 9.0])
    process = np.diag(variance * (1.0 - a**2))
    plant = FittedPlant(("a", "b"), np.diag(a), process, np.full(2, 1e-6), 1)
    assert plant.typical_changes == pytest.approx(np.sqrt(2.0 * variance * (1.0 - a**10)))
    assert plant.options["state_weights"] == pytest.approx(1.0 / variance / 2.0)


def test_residuals_of_too_few_lags_are_not_white() -> None:
    own = recording(simulate(20_000, second=-0.5 * np.eye(3)))
    values, rows = deviations(own, 0.5)
    plant = FittedPlant(("a", "b", "c"), A, W, np.full(3, 1e-6), 1)
    assert max(value for _, _, value in residual_correlations(plant, values[rows:])) > 0.3
    assert any("not white" in line for line in warnings_of(plant, values[rows:], []))
    white = recording(simulate(20_000)).values.to_numpy()
    assert max(value for _, _, value in residual_correlations(plant, white)) < 0.05


def test_residuals_are_those_of_readings_only() -> None:
    """Steps without a reading change no correlation of a plant without memory."""
    plant = FittedPlant(("a", "b"), np.zeros((2, 2)), np.eye(2), np.full(2, 1e-9), 1)
    values = np.random.default_rng(0).normal(size=(100, 2)).cumsum(0)
    gaps = np.full((200, 2), np.nan)
    gaps[::2] = values
    both = (residual_correlations(plant, path) for path in (values, gaps))
    for (name, lag, value), row in zip(*both, strict=True):
        assert row == (name, lag, pytest.approx(value))
        assert value > 0.8


def test_a_daily_cycle_is_removed() -> None:
    path = simulate(6000)
    cycle = np.cos(2.0 * np.pi * np.arange(6000) / 144)[:, None]
    own = recording(path + 30.0 * cycle + 100.0, "10min")
    values, _ = deviations(own, 0.5)
    assert np.abs(cycle[:, 0] @ values / 3000).max() < 1.5  # of 30
    short = recording(path[:600] + 30.0 * cycle[:600], "10min")
    assert np.abs(cycle[:600, 0] @ deviations(short, 0.5)[0] / 300).min() > 20.0


def test_a_channel_with_measurement_noise_is_named() -> None:
    path = simulate(6000)
    path[:, 1] += np.random.default_rng(2).normal(0.0, 1.5, 6000)
    plant = fit(recording(path))
    assert plant.measurement_variance[1] == pytest.approx(2.25, rel=0.2)


def test_a_random_walk_becomes_a_stable_plant() -> None:
    plant = fit(recording(np.random.default_rng(3).normal(size=(4000, 2)).cumsum(0)), exact=True)
    assert np.abs(np.linalg.eigvals(plant.transition)).max() < 1.0


def with_last(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.c_[simulate(1000)[:, :2], values]


HALF, ONE = np.arange(1000) < 500, simulate(1000)
UNFIT: dict[str, tuple[NDArray[np.float64], float, str]] = {
    "few rows": (simulate(100), 0.5, "readings of c0 in the fitted part = "),
    "a small share": (simulate(4000), 0.02, "readings of c0 in the fitted part = "),
    "a late channel": (
        with_last(np.where(HALF, np.nan, 1.0)),
        0.55,
        "readings of c2 in the fitted",
    ),
    **{f"share {x}": (ONE, x, f"share = {x} is not allowed") for x in (0.0, -0.1, 0.96)},
    "a constant": (with_last(np.where(HALF, 101.3, ONE[:, 2])), 0.5, "change in the fitted part"),
    "tiny numbers": (with_last(1e-200 * ONE[:, 2]), 0.5, "change in the fitted part"),
    "a copy": (with_last(ONE[:, 1]), 0.5, "do not determine each other"),
    "a sum": (with_last(ONE[:, :2].sum(1)), 0.5, "do not determine each other"),
}


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("name", UNFIT)
def test_a_log_without_a_plant_is_refused(name: str, exact: bool) -> None:
    path, share, message = UNFIT[name]
    refused(lambda: fit(recording(path), share, exact=exact), message)


@pytest.mark.slow
@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("gaps", [0.0, 0.2])
def test_a_plant_is_the_same_in_every_unit(exact: bool, gaps: float) -> None:
    path = simulate(1200).round(1)
    path[np.random.default_rng(1).random(path.shape) < gaps] = np.nan
    expected = fit(recording(path), exact=exact)
    units = (1e-9, 1e-6, 1.8, np.array([1e-9, 1.0, 1e3]))
    plants = [fit(recording(path * unit), exact=exact) for unit in units]
    for unit, plant in zip(units, plants, strict=True):
        sizes = np.tile(np.broadcast_to(unit, 3), expected.order)
        transition = plant.transition / np.divide.outer(sizes, sizes)
        assert transition == pytest.approx(expected.transition, rel=1e-6, abs=1e-9)
        process = plant.process_covariance / np.outer(sizes, sizes)
        assert process == pytest.approx(expected.process_covariance, rel=1e-6, abs=1e-9)
        noise = plant.measurement_variance / sizes[:3] ** 2
        assert noise == pytest.approx(expected.measurement_variance, rel=1e-6)
    fusion_gym.make_task("fusion_gym/LinearFusion-v2", **plants[1].options)
    refused(lambda: plants[0].options, "deviation of c0 = ", ">= 1e-07")


@pytest.mark.slow
@pytest.mark.parametrize("exact", [True, False])
def test_a_channel_may_be_silent_for_long(exact: bool) -> None:
    """Silent in the last 3,100 rows of the fitted part: the rows before have its coefficients."""
    path = simulate(8000)
    path[900:4000, 1] = np.nan
    plant = fit(recording(path), exact=exact, order=1)
    assert plant.transition == pytest.approx(A, abs=0.08)
    path[150:4000, 1] = np.nan
    refused(lambda: fit(recording(path), exact=exact), "readings of c1 in the fitted part = 150 ")


def test_exact_readings_in_coarse_steps_have_no_noise() -> None:
    """Two thirds of neighbouring readings are equal, as of rooms in steps of 0.1."""
    path = np.round(0.05 * simulate(8000)[:, :1] + 21.0, 1)
    assert (np.diff(path, axis=0) == 0.0).mean() > 0.5
    plant = fit(recording(path), exact=True)
    assert plant.measurement_variance == pytest.approx(1e-10 * path[:4000].var(), rel=1e-9)
    assert plant.truth(path) is path


def test_an_alarm_that_begins_late_is_fitted() -> None:
    path = np.c_[simulate(4000)[:, :2], np.arange(4000) > 1990]
    assert np.isfinite(fit(recording(path), exact=True).transition).all()


@pytest.mark.slow
def test_the_mast_has_errors_near_the_models(mast: Recording) -> None:
    own = mast.select()
    plant, (values, rows) = fit(own, exact=True), deviations(own, 0.5)
    criticism = criticise(plant, values[rows:])
    assert all(RATIOS[0] <= row.ratio <= RATIOS[1] for row in criticism), criticism
    assert plant.order == 1


@pytest.mark.slow
def test_the_option_file_is_a_plant_of_the_environment_and_the_packaged_one(tmp_path: Path) -> None:
    output = tmp_path / "tanks.yaml"
    printed = succeed("fit", ["tanks", "--exact", "--output", str(output)])
    assert "inflow, middle, outflow: order 1, fitted to 3,000 steps" in printed.out
    assert printed.err.count("warning") == 0, printed.err
    content = yaml.safe_load(output.read_text())
    task = fusion_gym.make_task("fusion_gym/LinearFusion-v2", system=str(output))
    assert task.plant.state_names == ("inflow", "middle", "outflow")
    transition = np.asarray(content["transition"])
    assert transition == pytest.approx(A, abs=0.04)
    packaged = fusion_gym.make_task("fusion_gym/RecordedFusion-v1")
    # The packaged plant has the measurement noise of the log's resolution.
    assert packaged.plant.dynamics.transition[..., 0] == pytest.approx(transition, abs=1e-3)
    assert packaged.noise is not None
    error = refusal("fit", ["tanks", "--channels", "lake"])
    assert "channels = 'lake' is not allowed: it must be some of inflow, middle" in error


@pytest.mark.parametrize("exact", [False, True])
def test_a_sensor_that_stops_is_left_out_or_refused(exact: bool) -> None:
    path = simulate(2400)
    path[900:, 1] = np.nan
    whole = recording(path)
    own = whole.select(share=0.5)
    assert [channel.name for channel in own.channels] == ["c0", "c2"]
    assert "c1: no reading after the fitted part, left out" in own.remarks
    fit(own, exact=exact)
    named = whole.select(["c0", "c1"])
    refused(lambda: fit(named, exact=exact), "channels = 'c1'", "after the fitted part")


def test_an_order_without_enough_rows_is_not_tried() -> None:
    """On two thirds of 600 rows, an order of 2 needs 600."""
    draw = np.random.default_rng(0).normal(size=(1200, 6))
    path = np.zeros((1200, 6))
    for row in range(1, 1200):
        path[row] = 0.9 * path[row - 1] + draw[row]
    assert fit(recording(path), exact=True).order == 1


def test_many_channels_have_as_many_rows_as_they_need(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion_gym.recordings.fitting._ROWS", 150)
    monkeypatch.setattr("fusion_gym.recordings.fitting._ITERATIONS", 2)
    assert fit(recording(simulate(600)), exact=False).order == 1


@pytest.mark.parametrize("slope", [1.8, -0.1])
def test_a_channel_in_another_unit_repeats_the_first(slope: float) -> None:
    """Rounded to whole degrees; another walk of the same size does not repeat it."""
    first, other = np.round(20.0 + 5.0 * simulate(900)[:, :2], 1).T
    path = np.column_stack([first, np.round(32.0 + slope * first, 0 if slope > 1.0 else 1), other])
    assert [row.fault for row in recording(path).card] == ["", "repeats c0", ""]


def test_the_truth_of_noisy_readings_has_the_moments_of_the_smoother() -> None:
    """2,000 draws of 40 steps with gaps; exact readings are the truth."""
    noise = np.array([0.3, 0.05])
    plant = FittedPlant(("a", "b"), A[:2, :2], W[:2, :2], noise, 1)
    readings = np.random.default_rng(0).normal(size=(40, 2))
    readings[5:9, 0] = np.nan
    draws = np.stack([plant.truth(readings, seed) for seed in range(2000)])
    result = plant.filter(readings, smooth=True)
    covariance = result.smoothed_state_cov
    deviation = np.sqrt(np.diagonal(covariance))
    assert np.abs((draws.mean(0) - result.smoothed_state.T) / deviation).max() < 5 / np.sqrt(2000)
    assert np.abs(draws.var(0) / deviation**2 - 1.0).max() < 5 * np.sqrt(2 / 2000)
    neighbours = np.cov(draws[:, 20, 0], draws[:, 21, 0])[0, 1]
    assert neighbours == pytest.approx(result.smoothed_state_autocov[0, 0, 20], rel=0.2)
    exact = replace(plant, measurement_variance=np.full(2, 1e-9))
    assert exact.truth(readings) is readings
