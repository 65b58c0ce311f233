"""The Markov jump paper's recorded runs, its schedule and its printed recursion."""

import numpy as np
import pytest

import fusion_gym
from fusion_gym.agents.papers.markov_jump import example, period_of, run_markov_jump, trigger
from fusion_gym.agents.papers.markov_jump_covariances import covariances
from fusion_gym.evaluation import run_episodes


def test_recorded_episodes_are_those_of_the_evaluation() -> None:
    task = example()
    for policy in (trigger(0.9), "never"):
        result = run_markov_jump(task, policy, 4, 7)
        results = run_episodes(task, fusion_gym.make_policy(policy, task), 4, 7)
        np.testing.assert_allclose(result.squared.sum(1).mean(0), results.mse, rtol=1e-12)
        np.testing.assert_allclose(result.trace.mean(), results.bound_trace, rtol=1e-12)
        np.testing.assert_array_equal(result.sent.mean(0), results.rate[0])


def test_the_trigger_is_a_schedule_that_no_seed_changes() -> None:
    task = example(horizon=30)
    for m in (0.9, 1.3):
        first, second = (
            run_markov_jump(task, trigger(m), 2, 0),
            run_markov_jump(task, trigger(m), 2, 99),
        )
        np.testing.assert_array_equal(first.sent, second.sent)
        np.testing.assert_array_equal(first.trace, second.trace)


def test_printed_recursion_is_exact_where_its_third_term_is_put_right() -> None:
    task = example(horizon=20)
    system = task.system
    everything = np.ones((20, 3), dtype=bool)
    place = system.filters.at(np.arange(21))  # type: ignore[attr-defined]
    exact = system.recursion.local[..., place]  # type: ignore[attr-defined]
    exact = exact.transpose(4, 0, 2, 1, 3).reshape(21, 6, 6)
    np.testing.assert_allclose(covariances(system, everything, False), exact, atol=1e-13)
    assert np.abs(covariances(system, everything, True) - exact).max() > 1e-3
    silent = run_markov_jump(task, trigger(0.9), 1, 0).sent
    printed = covariances(system, silent, False)
    np.testing.assert_allclose(printed, printed.transpose(0, 2, 1), atol=1e-13)
    assert np.linalg.eigvalsh(printed).min() < -1.0


@pytest.mark.parametrize("period", [1, 4, 6])
def test_period_is_found(period: int) -> None:
    pattern = np.random.default_rng(0).normal(size=period)
    values = np.resize(pattern, 300)
    start = np.exp(-np.arange(300.0))
    assert period_of(values + start) == period
    assert period_of(values + 1e-3 * np.arange(300)) is None
