"""RecordedFusion: episodes are windows of a log."""

import functools
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from parts import Parts
from refusals import refused

import fusion_gym
from fusion_gym import Reception
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.noise import PhiloxNoise
from fusion_gym.evaluation import run_episodes
from fusion_gym.recordings import FittedPlant, Recording, fit
from fusion_gym.recordings.environment import ResampledNoise
from fusion_gym.recordings.fitting import deviations
from fusion_gym.systems.tobit.system import Announcement
from fusion_gym.validation import ConfigurationError

ENV = "fusion_gym/RecordedFusion-v1"
ROWS, HORIZON = 3000, 40


def write(folder: Path, change: Callable[[np.ndarray], Any] = lambda path: None) -> str:
    """Write a log of two channels with a daily cycle; ``change`` edits the readings (rows, 2)."""
    draw = np.random.default_rng(0).normal(size=(ROWS, 2))
    path = np.zeros((ROWS, 2))
    for row in range(1, ROWS):
        path[row] = [[0.9, 0.05], [0.0, 0.8]] @ path[row - 1] + draw[row]
    path += 50.0 + 10.0 * np.sin(2.0 * np.pi * np.arange(ROWS) / 96)[:, None]
    change(path)
    folder.mkdir(exist_ok=True)
    index = pd.date_range("2026-01-01 05:00", periods=ROWS, freq="15min", name="time")
    pd.DataFrame(path, index=index, columns=["a [K]", "b [K]"]).to_csv(folder / "log.csv")
    return str(folder / "log.csv")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write(tmp_path_factory.mktemp("recorded"))


@functools.cache
def plant_of(log: str) -> FittedPlant:
    return fit(Recording.read(log).select(), exact=True, order=1)


def make(log: str, plant_log: str | None = None, **options: Any) -> Any:
    """The task of a log, with the plant that was fitted to it or to another one."""
    free = {"tokens": "unlimited", "horizon": HORIZON} | plant_of(plant_log or log).options
    return fusion_gym.make_task(ENV, log=log, **free | options)


def scatter(path: np.ndarray) -> None:
    path[np.random.default_rng(1).random(path.shape) < 0.1] = np.nan


def rows_of(task: Any, runs: int) -> list[slice]:
    first = [ROWS // 2 + int(task.noise.first[run % task.noise.count]) for run in range(runs)]
    return [slice(row + 1, row + HORIZON + 1) for row in first]


@pytest.mark.parametrize("order", [1, 2])
def test_the_truth_is_the_recording(order: int, log: str) -> None:
    """Also with the singular process noise of two lags."""
    values, rows = deviations(Recording.read(log).select(), 0.5)
    plant = plant_of(log)
    options: dict[str, Any] = {}
    if order == 2:
        transition, process = np.eye(4, k=-2), np.zeros((4, 4))
        transition[:2] = np.hstack([plant.transition, -0.1 * np.eye(2)])
        process[:2, :2] = plant.process_covariance
        start = np.kron(np.eye(2), plant.stationary_covariance)
        two = replace(plant, transition=transition, process_covariance=process, order=2)
        options = two.options | {"initial_covariance": start.tolist()}
    task = make(log, **options)
    assert rows == ROWS // 2
    batch = EpisodeBatch.seeded(task, 20, 0)
    for step in range(HORIZON):
        for run, row in enumerate(rows_of(task, 20)):
            truth = task.plant.truth(batch.state.plant)[:2, run]
            assert truth == pytest.approx(values[row.start + step], abs=1e-11)
        batch.step(np.zeros((2, 20), dtype=np.bool_))


def test_held_readings_are_those_of_the_log(log: str) -> None:
    """Report on change with hold: an independent loop over the readings, cycle included."""
    task = make(log, filter="hold")
    policy = fusion_gym.make_policy("report_on_change:reportable_change=3", task)
    results = run_episodes(task, policy, 20, 0)
    readings = Recording.read(log).values.to_numpy()
    for run, row in enumerate(rows_of(task, 20)):
        held, error, sent = readings[row.start - 1].copy(), 0.0, 0
        for reading in readings[row]:
            report = np.abs(reading - held) >= 3.0
            held, sent = np.where(report, reading, held), sent + report.sum()
            error += ((reading - held) ** 2).sum()
        assert results.rate[run].sum() * HORIZON == pytest.approx(sent)
        assert results.mse[run] * HORIZON == pytest.approx(error, rel=1e-3, abs=1e-3)


def test_signals_are_readings(log: str) -> None:
    task, readings = make(log), Recording.read(log).values.to_numpy()
    batch = EpisodeBatch.seeded(task, 5, 0)
    for step in range(10):
        signals = batch.signals()
        measured = np.array([readings[row.start + step] for row in rows_of(task, 5)])
        assert pytest.approx(measured, abs=1e-9) == signals["measurement"][:, 0].T
        innovation = signals["measurement"] - signals["expected_measurement"]
        assert np.allclose(innovation, signals["innovation"], atol=1e-9)
        batch.step(np.zeros((2, 5), dtype=np.bool_))


def test_a_percentage_is_of_the_reading(log: str) -> None:
    task, rule = make(log, filter="hold"), "report_on_change:reportable_change"
    few, many = (
        run_episodes(task, fusion_gym.make_policy(f"{rule}={change}", task), 20, 0).rate.mean()
        for change in ("6,percent=true", "3")
    )
    assert few == pytest.approx(many, rel=0.15)  # 6 % of 50


def test_a_sensor_without_a_reading_does_nothing(tmp_path: Path) -> None:
    log = write(tmp_path, scatter)
    task, readings = make(log, memory=True), Recording.read(log).values.to_numpy()
    batch, seen = EpisodeBatch.seeded(task, 30, 0), 0
    for step in range(HORIZON):
        present = np.isfinite([readings[row.start + step] for row in rows_of(task, 30)]).T
        assert (batch.signals()["sampled"] == present).all()
        assert (batch.grantable() == present).all()
        value = batch.beliefs().value
        assert np.abs(value[~present]).max(initial=0.0) < 1e-9
        mean, covariance = task.estimator.single_deliveries(batch.state.estimate)
        silent = Parts.of(task).deliver(batch.state, np.zeros((2, 30), dtype=np.bool_)).estimate
        for sensor, run in np.argwhere(~present):
            assert mean[sensor, :, run] == pytest.approx(silent.mean[:, run])
            assert np.array_equal(covariance[sensor, ..., run], silent.covariance[..., run])
        outcome = batch.step(np.ones((2, 30), dtype=np.bool_))
        assert (outcome.granted == present).all()
        assert np.array_equal(outcome.cost, 3.0 * present.sum(0))
        assert not outcome.error[~present].any()
        assert np.isfinite(batch.observe()).all()
        seen += int((~present).sum())
    assert seen > 100


@pytest.mark.parametrize("options", [{}, {"memory": True}, {"filter": "hold"}])
def test_nothing_shows_the_future(options: dict[str, Any], tmp_path: Path) -> None:
    """Another future, gaps included, changes no observation and no signal before it."""
    change = ROWS // 2 + 30

    def gap(path: np.ndarray) -> None:
        scatter(path)
        path[change - 3 : change, 0] = np.nan

    log = write(tmp_path, gap)
    task = make(log, **options)

    def other(path: np.ndarray) -> None:
        gap(path)
        path[change:] = np.roll(path[change:], 7, axis=0) + 1.0

    changed = make(write(tmp_path / "changed", other), log, **options)
    assert task.noise.first[0] == 0
    batches = [EpisodeBatch.seeded(item, 1, 0) for item in (task, changed)]
    requests = np.random.default_rng(0).random((HORIZON, 2, 1)) < 0.3
    for step in range(28):
        first, second = (batch.observe() for batch in batches)
        assert np.allclose(first, second, atol=1e-6), step
        for batch in batches:
            batch.step(requests[step])
    for step in range(28, 34):
        for batch in batches:
            batch.step(requests[step])
    assert not np.allclose(batches[0].observe(), batches[1].observe(), atol=1e-3)


def test_seed_and_episode_determine_the_window(log: str) -> None:
    task = make(log)
    noise = task.noise
    assert len({noise.window(seed, 0) for seed in range(noise.count)}) == noise.count > 30
    assert len({noise.window(0, episode) for episode in range(noise.count)}) == noise.count
    policy = fusion_gym.make_policy("periodic:period=5", task)
    with pytest.warns(UserWarning, match=f"recording has {noise.count} windows, which repeat"):
        results = run_episodes(task, policy, 2 * noise.count, 0)
    assert results.mse[: noise.count] == pytest.approx(results.mse[noise.count :])
    with pytest.warns(UserWarning, match="repeat"):
        run_episodes(task, policy, 100, 7)


def test_prices_and_other_channels_are_drawn_as_without_a_recording(log: str) -> None:
    price: dict[str, Any] = {"cost_weight": "random", "price_range": (0.01, 1.0)}
    price["access"] = "random"
    task = make(log, **price)
    usual = fusion_gym.make_task("fusion_gym/LinearFusion-v2", **price)
    batches = [EpisodeBatch.seeded(item, 5, 3) for item in (task, usual)]
    assert np.array_equal(*(batch.price for batch in batches))
    others = [batch.normals()[batch.task.plant.noise_channels :] for batch in batches]
    assert others[0].size == 5
    assert np.array_equal(*others)


def test_every_interface_replays_the_window(log: str) -> None:
    task = make(log)
    observation, _ = fusion_gym.FusionEnv(task).reset(seed=3)
    assert np.array_equal(observation, EpisodeBatch.seeded(task, 5, 0).observe()[3])
    envs = fusion_gym.FusionSB3VecEnv(task, 5)
    envs.seed(0)
    assert np.array_equal(envs.reset()[3], observation)


def test_resampled_noise_has_the_residuals_of_the_fitted_part(tmp_path: Path) -> None:
    """A channel whose noise is 0 or 5 keeps such steps, which normal noise does not make."""

    def jump(path: np.ndarray) -> None:
        path[:, 1] = 50.0 + 5.0 * (np.random.default_rng(2).random(ROWS) < 0.1).cumsum() % 40.0

    log = write(tmp_path, jump)
    errors = {}
    for source in ("resampled", "normal"):
        batch = EpisodeBatch.seeded(make(log, source=source), 200, 0)
        before = batch.task.plant.truth(batch.state.plant)
        batch.step(np.zeros((2, 200), dtype=np.bool_))
        moved = batch.task.plant.truth(batch.state.plant)[1] - before[1]
        errors[source] = float((np.abs(moved) > 4.0).mean())
        assert batch.task.noise is None or batch.task.plant.available(batch.state.plant)
    assert errors["resampled"] == pytest.approx(0.1, abs=0.06)
    assert abs(errors["normal"] - 0.1) > abs(errors["resampled"] - 0.1)


def test_windows_of_few_readings_are_left_out(tmp_path: Path) -> None:
    """A gap covers one window of the held-out part whole and three quarters of the next."""
    steps, first = HORIZON + 1, ROWS // 2 + 3 * (HORIZON + 1)

    def gap(path: np.ndarray) -> None:
        path[first : first + steps + 3 * steps // 4] = np.nan

    whole, part = (
        make(write(tmp_path / name, change)).noise
        for name, change in (("whole", lambda path: None), ("part", gap))
    )
    assert part.first.tolist() == np.delete(whole.first, [3, 4]).tolist()


def test_resampled_noises_are_rows_of_residuals() -> None:
    """All of them, whole, as often as each other; later channels are the usual normals."""
    residuals = 10.0 + np.arange(12.0).reshape(4, 3)
    drawn = ResampledNoise(residuals).steps(0, 0, 0, 2000, 5)
    rows, counts = np.unique(drawn[:, :3], axis=0, return_counts=True)
    assert np.array_equal(rows, residuals)
    assert counts == pytest.approx(500, abs=80)
    assert np.array_equal(drawn[:, 3:], PhiloxNoise().steps(0, 0, 0, 2000, 5)[:, 3:])


def test_what_is_no_recording_of_the_plant_is_refused(log: str) -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({"state_names": ["a", "z"]}, "state_names = .* channels of a, b"),
        ({"measurement_matrices": [[0.0, 1.0], [1.0, 0.0]]}, "rows of the identity"),
        ({"process_covariance": [[1.0, 1.0], [1.0, 1.0]]}, "process noise of its own"),
        ({"horizon": 2000}, "this part of the log has 1,500 steps"),
        ({"true_process_noise": 2.0}, "the truth is the recording"),
        ({"joint_measurement_covariance": [[1.0, 0.5], [0.5, 1.0]]}, "noises .* are independent"),
        ({"fit_share": 1.0}, "fit_share = 1.0"),
        ({"log": 3}, "^log = 3 is not allowed"),
    ]
    for options, message in cases:
        with pytest.raises(ConfigurationError, match=message):
            make(**{"log": log, "plant_log": log} | options)
    make_task = functools.partial(fusion_gym.make_task, ENV)
    refused(lambda: make_task(source="resampled"), "source = 'resampled' is not", "and 100 must")
    refused(lambda: make_task(transition=[[0.5]]), "transition = ", "left out without a log")


def test_other_weights_of_the_made_up_log_may_be_given() -> None:
    task = fusion_gym.make_task(ENV, state_weights=[1.0, 2.0, 3.0], reward_scale=2.0)
    assert task.reward.state_weights[:, 0].tolist() == [2.0, 4.0, 6.0]


@pytest.mark.parametrize("source", ["recorded", "normal"])
def test_filters_are_honest_on_the_made_up_log(source: str) -> None:
    task = fusion_gym.make_task(ENV, source=source, tokens="unlimited")
    for rule in ("never", "periodic:period=10", "periodic:period=4"):
        results = run_episodes(task, fusion_gym.make_policy(rule, task), 29, 0)
        exact = results.rate.mean() if source == "recorded" else 0.0  # a reading has no error
        assert results.nees.mean() == pytest.approx(1.0 - exact, abs=0.12)


def test_a_live_stream_gives_the_estimates_of_the_replay_after_restarts_and_late_packets(
    tmp_path: Path,
) -> None:
    """Bitwise; silent sensors have no reading at the centre."""
    trigger = {"filter": "truncated", "trigger": "send_on_delta", "trigger_threshold": 1.0}
    task = make(write(tmp_path, scatter), **trigger)
    policy, centre = fusion_gym.make_policy("send_on_delta:threshold=1", task), task.estimator
    noise: Any = task.noise
    plant, day = task.plant.start(noise.start(0, 0, task.plant.start_channels)[:, None])
    batch, states = EpisodeBatch.seeded(task, 1, 0), [centre.start(plant.measurement, day)]

    def advance(state: Any, readings: np.ndarray, possible: np.ndarray) -> Any:
        state = centre.observe(centre.predict(state), readings)
        return centre.update(state, Reception(np.isfinite(readings[:, 0]), possible))

    known, replay = [], []
    for _ in range(HORIZON):
        sensed: Any = batch.state.estimate
        sent = policy(batch.signals()) & sensed.available
        known.append((np.where(sent[:, None], sensed.measurement, np.nan), sensed.available))
        batch.step(sent)
        replay.append(batch.delivered.estimate)
    late = next(step for step in range(5, HORIZON) if np.isfinite(known[step][0]).any())
    for step, (readings, possible) in enumerate(known):
        arrived = np.full_like(readings, np.nan) if step == late else readings
        states.append(advance(pickle.loads(pickle.dumps(states[-1])), arrived, possible))
        if step == late + 2:
            assert not np.array_equal(states[-1].mean, replay[step].mean)
            for place in (late, late + 1, late + 2):
                states[place + 1] = advance(states[place], *known[place])
    for state, expected in zip(states[1:], replay, strict=True):
        assert np.array_equal(state.mean, expected.mean)
        assert np.array_equal(state.covariance, expected.covariance)


def test_a_stream_starts_from_its_own_readings_and_refuses_infinite_ones(log: str) -> None:
    task = make(log)
    centre, day, first = task.estimator, np.array([0.25]), np.array([51.0, 47.5])[:, None, None]
    deviation = first - centre.level.at(day, np.zeros(1))
    state = centre.start(deviation, Announcement(np.zeros((2, 1)), day))
    assert np.allclose(state.mean, deviation[:, 0])
    state = centre.predict(state)
    for value in (np.inf, -np.inf):
        readings = np.array([np.nan, value])[:, None, None]
        refused(
            lambda r=readings: centre.observe(state, r), f"measurement = {value}", "or NaN where"
        )
