"""The exhaustive periodic schedule: known optima, the recursion by itself, its cache, refusals."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from reference_markov_jump import PAPER, Dense, best_weights
from scipy.optimize import minimize_scalar

import fusion_gym
from fusion_gym import linalg
from fusion_gym.envs import EpisodeBatch, Task
from fusion_gym.evaluation import make_policy, periodic_optimum, run_episodes
from fusion_gym.evaluation.periodic_optimum import (
    PeriodicOptimum,
    episode_traces,
    steady_traces,
)
from fusion_gym.systems.correlated_tracking import CorrelatedTrackingSystem
from fusion_gym.systems.markov_jump import MarkovJumpSystem
from fusion_gym.systems.unknown_input import UnknownInputSystem
from fusion_gym.triggers.random import Random
from fusion_gym.validation import ConfigurationError

Array = NDArray[np.float64]
ENV_ID = "fusion_gym/MarkovJumpTracking-v0"


def markov(**options: Any) -> Task:
    return fusion_gym.make_task(ENV_ID, **options)


@pytest.fixture(autouse=True)
def _forgetful(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(periodic_optimum, "_found", {})


def recursion_traces(schedules: NDArray[np.bool_], steps: int, last: int) -> Array:
    """Mean fused trace over the last times, from the covariances' recursion alone."""
    system, runs = markov().system, schedules.shape[-1]
    assert isinstance(system, MarkovJumpSystem)
    recursion = system.recursion
    lags, means = recursion.start(runs), np.zeros((3, 2, runs))
    sent, total = np.ones((3, runs), dtype=bool), np.zeros(runs)
    for time in range(1, steps + 1):
        place = recursion.filters.at(np.full(runs, time))
        lags = recursion.predict(lags, sent, recursion.filters.at(np.full(runs, time - 1)))
        sent = schedules[(time - 1) % len(schedules)]
        if time > steps - last:
            offer = recursion.offer(lags, place)
            total += linalg.trace(system.fusion.fuse(means, offer.joint(sent))[1])
    return total / last


@pytest.mark.parametrize(("packets", "best"), [(2, 2.333), (4, 1.727)])
def test_known_optima(packets: int, best: float) -> None:
    policy = make_policy(f"periodic_optimum:packets={packets},period=6", markov())
    assert isinstance(policy, PeriodicOptimum)
    assert policy.trace == pytest.approx(best, abs=5e-4)
    assert policy.schedule.shape == (6, 3)
    assert policy.schedule.sum() == packets


@pytest.mark.parametrize("period", [4, 6])
def test_traces_are_those_of_the_recursion_alone(period: int) -> None:
    """With a period of 4 and sampling that repeats after 6 steps the traces repeat after 12."""
    schedules = np.random.default_rng(0).random((period, 3, 40)) < 0.3
    found = steady_traces(markov().system, schedules)
    np.testing.assert_allclose(found, recursion_traces(schedules, 144, 12), rtol=1e-6)


def test_the_trace_is_that_of_dense_matrices() -> None:
    policy = PeriodicOptimum(markov(), 3, 6)
    dense, traces = Dense(PAPER), []
    dense.send(np.ones(3, dtype=bool))
    for step in range(96):
        sent = policy.schedule[step % 6]
        traces.append(np.trace(best_weights(dense.copies(sent), 2)[1]))
        dense.send(sent)
    assert np.mean(traces[-6:]) == pytest.approx(policy.trace, rel=1e-5)


@pytest.mark.parametrize("options", [{}, {"filter": "centralised"}, {"fusion": "ci"}])
def test_the_policy_reaches_its_trace_and_no_schedule_a_lower_one(options: Any) -> None:
    task = markov(horizon=120, information="centre", **options)
    policy = PeriodicOptimum(task, 2, 3)
    batch, traces, sent = EpisodeBatch(task, 2), [], np.zeros((3, 2))
    batch.reset()
    for _ in range(120):
        outcome = batch.step(policy(batch.signals()))
        sent += outcome.granted
        traces.append(linalg.trace(task.system.fused(batch.delivered)[1]))
    assert sent.sum() == 2 * 2 * 120 / 3
    np.testing.assert_allclose(np.mean(traces[-6:], axis=0), policy.trace, rtol=1e-6)
    others = np.zeros((9, 36), dtype=bool)
    for number, chosen in enumerate(itertools.combinations(range(9), 2)):
        others[list(chosen), number] = True
    found = steady_traces(task.system, others.reshape(3, 3, -1))
    assert policy.trace == pytest.approx(found.min(), rel=1e-9)
    assert found.max() > 1.2 * found.min()


def test_it_beats_random_requests_and_knows_its_error() -> None:
    task = markov()
    best = run_episodes(task, PeriodicOptimum(task), 1500, 0)
    rate = tuple(best.rate.mean(0))
    other = run_episodes(task, Random(rate), 1500, 0)
    assert best.mse.mean() < 0.9 * other.mse.mean()
    gap = best.mse - best.bound_trace
    assert abs(gap.mean()) <= 4 * gap.std() / np.sqrt(1500)


def test_runs_in_other_steps_stand_side_by_side() -> None:
    policy = PeriodicOptimum(markov(), 3, 6)
    requests = policy({"step": np.array([0, 4, 6, 13])})  # type: ignore[arg-type]
    np.testing.assert_array_equal(requests.T, policy.schedule[[0, 4, 0, 1]])


# --- other systems -------------------------------------------------------------------------------


def correlated(**options: Any) -> Task:
    return fusion_gym.make_task("fusion_gym/CorrelatedTracking-v0", **options)


def unknown(**options: Any) -> Task:
    return fusion_gym.make_task("fusion_gym/UnknownInput-v0", **options)


def biased(name: str = "Tracking", **options: Any) -> Task:
    """Nothing is censored, unless the options say so."""
    free = {
        "filter": "kalman",
        "access": "any",
        "censoring_threshold": -np.inf,
        "censoring_upper": np.inf,
    }
    return fusion_gym.make_task(f"fusion_gym/Biased{name}-v0", **free | options)


def all_schedules(packets: int, period: int, sensors: int) -> NDArray[np.bool_]:
    chosen = list(itertools.combinations(range(period * sensors), packets))
    result = np.zeros((period * sensors, len(chosen)), dtype=bool)
    for number, places in enumerate(chosen):
        result[list(places), number] = True
    return result.reshape(period, sensors, -1)


def squared_by_impulses(system: Any, schedule: NDArray[np.bool_], steps: int) -> float:
    """Exact MSE over the first steps of a system whose error is linear in its normals.

    One run for each normal, which alone is 1: the squares of what the errors gain by it add up.
    """
    first, each = system.start_channels, system.noise_channels
    every = np.eye(first + each * steps, 1 + first + each * steps, k=1)
    state, total = system.start(every[:first]), 0.0
    for step in range(steps):
        noise = every[first + each * step : first + each * (step + 1)]
        sent = np.repeat(schedule[step % len(schedule)][:, None], every.shape[1], axis=1)
        state = system.deliver(system.sense(state, noise), sent)
        error = system.truth(state) - system.fused(state)[0]
        total += float(((error[:, 1:] - error[:, :1]) ** 2).sum())
    return total / steps


def assert_searched(
    task: Task, packets: int, period: int, traces: list[float], rtol: float
) -> None:
    """The policy has the schedule and the episode's trace of an independent brute force."""
    policy = PeriodicOptimum(task, packets, period, average="episode")
    best = int(np.argmin(traces))
    schedules = all_schedules(packets, period, task.sensors)
    assert policy.trace == pytest.approx(traces[best], rel=rtol)
    np.testing.assert_array_equal(policy.schedule, schedules[..., best])
    found = episode_traces(task.system, schedules, task.horizon)
    np.testing.assert_allclose(found, traces, rtol=rtol)


@pytest.mark.parametrize("options", [{}, {"fusion": "sci"}, {"fusion": "ci", "noise_scale": 0.5}])
def test_brute_force_by_impulses(options: Any) -> None:
    task = correlated(horizon=7, **options)
    schedules = all_schedules(2, 2, 3)
    exact = [squared_by_impulses(task.system, schedules[..., i], 7) for i in range(15)]
    assert_searched(task, 2, 2, exact, 1e-9)


def test_a_bound_is_not_what_is_minimised() -> None:
    task, schedules = correlated(horizon=60), all_schedules(3, 3, 3)
    actual = PeriodicOptimum(task, 3, 3, average="episode")
    system, claims = task.system, np.zeros(84)
    still = np.zeros((system.noise_channels, 84))
    state = system.start(np.zeros((system.start_channels, 84)))
    for step in range(60):
        state = system.deliver(system.sense(state, still), schedules[step % 3])
        claims += linalg.trace(system.fused(state)[1]) / 60
    safest = schedules[..., claims.argmin()]
    assert actual.trace < 0.98 * squared_by_impulses(system, safest, 60)
    assert squared_by_impulses(system, actual.schedule, 60) == pytest.approx(actual.trace)


def test_the_mean_over_drawn_noise_scales() -> None:
    """2,000 episodes: the MSE is the trace to 4 standard errors, which are below 3 % of it."""
    task = correlated(noise_scale="random", horizon=60)
    policy = PeriodicOptimum(task, 3, 4, average="episode")
    found = run_episodes(task, policy, 2000, 0).mse
    error = found.std() / np.sqrt(2000)
    assert error < 0.03 * policy.trace
    assert abs(found.mean() - policy.trace) <= 4 * error
    fixed = PeriodicOptimum(correlated(horizon=60), 3, 4, average="episode")
    np.testing.assert_array_equal(policy.schedule, fixed.schedule)
    assert policy.trace == pytest.approx(0.7 * fixed.trace, rel=1e-9)


def test_a_system_that_tracks_already_has_the_same_optimum() -> None:
    tracked = PeriodicOptimum(correlated(track_actual=True, horizon=20), 2, 3, average="episode")
    other = PeriodicOptimum(correlated(horizon=20), 2, 3, average="episode")
    np.testing.assert_array_equal(tracked.schedule, other.schedule)
    assert tracked.trace == other.trace


def test_an_input_as_the_filter_believes_it_makes_the_claim_true() -> None:
    """One sensor, so that nothing is fused; 2,000 episodes, 4 standard errors of 0.5 %."""
    kept = np.exp(-1.0 / 5.0)
    task = unknown(
        horizon=240,
        measurement_matrices=[[[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]],
        measurement_covariance=[[0.01, 0.02]],
        input_signal="random_walk",
        input_amplitude=0.5,
        input_period=5.0,
        input_memory=kept,
        input_change=0.5 * np.sqrt(1.0 - kept**2),
        input_deviation=0.5,
    )
    for average, transient in (("episode", 0), ("steady", 40)):
        policy = PeriodicOptimum(task, 2, 4, average=average)
        results = run_episodes(task, policy, 2000, 0)
        found = results.squared_error[transient:].sum(1).mean()
        error = results.mse.std() / np.sqrt(2000 * (1.0 - transient / 240))
        assert error < 0.005 * policy.trace
        assert abs(found - policy.trace) <= 4 * error


def intersected(a: Array, b: Array) -> Array:
    """Covariance intersection of the smallest trace by a general-purpose search."""

    def join(share: float) -> Array:
        return np.linalg.inv(share * np.linalg.inv(a) + (1.0 - share) * np.linalg.inv(b))

    found = minimize_scalar(
        lambda share: np.trace(join(share)),
        bounds=(0, 1),
        method="bounded",
        options={"xatol": 1e-9},
    )
    return min((join(found.x), a, b), key=np.trace)


def test_brute_force_of_fused_input_nodes() -> None:
    task = unknown(fusion="sci", horizon=6)
    system = task.system
    assert isinstance(system, UnknownInputSystem)
    model, sensors = system.nodes.model, system.nodes.sensors
    memory = np.diag(model.memory[:, 0])
    forward = np.vstack((model.state_rows[..., 0], np.hstack((np.zeros((1, 4)), memory))))
    schedules, traces = all_schedules(2, 2, 3), []
    for number in range(schedules.shape[-1]):
        nodes, total = [model.initial_covariance[..., 0]] * 3, 0.0
        for step in range(6):
            for node in range(3):
                prior = forward @ nodes[node] @ forward.T + model.change[..., 0]
                if schedules[step % 2, node, number]:
                    matrix = np.hstack((sensors.matrix[node, ..., 0], np.zeros((2, 1))))
                    noise = sensors.covariance[node, ..., 0]
                    information = matrix.T @ np.linalg.inv(noise) @ matrix
                    prior = np.linalg.inv(np.linalg.inv(prior) + information)
                nodes[node] = prior
            for block in (slice(0, 4), slice(4, 5)):
                first, second, third = (node[block, block] for node in nodes)
                total += float(np.trace(intersected(intersected(first, second), third)))
        traces.append(total / 6)
    assert_searched(task, 2, 2, traces, 1e-5)


@pytest.mark.parametrize("name", ["Tracking", "Oscillator"])
def test_brute_force_of_uncensored_nodes(name: str) -> None:
    """Federated Kalman filters with feedback are one Kalman filter; its MSE is its trace."""
    task = biased(name, horizon=30)
    plant, sensors = task.system.plant, task.system.centre.sensors  # type: ignore[attr-defined]
    forward, process = plant.transition[..., 0], plant.process_covariance[..., 0]
    schedules, traces = all_schedules(2, 3, 2), []
    for number in range(schedules.shape[-1]):
        covariance, total = plant.initial_covariance[..., 0], 0.0
        for step in range(30):
            covariance = forward @ covariance @ forward.T + process
            for sensor in np.flatnonzero(schedules[step % 3, :, number]):
                row = sensors.measurement_matrix[sensor, ..., 0]
                spread = row @ covariance @ row.T + sensors.variance[sensor]
                gain = covariance @ row.T / spread
                covariance = covariance - gain @ row @ covariance
            total += float(np.trace(covariance))
        traces.append(total / 30)
    assert_searched(task, 2, 3, traces, 1e-9)
    best = all_schedules(2, 3, 2)[..., int(np.argmin(traces))]
    assert squared_by_impulses(task.system, best, 30) == pytest.approx(min(traces), rel=1e-9)


def test_a_transient_is_part_of_an_episode() -> None:
    """What is best in the end is not what is best over ten steps from the start."""
    task = correlated(horizon=10)
    steady, episode = PeriodicOptimum(task, 2, 2), PeriodicOptimum(task, 2, 2, average="episode")
    both = np.stack((steady.schedule, episode.schedule), axis=-1)
    mean, late = episode_traces(task.system, both, 10), steady_traces(task.system, both)
    assert mean[1] == pytest.approx(episode.trace, rel=1e-9)
    assert mean[1] < 0.95 * mean[0]
    assert late[0] == pytest.approx(steady.trace, rel=1e-9)
    assert late[0] < 0.5 * late[1]


def test_actual_covariances_are_not_there_unless_tracked() -> None:
    system = correlated().system
    assert isinstance(system, CorrelatedTrackingSystem)
    state = system.start(np.zeros((system.start_channels, 2)))
    with pytest.raises(ConfigurationError, match="track_actual"):
        system.error_covariance(state)
    tracking = system.with_actual_covariance()
    state = tracking.start(np.zeros((system.start_channels, 2)))
    assert linalg.trace(tracking.error_covariance(state)) == pytest.approx([3.0, 3.0])


# --- cache ---------------------------------------------------------------------------------------


def test_a_search_is_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    first = PeriodicOptimum(markov(), 2, 3)
    monkeypatch.setattr(periodic_optimum, "_search", None)  # a second search would fail
    again = PeriodicOptimum(markov(), 2, 3)
    np.testing.assert_array_equal(again.schedule, first.schedule)
    with pytest.raises(TypeError):
        PeriodicOptimum(markov(), 1, 3)
    with pytest.raises(TypeError):
        PeriodicOptimum(markov(noise_coupling=0.1), 2, 3)
    with pytest.raises(TypeError):
        PeriodicOptimum(markov(fusion="ci"), 2, 3)
    with pytest.raises(TypeError):
        PeriodicOptimum(markov(), 2, 3, average="episode")


def test_a_file_holds_what_was_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "new" / "schedules.json"
    text = f"periodic_optimum:packets=2,period=3,cache={path}"
    first: Any = make_policy(text, markov())
    assert [entry.name for entry in path.parent.iterdir()] == ["schedules.json"]
    PeriodicOptimum(markov(), 1, 3, str(path))  # beside the first
    monkeypatch.setattr(periodic_optimum, "_found", {})
    monkeypatch.setattr(periodic_optimum, "_search", None)
    before = path.read_bytes()
    again: Any = make_policy(text, markov())
    np.testing.assert_array_equal(again.schedule, first.schedule)
    assert again.schedule.dtype == np.bool_
    assert again.trace == first.trace
    assert path.read_bytes() == before
    assert len(json.loads(before)["periodic_optimum"]) == 2


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "3", '{"other": 1}', '{"periodic_optimum": [1]}', "\x00\xff"]
)
def test_a_broken_or_foreign_file_is_replaced(tmp_path: Path, text: str) -> None:
    path = tmp_path / "schedules.json"
    path.write_text(text, encoding="latin-1")
    PeriodicOptimum(markov(), 1, 2, str(path))
    (entry,) = json.loads(path.read_text())["periodic_optimum"].values()
    assert np.sum(entry["requests"]) == 1


@pytest.mark.parametrize(
    "entry",
    [
        None,
        7,
        {},
        {"requests": [[1, 0, 0]], "trace": 1.0},
        {"requests": [[1, 0, 0], [0, 1, 0]], "trace": 1.0},
        {"requests": [[1, 0, 0], [0, 0]], "trace": 1.0},
        {"requests": [[0.5, 0.5, 0], [0, 0, 0]], "trace": 1.0},
        {"requests": [[1, 0, 0], [0, 0, 0]], "trace": "low"},
        {"requests": [["1", 0, 0], [0, 0, 0]], "trace": 1.0},
        {"requests": [[1, 0, 0], [0, 0, 0]], "trace": -1.0},
    ],
)
def test_an_entry_that_cannot_be_true_is_found_anew(
    tmp_path: Path, entry: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "schedules.json"
    right = PeriodicOptimum(markov(), 1, 2, str(path))
    saved = json.loads(path.read_text())
    (key,) = saved["periodic_optimum"]
    path.write_text(json.dumps({"periodic_optimum": {key: entry, "another": 1}}))
    monkeypatch.setattr(periodic_optimum, "_found", {})
    found = PeriodicOptimum(markov(), 1, 2, str(path))
    np.testing.assert_array_equal(found.schedule, right.schedule)
    assert found.trace == right.trace
    after = json.loads(path.read_text())["periodic_optimum"]
    assert after == saved["periodic_optimum"] | {"another": 1}


# --- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spec", "options", "message"),
    [
        ("packets=0", {}, "packets = 0"),
        ("packets=19", {}, "packets = 19 .* <= 18"),
        ("packets=2.5", {}, "packets = 2.5"),
        ("period=0", {}, "period = 0"),
        ("period=none", {}, "period = None"),
        ("packets=12,period=8", {}, "packets = 12 .* 2704156 schedules"),
        ("cache=3", {}, "cache = 3 .* path"),
        ("cache=/dev/null/schedules.json,packets=1,period=1", {}, "cache = .* written"),
        ("phase=3", {}, "unknown parameter of policy 'periodic_optimum' 'phase'"),
        ("", {"access": "single"}, "access = 'single' .* 'any'"),
        ("", {"filter": "imm"}, "MarkovJumpCentralSystem.* not depend on the data"),
    ],
)
def test_what_is_not_allowed(spec: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        make_policy(f"periodic_optimum:{spec}" if spec else "periodic_optimum", markov(**options))


@pytest.mark.parametrize("average", ["", "mean", None, 3])
def test_averages_that_do_not_exist(average: Any) -> None:
    with pytest.raises(ConfigurationError, match=r"average = .* 'steady', 'episode'"):
        PeriodicOptimum(markov(), 1, 1, average=average)


@pytest.mark.parametrize(
    "task",
    [
        unknown(filter="paper"),
        unknown(hold_variance=0.05),
        biased(filter="paper"),
        biased(filter="adf"),
        biased(censoring_upper=1000.0),
        biased(censoring_threshold=[[-1000.0], [-np.inf]]),
        fusion_gym.make_task("fusion_gym/RemoteEstimation-v0"),
    ],
    ids=["paper", "hold", "tobit", "adf", "upper", "lower", "remote"],
)
def test_other_filters_of_the_same_systems_are_refused(task: Task) -> None:
    with pytest.raises(ConfigurationError, match=r"System.* not depend on the data"):
        PeriodicOptimum(task, 1, 1)


@pytest.mark.parametrize("options", [{"filter": "predict"}, {"fusion": "exact_ci"}])
def test_filters_that_predict_while_nothing_arrives_are_searched(options: Any) -> None:
    policy = PeriodicOptimum(unknown(horizon=20, **options), 1, 2, average="episode")
    assert policy.schedule.sum() == 1


def test_systems_whose_covariances_depend_on_the_data_are_refused() -> None:
    task = fusion_gym.make_task("fusion_gym/TobitOscillator-v0")
    with pytest.raises(ConfigurationError, match=r"CensoredSystem.* not depend on the data"):
        make_policy("periodic_optimum", task)
    with pytest.raises(ConfigurationError, match="CensoredSystem"):
        steady_traces(task.system, np.zeros((1, 3, 1), dtype=bool))
