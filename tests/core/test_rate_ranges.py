"""A range of token rates, from which every episode draws its own."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.evaluation import run_episodes
from fusion_gym.validation import ConfigurationError

OSCILLATOR, REMOTE = "fusion_gym/TobitOscillator-v1", "fusion_gym/RemoteEstimation-v1"
LOW, HIGH, RUNS = 2.0, 6.0, 400
RANGE: dict[str, Any] = {"token_rate": (LOW, HIGH)}


def test_a_user_observes_the_rate_of_an_episode_and_gains_it_in_every_step() -> None:
    env: Any = gym.make(OSCILLATOR, initial_tokens=0.0, **RANGE)
    view = env.unwrapped.view
    place, tokens = (view.names.index(name) for name in ("token_rate", "tokens"))
    rates = set()
    for _ in range(3):
        row, _ = env.reset()
        rates.add(rate := HIGH * float(row[place]))
        for step in range(1, 7):
            after = env.step([0, 0, 0])[0]
            assert after[tokens] * 30.0 == pytest.approx(min(step * rate, 30.0), rel=1e-5)
            assert after[place] == row[place]
    assert len(rates) == 3
    assert all(LOW < rate < HIGH for rate in rates)


def test_episodes_draw_uniformly_and_spend_their_own_rate() -> None:
    task = fusion_gym.make_task(OSCILLATOR, horizon=100, **RANGE)
    batch = EpisodeBatch.seeded(task, RUNS, 0)
    rate, spent = batch.signals()["token_rate"].copy(), np.zeros(RUNS)
    even = (np.arange(RUNS) + 0.5) / RUNS
    np.testing.assert_allclose((np.sort(rate) - LOW) / (HIGH - LOW), even, atol=0.07)
    for _ in range(100):
        spent += batch.step(np.ones((3, RUNS), dtype=np.bool_)).cost
    np.testing.assert_allclose(spent, 10.0 + 100 * rate - batch.signals()["tokens"])
    batch.reset(np.arange(5))
    assert (batch.signals()["token_rate"] != rate).sum() == 5
    tokens = run_episodes(task, fusion_gym.make_policy("always", task), RUNS).tokens
    np.testing.assert_allclose(tokens, rate, atol=0.2)


@pytest.mark.parametrize("channel", ["gilbert_elliott", "independent"])
def test_a_range_leaves_all_other_draws_as_they_are(channel: str) -> None:
    options: dict[str, Any] = {"channel": channel, "horizon": 5}
    options |= {"true_drop_probability": (0.2, 0.8)} if channel == "independent" else {}
    batches = [
        EpisodeBatch.seeded(fusion_gym.make_task(OSCILLATOR, **options, token_rate=rate), 40, 1)
        for rate in (9.0, (9.0, 12.0))
    ]
    for _ in range(5):
        one, two = (batch.step(np.ones((3, 40), dtype=np.bool_)) for batch in batches)
        np.testing.assert_array_equal(one.arrived, two.arrived)
        np.testing.assert_array_equal(one.error, two.error)


@pytest.mark.slow
def test_compiled_code_and_jax_draw_the_same_rate() -> None:
    pytest.importorskip("llvmlite")
    tasks = [
        fusion_gym.make_task(OSCILLATOR, backend=b, horizon=6, **RANGE)
        for b in ("numpy", "compiled")
    ]
    one, two = (EpisodeBatch.seeded(task, 4, 0) for task in tasks)
    for request in np.random.default_rng(1).random((8, 3, 4)) < 0.7:
        ended = np.flatnonzero(one.step(request).ended)
        two.step(request)
        for batch in (one, two):
            if ended.size:
                batch.reset(ended)
        np.testing.assert_allclose(one.observe(), two.observe(), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(one.signals()["token_rate"], two.signals()["token_rate"])
    from fusion_gym.jax import FunctionalEnv

    env, starts = FunctionalEnv(tasks[0]), tasks[0].plant.start_channels + 1
    noise = np.zeros((tasks[0].plant.noise_channels + tasks[0].network.noise_channels, 1))
    row, state = env.reset_env(np.zeros((starts, 1)), noise, np.zeros(1))
    place = one.layout.names.index("token_rate")
    for _ in range(3):
        assert row[place] == pytest.approx(4.0 / HIGH)
        row, state, _ = env.step_env(noise, state, np.zeros(3))
    assert state.state.network.tokens == pytest.approx(10.0 + 3 * 4.0)


def test_simulations_of_a_planner_gain_the_rate_of_the_episode() -> None:
    task = fusion_gym.make_task(OSCILLATOR, memory=True, initial_tokens=0.0, **RANGE)
    policy: Any = fusion_gym.make_policy("rollout:samples=3,steps=2,base=never", task)
    batch, runs = EpisodeBatch.seeded(task, 5, 0), np.arange(5).repeat(2)
    noise = np.zeros((policy._imagination.channels(2), 10))
    branch, noise = policy._imagination.begin(batch.signals(), runs, noise)
    branch.step(np.zeros((3, 10), dtype=np.bool_), noise[0])
    np.testing.assert_array_equal(branch.tokens, batch.signals()["token_rate"][runs])


@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        ("fusion_gym/LinearFusion-v2", {"price_range": "auto", "cost_weight": "random"}),
        (REMOTE, {"tokens": "limited", "sensors": 2, "cost_weight": 0.1}),
    ],
)
def test_scales_are_those_of_the_middle_of_the_range(env_id: str, options: Any) -> None:
    drawn, middle = (
        fusion_gym.make_task(env_id, **options, token_rate=rate) for rate in ((0.5, 1.5), 1.0)
    )
    np.testing.assert_array_equal(drawn.nominal_error, middle.nominal_error)  # type: ignore[arg-type]
    numbers = {"token_rate": None}
    assert drawn.settings | numbers == middle.settings | numbers
    batches = [EpisodeBatch.seeded(task, 3, 0) for task in (drawn, middle)]
    place = batches[0].layout.names.index("token_rate")
    rows = np.delete(batches[0].observe(), place, axis=1)
    np.testing.assert_array_equal(rows, batches[1].observe())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"token_rate": (6.0, 2.0)}, r"token_rate = \(6.0, 2.0\) .*low < high"),
        ({"token_rate": (2.0, 2.0)}, r"token_rate = \(2.0, 2.0\) .*low < high"),
        ({"token_rate": (1.0, 2.0, 3.0)}, r"token_rate = \(1.0, 2.0, 3.0\) .*a pair"),
        ({"token_rate": (-1.0, 2.0)}, "token_rate = -1.0 .*>= 0"),
        ({"token_rate": (1.0, np.inf)}, "token_rate = inf .*finite"),
        (RANGE | {"tokens": "unlimited"}, "token_rate = .*with tokens='unlimited': a range has"),
        (RANGE | {"budget": "sensor"}, r"token_rate = .*array of shape \(3,\)"),
    ],
)
def test_other_ranges_are_refused(options: Any, message: str) -> None:
    with pytest.raises(ConfigurationError, match=f"^{message}"):
        fusion_gym.make_task(OSCILLATOR, **options)


def test_the_exact_optimum_needs_one_rate() -> None:
    for sensors in (1, 2):
        options: Any = {"tokens": "limited", "sensors": sensors, "token_rate": (0.25, 0.75)}
        task = fusion_gym.make_task(REMOTE, **options)
        with pytest.raises(ConfigurationError, match=r"token_rate = .*it must be one number"):
            fusion_gym.make_policy("optimal", task)
        assert fusion_gym.make_policy("whittle", task)
