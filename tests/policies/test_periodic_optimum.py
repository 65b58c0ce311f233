"""The best periodic schedules: known optima, brute force, Monte Carlo, the cache, refusals."""

import itertools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from parts import Parts
from reference_markov_jump import PAPER, Dense, best_weights
from scipy.optimize import minimize_scalar

import fusion_gym
from fusion_gym import linalg
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import present_id
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies import periodic_optimum
from fusion_gym.policies.periodic_optimum import PeriodicOptimum, episode_traces, steady_traces
from fusion_gym.policies.registry import make_policy
from fusion_gym.systems.unknown_input.system import UnknownInputEstimator
from fusion_gym.validation import ConfigurationError

ENV_ID = "fusion_gym/MarkovJumpTracking-v1"


def markov(**options: Any) -> Task:
    return fusion_gym.make_task(ENV_ID, **options)


@pytest.fixture(autouse=True)
def _forgetful(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(periodic_optimum, "_cache", {})


@pytest.mark.slow
@pytest.mark.parametrize(("packets", "best"), [(2, 2.333), (4, 1.727)])
def test_known_optima(packets: int, best: float) -> None:
    policy = make_policy(f"periodic_optimum:packets={packets},period=6", markov())
    assert isinstance(policy, PeriodicOptimum)
    assert policy.trace == pytest.approx(best, abs=5e-4)
    assert policy.schedule.shape == (6, 3)
    assert policy.schedule.sum() == packets


@pytest.mark.parametrize("period", [4, 6])
def test_the_trace_is_that_of_dense_matrices(period: int) -> None:
    """With a period of 4 and sampling that repeats after 6 steps the traces repeat after 12."""
    policy = PeriodicOptimum(markov(), 3, period)
    dense, traces = Dense(PAPER), []
    dense.send(np.ones(3, dtype=bool))
    for step in range(96):
        sent = policy.schedule[step % period]
        traces.append(np.trace(best_weights(dense.copies(sent), 2)[1]))
        dense.send(sent)
    assert np.mean(traces[-12:]) == pytest.approx(policy.trace, rel=1e-5)


@pytest.mark.parametrize("options", [{}, {"filter": "centralised"}, {"fusion": "ci"}])
def test_the_policy_reaches_its_trace_and_no_schedule_a_lower_one(options: Any) -> None:
    task = markov(horizon=120, information="centre", **options)
    policy = PeriodicOptimum(task, 2, 3)
    batch, traces, sent = EpisodeBatch(task, 2), [], np.zeros((3, 2))
    batch.reset()
    for _ in range(120):
        outcome = batch.step(policy(batch.signals()))
        sent += outcome.granted
        traces.append(linalg.trace(Parts.of(task).fused(batch.delivered)[1]))
    assert sent.sum() == 2 * 2 * 120 / 3
    np.testing.assert_allclose(np.mean(traces[-6:], axis=0), policy.trace, rtol=1e-6)
    others = np.zeros((9, 36), dtype=bool)
    for number, selected in enumerate(itertools.combinations(range(9), 2)):
        others[list(selected), number] = True
    result = steady_traces(task, others.reshape(3, 3, -1))
    assert policy.trace == pytest.approx(result.min(), rel=1e-9)
    assert result.max() > 1.2 * result.min()


def test_runs_in_other_steps_stand_side_by_side() -> None:
    policy = PeriodicOptimum(markov(), 3, 6)
    requests = policy({"step": np.array([0, 4, 6, 13])})  # type: ignore[arg-type]
    np.testing.assert_array_equal(requests.T, policy.schedule[[0, 4, 0, 1]])


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


# --- refusals ------------------------------------------------------------------------------------


def test_systems_whose_covariances_depend_on_the_data_are_refused() -> None:
    task = fusion_gym.make_task("fusion_gym/TobitOscillator-v1")
    with pytest.raises(ConfigurationError, match=r"CensoredEstimator.* depend only on deliveries"):
        make_policy("periodic_optimum", task)
    with pytest.raises(ConfigurationError, match="CensoredEstimator"):
        steady_traces(task, np.zeros((1, 3, 1), dtype=bool))


Array = NDArray[np.float64]


def correlated(**options: Any) -> Task:
    return fusion_gym.make_task("fusion_gym/CorrelatedTracking-v1", **options)


def unknown(**options: Any) -> Task:
    return fusion_gym.make_task("fusion_gym/UnknownInput-v1", **options)


def biased(name: str = "Tracking", **options: Any) -> Task:
    """Nothing is censored, unless the options say so."""
    free = {
        "filter": "kalman",
        "access": "any",
        "censoring_threshold": -np.inf,
        "censoring_upper": np.inf,
    }
    return fusion_gym.make_task(present_id(f"Biased{name}"), **free | options)


def all_schedules(packets: int, period: int, sensors: int) -> NDArray[np.bool_]:
    selected = list(itertools.combinations(range(period * sensors), packets))
    result = np.zeros((period * sensors, len(selected)), dtype=bool)
    for number, places in enumerate(selected):
        result[list(places), number] = True
    return result.reshape(period, sensors, -1)


def squared_by_impulses(task: Task, schedule: NDArray[np.bool_], steps: int) -> float:
    """Exact MSE over the first steps of a task whose error is linear in its normals.

    One run for each normal, which alone is 1: the squares of what the errors gain by it add up.
    """
    system = Parts.of(task)
    first, each = system.plant.start_channels, system.plant.noise_channels
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
    result = episode_traces(task, schedules, task.horizon)
    np.testing.assert_allclose(result, traces, rtol=rtol)


@pytest.mark.parametrize("options", [{}, {"fusion": "sci"}, {"fusion": "ci", "noise_scale": 0.5}])
def test_brute_force_by_impulses(options: Any) -> None:
    task = correlated(horizon=7, **options)
    schedules = all_schedules(2, 2, 3)
    exact = [squared_by_impulses(task, schedules[..., i], 7) for i in range(15)]
    assert_searched(task, 2, 2, exact, 1e-9)


def test_a_bound_is_not_what_is_minimised() -> None:
    task, schedules = correlated(horizon=60), all_schedules(3, 3, 3)
    actual = PeriodicOptimum(task, 3, 3, average="episode")
    system, claims = Parts.of(task), np.zeros(84)
    still = np.zeros((system.plant.noise_channels, 84))
    state = system.start(np.zeros((system.plant.start_channels, 84)))
    for step in range(60):
        state = system.deliver(system.sense(state, still), schedules[step % 3])
        claims += linalg.trace(system.fused(state)[1]) / 60
    safest = schedules[..., claims.argmin()]
    assert actual.trace < 0.98 * squared_by_impulses(task, safest, 60)
    assert squared_by_impulses(task, actual.schedule, 60) == pytest.approx(actual.trace)


def test_the_mean_over_drawn_noise_scales() -> None:
    """2,000 episodes: the MSE is the trace to 4 standard errors, which are below 3 % of it."""
    task = correlated(noise_scale="random", horizon=60)
    policy = PeriodicOptimum(task, 3, 4, average="episode")
    results = run_episodes(task, policy, 2000, 0).mse
    error = results.std() / np.sqrt(2000)
    assert error < 0.03 * policy.trace
    assert abs(results.mean() - policy.trace) <= 4 * error
    fixed = PeriodicOptimum(correlated(horizon=60), 3, 4, average="episode")
    np.testing.assert_array_equal(policy.schedule, fixed.schedule)
    assert policy.trace == pytest.approx(0.7 * fixed.trace, rel=1e-9)


def intersected(a: Array, b: Array) -> Array:
    """Covariance intersection of the smallest trace by a general-purpose search."""

    def join(share: float) -> Array:
        return np.linalg.inv(share * np.linalg.inv(a) + (1.0 - share) * np.linalg.inv(b))

    optimum = minimize_scalar(
        lambda share: np.trace(join(share)),
        bounds=(0, 1),
        method="bounded",
        options={"xatol": 1e-9},
    )
    return min((join(optimum.x), a, b), key=np.trace)


def test_brute_force_of_fused_input_nodes() -> None:
    task = unknown(fusion="sci", horizon=6)
    estimator = task.estimator  # type: ignore[attr-defined]
    assert isinstance(estimator, UnknownInputEstimator)
    model, sensors = estimator.nodes.model, estimator.nodes.sensors
    memory = np.diag(model.memory[:, 0])
    forward = np.vstack((model.state_rows[..., 0], np.hstack((np.zeros((1, 4)), memory))))
    schedules, traces = all_schedules(2, 2, 3), []
    for number in range(schedules.shape[-1]):
        nodes, total = [model.initial_covariance[..., 0]] * 3, 0.0
        for step in range(6):
            for node in range(3):
                prior = forward @ nodes[node] @ forward.T + model.change[..., 0]
                if schedules[step % 2, node, number]:
                    matrix = np.hstack((sensors.measurement_matrix[node, ..., 0], np.zeros((2, 1))))
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
    plant, sensors = task.plant.dynamics, task.estimator.centre.sensors  # type: ignore[attr-defined]
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
    assert squared_by_impulses(task, best, 30) == pytest.approx(min(traces), rel=1e-9)


@pytest.mark.parametrize(
    "task",
    [
        unknown(filter="paper"),
        unknown(hold_variance=0.05),
        biased(filter="paper"),
        biased(filter="adf"),
        biased(censoring_upper=1000.0),
        biased(censoring_threshold=[[-1000.0], [-np.inf]]),
        fusion_gym.make_task("fusion_gym/RemoteEstimation-v1"),
    ],
    ids=["paper", "hold", "tobit", "adf", "upper", "lower", "remote"],
)
def test_other_filters_of_the_same_systems_are_refused(task: Task) -> None:
    with pytest.raises(ConfigurationError, match=r"Estimator.* depend only on deliveries"):
        PeriodicOptimum(task, 1, 1)
