"""Observing at a price: the joint action of any Gymnasium environment."""

import functools
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from refusals import refused
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as check_sb3
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from fusion_gym.wrappers import CostlyObservation

SENSORS = {
    "CartPole-v1": [[0, 1], [2, 3]],
    "Pendulum-v1": [[0, 1], [2]],
    "Bits-v0": [[0], [1], [2]],
    "Counts-v0": [[0, 2], [1]],
}


class Bits(gymnasium.Env[Any, Any]):
    """A sum of the actions that it received; its action is a row of bits."""

    observation_space = spaces.Box(-100, 100, (3,), np.int64)
    action_space: Any = spaces.MultiBinary(3)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.total = self.np_random.integers(-5, 5, 3)
        return self.total.copy(), {}

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action)
        self.total = np.clip(self.total + 2 * np.resize(action, 3) - 1, -100, 100)
        return self.total.copy(), float(self.total[0]), False, bool(self.total[1] > 20), {}


class Counts(Bits):
    """Its action has numbers from 2 on."""

    action_space = spaces.MultiDiscrete([3, 2], start=[2, 0])


@pytest.fixture(autouse=True)
def environments(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in (Bits, Counts):
        name = f"{kind.__name__}-v0"
        spec = gymnasium.envs.registration.EnvSpec(name, entry_point=kind)
        monkeypatch.setitem(gymnasium.registry, name, spec)


def make(env_id: str, **arguments: Any) -> CostlyObservation:
    arguments = {"price": 0.25, "sensor_indices": SENSORS[env_id]} | arguments
    return CostlyObservation(gymnasium.make(env_id), **arguments)


def joint(env: CostlyObservation, own: Any, requests: Any) -> Any:
    """The wrapper's action of an action of its environment and requests 0 or 1."""
    signed = isinstance(env.action_space, spaces.Box)
    asked = 2.0 * np.asarray(requests) - 1.0 if signed else np.asarray(requests)
    return np.append(own, asked).astype(env.action_space.dtype)


@pytest.mark.parametrize("predictor", ["hold", "linear"])
@pytest.mark.parametrize("env_id", SENSORS)
def test_the_checkers_of_both_libraries_pass(env_id: str, predictor: str) -> None:
    env = make(env_id, predictor=predictor, token_rate=0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env, skip_render_check=True)
        if env_id != "Counts-v0":  # Stable-Baselines3 counts actions from 0
            check_sb3(env)
    assert isinstance(env.spec, gymnasium.envs.registration.EnvSpec)
    again = gymnasium.make(env.spec)
    assert isinstance(again, CostlyObservation)
    env.action_space.seed(0)
    pairs = [(env.reset(seed=4), again.reset(seed=4))]
    for _ in range(9):
        action = env.action_space.sample()
        pairs.append((env.step(action)[:2], again.step(action)[:2]))
    for one, other in pairs:
        np.testing.assert_array_equal(one[0], other[0])
        assert isinstance(one[1], dict) or one[1] == other[1]


@pytest.mark.parametrize("env_id", SENSORS)
def test_who_requests_everything_sees_the_environment_itself(env_id: str) -> None:
    env, bare = make(env_id, price=[0.25, *[0.5] * (len(SENSORS[env_id]) - 1)]), None
    bare = gymnasium.make(env_id)
    sensors, size = len(SENSORS[env_id]), bare.observation_space.shape[0]  # type: ignore[index]
    bare.action_space.seed(3)
    shown, info = env.reset(seed=3)
    seen, _ = bare.reset(seed=3)
    assert info["cost"] == 0.0
    for step in range(8):
        np.testing.assert_array_equal(shown[:size], np.asarray(seen, np.float32))
        np.testing.assert_array_equal(info["observation"], seen)
        own, silent = bare.action_space.sample(), step == 7
        shown, reward, *ends, info = env.step(joint(env, own, [0 if silent else 1] * sensors))
        seen, expected, *others, _ = bare.step(own)
        paid = 0.0 if silent else 0.25 + 0.5 * (sensors - 1)
        assert reward == pytest.approx(float(expected) - paid)
        assert ends == others
        assert info["cost"] == (0.0 if silent else sensors)
    np.testing.assert_allclose(shown[size:], 1.0 / 11.0)


def test_what_is_not_requested_is_held_or_predicted() -> None:
    held, linear = make("CartPole-v1"), make("CartPole-v1", predictor="linear")
    lean = make("CartPole-v1", predictor=lambda seen, action: seen + action[:, None])
    first = {env: env.reset(seed=1)[0] for env in (held, linear, lean)}
    for step in range(6):
        action = joint(held, step % 2, [0, 1])
        shown, _, _, _, info = held.step(action)
        np.testing.assert_array_equal(shown[:2], first[held][:2])
        np.testing.assert_array_equal(shown[2:4], info["observation"][2:])
        np.testing.assert_allclose(shown[4:], [(step + 1) / (step + 11), 0.0], rtol=1e-6)
        shown, _, _, _, info = linear.step(joint(held, step % 2, [0, 0]))
        np.testing.assert_allclose(shown[:4], info["observation"], atol=5e-3)
        shown, *_ = lean.step(joint(held, step % 2, [0, 0]))
        pushed = np.minimum(first[lean][:4] + (step + 1) // 2, lean.observation_space.high[:4])
        np.testing.assert_allclose(shown[:4], pushed, rtol=1e-6)
    assert linear.predictor.explained_variance.min() > 0.99
    assert held.predictor.explained_variance.max() < 0.1


def test_a_bucket_pays_for_the_first_sensors() -> None:
    env = make("Bits-v0", token_rate=0.5, token_capacity=2.0)
    shown, _ = env.reset(seed=0)
    assert shown[-1] == 1.0
    rows = [env.step([0, 0, 0, 1, 1, 1]) for _ in range(5)]
    assert [row[4]["cost"] for row in rows] == [2.0, 0.0, 1.0, 0.0, 1.0]
    np.testing.assert_allclose([row[0][-1] for row in rows], [0.0, 0.25, 0.0, 0.25, 0.0])
    third = [row[0][-2] for row in rows]
    np.testing.assert_allclose(third, np.arange(1, 6) / np.arange(11, 16), rtol=1e-6)
    assert env.reset()[0][-1] == 1.0


def test_copies_of_a_vector_differ_without_a_seed() -> None:
    wrap = functools.partial(
        CostlyObservation, sensor_indices=[[0, 1, 2, 3]], price=0.0, predictor="linear"
    )
    envs = gymnasium.make_vec("CartPole-v1", 3, vectorization_mode="sync", wrappers=[wrap])
    seen, _ = envs.reset()
    assert seen.shape == (3, 5)
    assert len(np.unique(seen[:, 0])) == 3
    *_, info = envs.step(envs.action_space.sample())
    assert info["cost"].shape == (3,)


def test_an_agent_of_stable_baselines_acts() -> None:
    env = make("Pendulum-v1", predictor="linear", token_rate=0.3)
    model = PPO("MlpPolicy", Monitor(env), n_steps=32, batch_size=32, seed=0, device="cpu").learn(
        32
    )
    mean, _ = evaluate_policy(model, model.get_env(), 1)
    assert -1e5 < float(np.mean(mean)) < 0.0


class Wordy(Bits):
    observation_space: Any = spaces.Dict({"a": spaces.Discrete(2)})


class Tuples(Bits):
    action_space = spaces.Tuple((spaces.Discrete(2),))


REFUSALS: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "an entry that is not there": ({"sensor_indices": [[0, 1, 2, 3, 4]]}, ("sensor_indices", "3")),
    "an entry of nobody": ({"sensor_indices": [[0, 1]]}, ("sensor_indices", "all of them")),
    "a negative price": ({"price": -0.1}, ("price = -0.1", ">= 0")),
    "three prices": ({"price": [0.1, 0.2, 0.3]}, ("price",)),
    "no predictor": ({"predictor": "holds"}, ("predictor = 'holds'",)),
    "no function": ({"predictor": 3}, ("predictor = 3", "'hold'")),
    "half a prediction": ({"predictor": lambda seen, _: seen[:, :2]}, ("predictor", "shape")),
    "a negative rate": ({"token_rate": -1.0}, ("token_rate = -1",)),
    "no room for a token": ({"token_rate": 1, "token_capacity": 0.5}, ("token_capacity = 0.5",)),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_what_does_not_fit_is_refused(name: str) -> None:
    arguments, parts = REFUSALS[name]
    refused(lambda: make("CartPole-v1", **arguments), *parts)


@pytest.mark.parametrize("kind", [Wordy, Tuples])
def test_an_environment_that_does_not_fit_is_refused(kind: Any) -> None:
    refused(lambda: CostlyObservation(kind(), [[0]], 0.1), "env = ", "environment")


def test_an_environment_without_a_specification_is_refused() -> None:
    refused(lambda: CostlyObservation(Bits(), [[0, 1, 2]], 0.1), "env = ", "gymnasium.make")
