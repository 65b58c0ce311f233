"""The Markov jump system, its environment and its triggers from the outside."""

from functools import partial

import numpy as np
import pytest
from parts import Parts
from reference_markov_jump import PAPER, Run, options, random_model
from rules import make_rule

from fusion_gym.core.knowledge import Signals
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.rules.schedules import CentreVariance, LocalVariance

build = partial(make_task, "fusion_gym/MarkovJumpTracking-v1")


# --- the system ----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [None, 1, 2])
def test_runs_agree_with_plain_loops(seed: int | None) -> None:
    """State, node estimates, copies, fused mean and covariance, from the same normals."""
    model = PAPER if seed is None else random_model(seed)
    system = Parts.of(build(horizon=40, **options(model)))
    draw, runs = np.random.default_rng(seed), 3
    noise = draw.standard_normal((system.plant.start_channels, runs))
    state = system.start(noise)
    others = [Run(model, noise[:, run]) for run in range(runs)]
    for _ in range(40):
        noise = draw.standard_normal((system.plant.noise_channels, runs))
        state = system.sense(state, noise)
        sent = draw.random((system.plant.sensor_count, runs)) < 0.4
        state = system.deliver(state, sent)
        mean, covariance = system.fused(state)
        for run, other in enumerate(others):
            other.sense(noise[:, run])
            expected_mean, expected = other.deliver(sent[:, run])
            assert state.plant.mode[run] == other.mode
            np.testing.assert_allclose(system.truth(state)[:, run], other.x, atol=1e-9)
            np.testing.assert_allclose(state.estimate.node_mean[..., run], other.node, atol=1e-9)
            np.testing.assert_allclose(state.estimate.copy_mean[..., run], other.copy, atol=1e-9)
            # Pseudo-inverses lose digits where two copies have almost become one.
            np.testing.assert_allclose(mean[:, run], expected_mean, atol=1e-2)
            np.testing.assert_allclose(covariance[..., run], expected, atol=1e-3)
            if seed is None:
                np.testing.assert_allclose(mean[:, run], expected_mean, atol=1e-5)
                np.testing.assert_allclose(covariance[..., run], expected, atol=1e-7)


# --- the environment -----------------------------------------------------------------------------


@pytest.mark.slow
def test_open_loop_is_what_never_costs() -> None:
    results = run_episodes(build(), make_rule("never"), 3000, 0)
    task = build()
    expected = task.plant.open_loop(task.horizon)
    np.testing.assert_allclose(results.squared_error.mean(0), expected, rtol=0.05)
    assert results.bound_trace.mean() == pytest.approx(expected.sum(), rel=1e-9)
    assert results.returns.mean() / task.horizon == pytest.approx(-1.0, rel=0.05)


# --- the triggers --------------------------------------------------------------------------------


def test_local_variance_follows_the_papers_rule() -> None:
    variance = np.array([[1.0, 2.0], [2.1, 3.0], [0.5, 2.2]])
    offered = Signals({"local_variance": variance})
    requests = LocalVariance(m=0.9, reference=1.2)(offered)
    np.testing.assert_array_equal(requests, variance >= 2.1)
    each = LocalVariance(m=(-0.5, 5.0, 1.0), reference=1.0)(offered)
    np.testing.assert_array_equal(each, [[True, True], [False, False], [False, True]])


def test_centre_variance_takes_the_fewest() -> None:
    before = np.array([[3.0, 3.0, 1.0], [2.0, 1.2, 0.5], [1.0, 1.5, 0.9]])
    offered = Signals({"greedy_variance": before, "age": np.ones((3, 3))})
    np.testing.assert_array_equal(CentreVariance(1.5)(offered), before >= 1.5)
    requests = CentreVariance(1.5, at_most=1)(offered)
    np.testing.assert_array_equal(requests.sum(0), [1, 1, 0])
    assert requests[0, :2].all()
