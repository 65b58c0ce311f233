"""The exhaustive periodic schedule: known optima, the recursion by itself, its cache, refusals."""

import itertools
from typing import Any

import numpy as np
import pytest
from parts import Parts
from reference_markov_jump import PAPER, Dense, best_weights

import fusion_gym
from fusion_gym import linalg
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.policies import periodic_optimum
from fusion_gym.policies.periodic_optimum import PeriodicOptimum, steady_traces
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

ENV_ID = "fusion_gym/MarkovJumpTracking-v1"


def markov(**options: Any) -> Task:
    return fusion_gym.make_task(ENV_ID, **options)


@pytest.fixture(autouse=True)
def _forgetful(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(periodic_optimum, "_cache", {})


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
