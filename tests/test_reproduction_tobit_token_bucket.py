"""The page of the token-bucket paper against a fresh quick run, and the theorems' computation."""

import numpy as np
import pytest

import fusion_gym
from fusion_gym.agents.papers import tobit_token_bucket_runs as runs
from fusion_gym.agents.papers.numbers import below, cite, percent, verdict
from fusion_gym.evaluation import run_episodes
from fusion_gym.evaluation.intervals import Interval


def test_recorded_episodes_are_those_of_the_evaluation() -> None:
    task = runs.scheme()
    result = runs.record_history(task, 5, 3)
    results = run_episodes(task, fusion_gym.make_policy(runs.TRIGGER, task), 5, 3)
    np.testing.assert_allclose(result.fused_error.mean(0), results.mse, rtol=1e-12)
    np.testing.assert_allclose(result.fused_trace.mean(0), results.bound_trace, rtol=1e-12)
    np.testing.assert_array_equal(result.granted.mean(0).T, results.rate)
    sums = np.linalg.inv(np.moveaxis(result.local_bound, -1, 2)).sum(1)  # (50)
    fused = np.linalg.inv(np.moveaxis(result.bound, -1, 1))
    np.testing.assert_allclose(sums, fused, rtol=1e-6)


def test_a_failed_sensor_never_sends() -> None:
    task = runs.scheme()
    requests = runs.record_history(
        task, 3, 0, runs.Failing(fusion_gym.make_policy(runs.TRIGGER, task), 1)
    )
    assert not requests.requested[:, 1].any()
    assert requests.granted[:, [0, 2]].any()


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
    assert verdict([True, True]) == "holds"
    assert verdict([True, False]) == "holds partly"
    assert verdict([False]) == "does not hold"
    assert cite(Interval(0.7, 0.6991, 100.0)) == "0.700 [0.699, 100]"
    assert percent((0.0, 0.4567, 0.9996, 1.0)) == "0 %, 46 %, 99.96 %, 100 %"
    assert percent(0.0004) == "0.04 %"
    sample = np.random.default_rng(1).normal(size=200)
    assert below(sample, sample + 0.1)
    assert not below(sample, sample)
    assert not below(sample, np.random.default_rng(2).normal(size=200) + 0.001)
