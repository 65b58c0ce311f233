"""The adaptive innovation trigger and the correlated-noise environment from the outside."""

import math
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray
from rules import make_rule

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import Signals
from fusion_gym.envs.registration import make_task
from fusion_gym.policies.rules import AdaptiveInnovation, Random
from fusion_gym.validation import ConfigurationError

build = partial(make_task, "fusion_gym/CorrelatedTracking-v1")

Array = NDArray[np.float64]


# --- the trigger ---------------------------------------------------------------------------------


def signals(innovation: Array, start: bool) -> Signals:
    runs = innovation.shape[-1]
    return Signals(
        {
            "innovation": innovation,
            "start": np.full(runs, start),
            "tokens": np.zeros(runs),
            "token_cost": np.ones((len(innovation), 1)),
        }
    )


def test_memory_of_one_run_restarts_alone_and_reset_forgets() -> None:
    trigger = AdaptiveInnovation(threshold=1.0, offset=0.0, sensitivity=10.0)
    large, small = np.full((1, 1, 2), 3.0), np.full((1, 1, 2), 0.5)
    assert trigger(signals(large, True)).all()
    mixed = dict(signals(small, False)) | {"start": np.array([True, False])}
    assert trigger(Signals(mixed)).tolist() == [[False, True]]
    trigger.reset(2)
    assert not trigger(signals(small, False)).any()


# --- the environment -----------------------------------------------------------------------------


def test_actual_covariance_is_on_demand_and_changes_nothing() -> None:
    plain, tracked = (EpisodeBatch.seeded(build(track_actual=on), 3, 5) for on in (False, True))
    for batch in (plain, tracked):
        policy = Random(0.5)
        policy.reset(3, 9)
        for _ in range(20):
            batch.step(policy(batch.signals()))
    np.testing.assert_array_equal(plain.observe(), tracked.observe())
    assert plain.state.estimate.joint is None
    with pytest.raises(ConfigurationError, match="track_actual"):
        plain.task.estimator.actual_covariance(plain.delivered.estimate)
    offered = {name for name in tracked.signals() if "actual" in name or name == "scale"}
    assert not offered


def test_noise_scale_is_drawn_for_each_episode() -> None:
    batch = EpisodeBatch.seeded(build(noise_scale="random", horizon=3), 4000, 0)
    first = batch.state.plant.scale.copy()
    assert 0.4 <= first.min() < 0.41
    assert 0.99 < first.max() <= 1.0
    assert first.mean() == pytest.approx(0.7, abs=4 * 0.6 / math.sqrt(12 * 4000))
    batch.step(np.zeros((3, 4000), dtype=bool))
    np.testing.assert_array_equal(batch.state.plant.scale, first)
    batch.reset()
    assert (batch.state.plant.scale != first).all()


def test_trigger_options_are_the_policys_defaults() -> None:
    task = build(trigger_threshold=(0.1, 0.2, 0.3), trigger_sensitivity=0.0)
    policy = make_rule("adaptive_innovation", task.policy_defaults)
    assert policy == AdaptiveInnovation((0.1, 0.2, 0.3), (0.2,) * 3, (0.0,) * 3)
    changed = make_rule("adaptive_innovation:threshold=0.5", task.policy_defaults)
    assert changed == AdaptiveInnovation(0.5, (0.2,) * 3, (0.0,) * 3)
