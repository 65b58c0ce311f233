"""The environment against the checkers of Gymnasium and SB3, and its own documented promises."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.env_checker import check_env as sb3_check

import fusion_gym  # noqa: F401  registers the environments

ENV_ID = "fusion_gym/TobitOscillator-v0"
SENSOR_BLOCKS = ("whitened_innovation", "censored", "held_difference")
OPTIONS: list[dict[str, Any]] = [
    {},
    {"filter": "tobit"},
    {"filter": "kalman", "information": "centre"},
    {"information": "centre", "action": "discrete"},
    {"action": "discrete", "sharing": "rotating"},
    {"sharing": "fixed", "token_cost": (1.0, 2.0, 4.0)},
    {"process_noise": "full", "error": "trace"},
    {"silent": "predict", "event_error": False, "tokens": "unlimited"},
    {"random_start": True, "filter": "tobit", "information": "centre", "process_noise": "full"},
]


def name_of(options: dict[str, Any]) -> str:
    return ",".join(f"{key}={value}" for key, value in options.items()) or "defaults"


each_option = pytest.mark.parametrize("options", OPTIONS, ids=name_of)


@pytest.fixture(autouse=True)
def every_warning_is_an_error() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def make(**options: Any) -> Any:
    return gymnasium.make(ENV_ID, **options)


def make_vector(num_envs: int, **options: Any) -> Any:
    return gymnasium.make_vec(
        ENV_ID, num_envs, vectorization_mode="vector_entry_point", **options
    ).unwrapped


@each_option
def test_gymnasium_checker(options: dict[str, Any]) -> None:
    gymnasium_check(make(**options).unwrapped)


@each_option
def test_sb3_checker(options: dict[str, Any]) -> None:
    sb3_check(make(**options), warn=True)


@each_option
def test_observations_stay_in_their_space(options: dict[str, Any]) -> None:
    env = make_vector(5, horizon=60, autoreset_mode="SameStep", **options)
    env.action_space.seed(3)
    observation, _ = env.reset(seed=1)
    for _ in range(130):
        assert env.observation_space.contains(observation)
        assert np.isfinite(observation).all()
        observation, reward, *_ = env.step(env.action_space.sample())
        assert np.isfinite(reward).all()


@pytest.mark.parametrize("options", [{}, {"silent": "predict"}, {"event_error": False}], ids=str)
@pytest.mark.parametrize("kind", ["paper", "tobit", "kalman"])
def test_a_starved_filter_stays_finite(kind: str, options: dict[str, Any]) -> None:
    if kind != "paper":
        options = {"information": "centre"} if options else {}
    env = make_vector(8, horizon=300, filter=kind, **options)
    nothing = np.zeros((8, 3), dtype=np.int8)
    observation, _ = env.reset(seed=7)
    assert env.observation_space.contains(observation)
    for step in range(1, 301):
        observation, reward, _, truncated, info = env.step(nothing)
        assert env.observation_space.contains(observation)
        assert np.isfinite(reward).all()
        assert np.isfinite(info["squared_error"]).all()
        assert not info["granted"].any()
        assert (truncated == (step == 300)).all()
    ages = [name.startswith("age") for name in env.observation_names]
    # The last observation is made after 301 measurements without a delivery.
    np.testing.assert_allclose(observation[:, ages], 301 / 311, rtol=1e-6)


def test_named_entries_hold_what_their_names_say() -> None:
    env = make(token_cost=(3.0, 2.0, 4.0)).unwrapped
    names = env.observation_names
    assert env.observation_space.shape == (len(names),)
    assert len(set(names)) == len(names)
    env.reset(seed=5)
    rng = np.random.default_rng(0)
    for _ in range(40):
        observation, *_ = env.step(rng.integers(0, 2, 3))
        entries = dict(zip(names, observation.tolist(), strict=True))
        signals = env.batch.signals()
        system = env.task.system
        expected = {"tokens": float(signals["tokens"][0]) / env.task.bucket.capacity}
        for i in range(2):
            variance = signals["prior_covariance"][i, i, 0] / system.reference[i]
            expected[f"log_variance[x{i + 1}]"] = np.clip(np.log(variance), -5, 5)
            estimate = signals["prior_mean"][i, 0] / system.scale[i]
            expected[f"estimate[x{i + 1}]"] = np.clip(estimate, -5, 5)
        for s in range(3):
            age = signals["age"][s, 0]
            expected[f"age[{s}]"] = age / (age + 10.0)
            for c in range(2):
                measurement = signals["measurement"][s, c, 0]
                deviation = signals["innovation_deviation"][s, c, 0]
                white = (measurement - signals["expected_measurement"][s, c, 0]) / deviation
                moved = (measurement - signals["held"][s, c, 0]) / (2 * np.sqrt(0.5))
                expected[f"whitened_innovation[{s},{c}]"] = np.clip(white, -5, 5)
                expected[f"held_difference[{s},{c}]"] = np.clip(moved, -5, 5)
                expected[f"censored[{s},{c}]"] = float(measurement <= 0.0)
                probability = signals["uncensored_probability"][s, c, 0]
                expected[f"uncensored_probability[{s},{c}]"] = probability
        assert entries.keys() == expected.keys()
        for name, value in entries.items():
            assert value == pytest.approx(expected[name], rel=1e-5, abs=1e-6), name


def test_the_centre_sees_no_sensor() -> None:
    everything, centre = make(), make(information="centre")
    kept = [not name.startswith(SENSOR_BLOCKS) for name in everything.unwrapped.observation_names]
    assert centre.unwrapped.observation_names == tuple(
        name
        for name, keep in zip(everything.unwrapped.observation_names, kept, strict=True)
        if keep
    )
    assert 0 < sum(kept) < len(kept)
    first, _ = everything.reset(seed=2)
    second, _ = centre.reset(seed=2)
    for _ in range(20):
        np.testing.assert_array_equal(first[kept], second)
        action = np.array([1, 0, 1])
        first, second = everything.step(action)[0], centre.step(action)[0]


@pytest.mark.parametrize("information", ["sensors", "centre"])
def test_who_can_tell_what_was_measured(information: str) -> None:
    """The centre's observation ignores the new measurements; nobody's looks at the truth."""
    env = make(information=information).unwrapped
    env.reset(seed=4)
    before = env.batch.observe()
    env.batch.state.truth = env.batch.state.truth + 2.0
    np.testing.assert_array_equal(env.batch.observe(), before)
    env.batch.state.measurement = env.batch.state.measurement + 2.0
    unchanged = np.array_equal(env.batch.observe(), before)
    assert unchanged == (information == "centre")


def test_extreme_entries_are_clipped_to_their_bounds() -> None:
    env = make().unwrapped
    env.reset(seed=4)
    state, space = env.batch.state, env.observation_space
    sensed = [n.startswith(("whitened", "held")) for n in env.observation_names]
    assumed = [n.startswith(("log_variance", "estimate")) for n in env.observation_names]
    for sign, bound in ((1.0, space.high), (-1.0, space.low)):
        state.measurement = np.full_like(state.measurement, sign * 1e6)
        state.prior_mean = np.full_like(state.prior_mean, sign * 1e6)
        state.prior_covariance = np.eye(2)[..., None] * 10.0 ** (9.0 * sign)
        observation = env.batch.observe()[0]
        assert space.contains(observation)
        for entries in (sensed, assumed):
            np.testing.assert_array_equal(observation[entries][1:], bound[entries][1:])


def test_withheld_signals() -> None:
    env = make(information="centre").unwrapped
    env.reset(seed=0)
    signals = env.batch.signals()
    hidden = {s.name for s in env.task.system.signals if s.knowledge == "own"}
    assert hidden == {"measurement", "innovation", "censored"}
    assert hidden.isdisjoint(signals)
    assert {"age", "held", "variance_reduction", "tokens", "observation"} <= set(signals)
    for name in hidden:
        with pytest.raises(LookupError, match=rf"'{name}'.*information='centre'"):
            signals[name]
    with pytest.raises(LookupError, match="unknown signal 'nonsense'"):
        signals["nonsense"]


@pytest.mark.parametrize("error", ["squared", "trace"])
@pytest.mark.parametrize("sharing", ["equal", "fixed", "rotating"])
def test_infos_and_the_terms_of_the_reward(sharing: str, error: str) -> None:
    cost = np.array([3.0, 1.0, 2.0])
    weights = np.array([0.5, 0.25])
    env = make(
        token_cost=cost,
        sharing=sharing,
        error=error,
        error_weight=2.0,
        cost_weight=0.3,
        state_weights=weights,
        token_rate=2.0,
    )
    _, info = env.reset(seed=11)
    keys = {"cost", "cost_tokens", "rewards", "granted", "denied", "squared_error", "diverged"}
    assert info.keys() == keys
    assert not info["diverged"]
    assert info["cost"] == info["cost_tokens"] == 0.0
    assert info["rewards"] == {"error": 0.0, "communication": 0.0}
    assert not info["granted"].any()
    assert not info["denied"].any()
    assert not info["squared_error"].any()
    rng = np.random.default_rng(1)
    system, denied = env.unwrapped.task.system, 0
    for _ in range(100):
        action = rng.integers(0, 2, 3)
        _, reward, _, _, info = env.step(action)
        assert info.keys() == keys
        assert type(reward) is float
        assert info["cost"] == info["cost_tokens"] == pytest.approx(cost @ info["granted"])
        assert info["cost"] >= 0.0
        np.testing.assert_array_equal(info["granted"] | info["denied"], action == 1)
        assert not (info["granted"] & info["denied"]).any()
        delivered = env.unwrapped.batch.delivered
        mean, covariance = system.fused(delivered)
        squared = (system.truth(delivered) - mean)[:, 0] ** 2
        np.testing.assert_allclose(info["squared_error"], squared, rtol=1e-12)
        size = squared if error == "squared" else np.diagonal(covariance[..., 0])
        assert info["rewards"]["error"] == pytest.approx(-2.0 * weights @ size)
        assert info["rewards"]["communication"] == pytest.approx(-0.3 * info["cost"])
        assert reward == pytest.approx(sum(info["rewards"].values()), rel=1e-14)
        denied += info["denied"].sum()
    assert denied > 0


def test_silence_costs_about_one_a_step() -> None:
    env = make_vector(1000, filter="tobit")
    env.reset(seed=0)
    rewards = [env.step(np.zeros((1000, 3), dtype=np.int8))[1] for _ in range(100)]
    assert np.mean(rewards) == pytest.approx(-1.0, abs=0.1)


@pytest.mark.parametrize("horizon", [1, 7, 100])
def test_truncation_at_the_horizon_and_no_termination(horizon: int) -> None:
    env = make(horizon=horizon)
    for _ in range(2):
        env.reset()
        for step in range(1, horizon + 1):
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            assert terminated is False
            assert truncated is (step == horizon)
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.step(env.action_space.sample())


@pytest.mark.parametrize(("limit", "length"), [(13, 13), (500, 100)])
def test_time_limit_of_gymnasium(limit: int, length: int) -> None:
    env = make(max_episode_steps=limit)
    assert isinstance(env, TimeLimit)
    assert env.unwrapped.task.horizon == 100
    for _ in range(2):
        env.reset()
        for step in range(1, length + 1):
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            assert not terminated
            assert truncated is (step == length)


@pytest.mark.parametrize("options", [{"max_episode_steps": 13}, {"horizon": 13}], ids=str)
def test_limit_of_the_vector_environment(options: dict[str, int]) -> None:
    env = make_vector(3, **options)
    assert env.task.horizon == 13
    env.reset(seed=0)
    for step in range(1, 40):
        _, _, terminated, truncated, _ = env.step(np.zeros((3, 3), dtype=np.int8))
        assert not terminated.any()
        assert (truncated == (step % 14 == 13)).all()  # every 14th step is the reset


@pytest.mark.filterwarnings("error")
def test_a_bound_starved_for_thousands_of_steps_does_not_overflow() -> None:
    env = gymnasium.make("fusion_gym/TobitOscillator-v0", horizon=4000)
    env.reset(seed=0)
    for _ in range(4000):
        observation, reward, _, truncated, _ = env.step(np.zeros(3, dtype=np.int8))
        assert np.isfinite(reward)
        assert np.isfinite(observation).all()
    assert truncated
