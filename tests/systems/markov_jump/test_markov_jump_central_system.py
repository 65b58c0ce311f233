"""Systems that filter at the centre of the Markov jump example: signals, leaks, environment."""

from functools import partial

import numpy as np
import pytest
from parts import Parts
from rules import make_rule

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import Signals
from fusion_gym.envs.registration import make_task
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

build = partial(make_task, "fusion_gym/MarkovJumpTracking-v1")

FILTERS = ("centralised", "imm")
each_filter = pytest.mark.parametrize("where", FILTERS)


# --- the system ----------------------------------------------------------------------------------


@each_filter
def test_nothing_that_was_not_sampled_leaks(where: str) -> None:
    """Other fadings and noises of the sensors that do not sample: nothing changes at all."""
    system = Parts.of(build(filter=where))
    draw, runs = np.random.default_rng(1), 6
    state = system.start(draw.standard_normal((system.plant.start_channels, runs)))
    nobody = np.zeros((3, runs), dtype=bool)
    for time in range(1, 8):
        noise = draw.standard_normal((system.plant.noise_channels, runs))
        before, state = state, system.sense(state, noise)
        offered = Signals(system.estimator.read(state.estimate))
        silent = np.flatnonzero(time % np.array([1, 2, 3]) != 0)
        changed = noise.copy()
        changed[-6 + silent] += 1.0
        changed[-3 + silent] += 5.0
        other = system.sense(before, changed)
        for name, value in system.estimator.read(other.estimate).items():
            np.testing.assert_array_equal(Signals({name: value})[name], offered[name])
        for block in system.estimator.observation:
            filled = (block.fill(each.estimate) for each in (other, state))
            np.testing.assert_array_equal(*filled)
        everyone = np.ones((3, runs), dtype=bool)
        for entry, expected in zip(
            system.fused(system.deliver(other, everyone)),
            system.fused(system.deliver(state, everyone)),
            strict=True,
        ):
            np.testing.assert_array_equal(entry, expected)
        state = system.deliver(state, nobody)


@each_filter
def test_a_request_without_a_sample_costs_and_delivers_nothing(where: str) -> None:
    task = build(filter=where, tokens="limited", token_rate=0.0, initial_tokens=30.0)
    batch = EpisodeBatch(task, 2)
    batch.reset()
    prior = batch.signals()["prior_covariance"]
    assert batch.signals()["sampled"].T.tolist() == [[True, False, False]] * 2
    outcome = batch.step(np.array([[False] * 2, [False] * 2, [True] * 2]))
    np.testing.assert_array_equal(outcome.cost, 3.0)
    assert outcome.granted[2].all()
    np.testing.assert_array_equal(Parts.of(task).fused(batch.delivered)[1], prior)
    assert batch.signals()["age"][:, 0].tolist() == [2.0, 2.0, 2.0]
    sampled = batch.signals()["sampled"]
    assert sampled.T.tolist() == [[True, True, False]] * 2
    measured = batch.signals()["measurement"]
    batch.step(np.ones((3, 2), dtype=bool))
    after = batch.signals()
    assert after["age"][:, 0].tolist() == [1.0, 1.0, 3.0]
    np.testing.assert_array_equal(after["held"][:2], measured[:2])
    np.testing.assert_array_equal(after["measurement"][1], after["held"][1])  # no sample at k = 3
    np.testing.assert_array_equal(after["innovation"][1], 0.0)


# --- the environment -----------------------------------------------------------------------------


def test_the_nodes_trigger_has_no_meaning_at_the_centre() -> None:
    with pytest.raises(ConfigurationError, match=r"'local_variance'.*unknown signal"):
        make_policy("local_variance", build(filter="imm"))
    assert make_rule("local_variance") is not None
