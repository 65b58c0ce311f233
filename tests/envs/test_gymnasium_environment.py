"""Any Gymnasium environment as the plant: its own returns, agents, predictors, refusals."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray
from refusals import refused
from stable_baselines3 import PPO

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.envs.gymnasium_environment import balance
from fusion_gym.evaluation import run_episodes
from fusion_gym.importing import refuse_code

ID = "fusion_gym/GymnasiumEnvironment-v1"
SWING: dict[str, Any] = {
    "env_id": "Pendulum-v1", "sensor_indices": [[0, 1], [2]], "best_reward": 0.0,
}  # fmt: skip


def lean(observations: NDArray[Any]) -> Any:
    """Push the cart against its pole's angle alone, which fails soon."""
    return (observations[:, 2] > 0.0).astype(int)


def swing(observations: NDArray[Any]) -> Any:
    return -observations[:, 1:2] - 0.5 * observations[:, 2:]


def task_of(**options: Any) -> Task:
    return fusion_gym.make_task(ID, **options)


def own_return(task: Task, seed: int, controller: Callable[..., Any], **more: Any) -> float:
    """The return of the environment itself, without sensors and network."""
    batch = EpisodeBatch.seeded(task, 1, seed)
    noise = batch.source.start(seed, 0, 1)
    env: Any = gymnasium.make(task.settings["env_id"], max_episode_steps=task.horizon, **more)
    seen, _ = env.reset(seed=int(noise.view(np.uint64)[0]) >> 21)
    total, over = 0.0, False
    while not over:
        action = np.asarray(controller(seen[None]))[0]
        seen, reward, *ends, _ = env.step(action)
        total, over = total + float(reward), any(ends)
    return total


@pytest.mark.parametrize(
    ("options", "controller"),
    [
        ({"controller": lean}, lean),
        ({}, balance),
        (SWING | {"controller": swing, "env_kwargs": {"g": 9.0}}, swing),
    ],
)
def test_an_episode_costs_what_the_environment_returns_less(
    options: dict[str, Any], controller: Callable[..., Any]
) -> None:
    task = task_of(horizon=120, **options)
    results = run_episodes(task, fusion_gym.make_policy("always", task), 4, seed=7)
    best, own = task.settings["best_reward"], options.get("env_kwargs") or {}
    expected = [best - own_return(task, 7 + i, controller, **own) / 120 for i in range(4)]
    np.testing.assert_allclose(results.control_cost, expected, atol=1e-12)
    assert results.control_cost is not None
    spent = 0.1 * results.tokens
    np.testing.assert_allclose(-results.returns, 120 * (results.control_cost + spent))
    assert (results.mse == 0.0).all() or controller is lean  # a fall is not transmitted
    assert max(expected) > 0.1 or controller is balance


def test_an_agent_of_stable_baselines_acts(tmp_path: Path) -> None:
    model = PPO("MlpPolicy", "CartPole-v1", n_steps=64, batch_size=64, seed=0, device="cpu")
    model.learn(64).save(tmp_path / "agent.zip")

    def act(seen: NDArray[Any]) -> Any:
        return model.predict(seen, deterministic=True)[0]

    agents = f"model:{tmp_path}/agent.zip", act
    tasks = [task_of(controller=agent, horizon=40) for agent in agents]
    saved, loaded = (
        run_episodes(task, fusion_gym.make_policy("periodic:period=3", task), 5) for task in tasks
    )
    assert saved.control_cost is not None
    np.testing.assert_array_equal(saved.control_cost, loaded.control_cost)
    seen = np.random.default_rng(0).normal(size=(4, 6))
    controller: Any = tasks[0].controller
    np.testing.assert_array_equal(controller.act(seen)[0], act(seen.T.astype(np.float32)))
    refused(lambda: task_of(**SWING, controller=agents[0]), "agent.zip", "(3,)")


def test_a_predictor_carries_the_estimate_through_silence() -> None:
    """CartPole's step is linear, but for its acceleration; the pendulum's is not."""
    linear = task_of(predictor="linear")
    plant: Any = linear.plant
    assert plant.system.predictor.explained_variance.min() > 0.98
    still = task_of(predictor=lambda seen, action: seen + 0.0 * action[:, None])
    errors = [
        run_episodes(task, fusion_gym.make_policy("periodic:period=4", task), 20, 0).mse.mean()
        for task in (task_of(), linear, still)
    ]
    assert errors[1] < 0.01 * errors[0]
    assert errors[2] < errors[0]  # it corrects entries by what others show
    pendulum: Any = task_of(**SWING, controller=swing, predictor="linear").plant
    assert pendulum.system.predictor.explained_variance[0] < 0.7


def test_a_file_that_names_code_needs_trust() -> None:
    codes = {"env_id": "antigravity:CartPole-v1", "controller": "antigravity:act"}
    for name, value in codes.items():
        refused(lambda: refuse_code({"options": {name: value}}, "plan.yaml"), name, "--trust")  # noqa: B023
    refuse_code({"env_id": "CartPole-v1", "controller": "model:agent.zip"}, "plan.yaml")


def test_live_environments_cannot_go_back() -> None:
    batch = EpisodeBatch.seeded(task_of(), 2, 0)
    state, every = batch.state.plant, np.ones((2, 2), bool)
    batch.step(every)
    refused(lambda: batch.task.plant.sense(state, np.zeros((0, 2)), np.zeros((1, 2))), "branch")
    refused(batch.branch, "its states cannot branch")
    with pytest.warns(UserWarning, match="GymnasiumPlant"):
        EpisodeBatch.seeded(task_of(backend="compiled"), 1, 0)
    refused(lambda: fusion_gym.make_policy("rollout:base=always", task_of()), "GymnasiumPlant")


def test_a_copy_repeats_the_actions() -> None:
    """A checkpoint, or a worker process, continues the same episodes."""
    batch = EpisodeBatch.seeded(task_of(**SWING, controller=swing), 3, 0)
    every = np.ones((2, 3), bool)
    for _ in range(20):
        batch.step(every)
    state = batch.state.plant
    copied = pickle.loads(pickle.dumps(state))
    noise, control = np.zeros((0, 3)), np.array([[1.0, -2.0, 0.5]])
    rows = [batch.task.plant.sense(each, noise, control) for each in (copied, state)]
    np.testing.assert_array_equal(rows[0].truth, rows[1].truth)
    np.testing.assert_array_equal(rows[0].loss, rows[1].loss)
    assert np.ptp(rows[0].truth, axis=1).all()


def test_the_lander_lands_under_its_own_controller() -> None:
    pytest.importorskip("Box2D")
    from examples.any_environment import heuristic

    sensors = [[0, 1], [2, 3], [4, 5], [6, 7]]
    task = task_of(
        env_id="LunarLander-v3", controller=heuristic, sensor_indices=sensors, best_reward=100.0,
        horizon=300, predictor="linear",
    )  # fmt: skip
    results = run_episodes(task, fusion_gym.make_policy("always", task), 2, seed=3)
    expected = [100.0 - own_return(task, 3 + i, heuristic) / 300 for i in range(2)]
    np.testing.assert_allclose(results.control_cost, expected, atol=1e-9)
    assert min(expected) < 100.0 - 150.0 / 300


@pytest.mark.slow
def test_the_example_prints_its_rows(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from examples import any_environment

    monkeypatch.setattr(any_environment, "FOLDER", tmp_path)
    any_environment.cart_pole(steps=2_048, episodes=4, timesteps=8_192)
    any_environment.joint(timesteps=1_024, steps=2_048, episodes=4)
    rows = capsys.readouterr().out.splitlines()
    for policy, count in {"always": 4, "periods": 3, "innovation_threshold": 4, "PPO": 3}.items():
        assert len([row for row in rows if row.startswith(policy)]) == count


def test_a_film_shows_the_environment() -> None:
    task = task_of(env_kwargs={"render_mode": "rgb_array"}, horizon=6)
    always = {"always": fusion_gym.make_policy("always", task)}
    frames = list(fusion_gym.evaluation.watch(task, always))
    (plain,) = fusion_gym.evaluation.watch(task_of(horizon=6), always, steps=1)
    height, width, _ = plain.shape
    assert {frame.shape for frame in frames} == {(max(height, 400), width + 600, 3)}
    own = [frame[:400, width:] for frame in frames]
    assert (own[0] != own[-1]).any()
    env: Any = gymnasium.make(ID, render_mode="rgb_array", env_kwargs={"render_mode": "rgb_array"})
    env.reset(seed=0)
    assert env.render().shape == frames[0].shape


class Wordy(gymnasium.Env[Any, Any]):
    """Its observation is a dictionary."""

    observation_space = spaces.Dict({"a": spaces.Discrete(2)})
    action_space = spaces.Discrete(2)


class Tuples(Wordy):
    """Its action is a tuple."""

    observation_space = spaces.Box(-1.0, 1.0, (4,))
    action_space = spaces.Tuple((spaces.Discrete(2),))


@pytest.fixture(autouse=True)
def environments(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in (Wordy, Tuples):
        name = f"{kind.__name__}-v0"
        spec = gymnasium.envs.registration.EnvSpec(name, entry_point=kind)
        monkeypatch.setitem(gymnasium.registry, name, spec)


REFUSALS: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "another id": ({"env_id": "CartPoler-v9"}, ("env_id = 'CartPoler-v9'", "gymnasium.make")),
    "another argument": ({"env_kwargs": {"speed": 3}}, ("env_kwargs", "speed")),
    "no dictionary": ({"env_kwargs": 3}, ("env_kwargs = 3",)),
    "an entry that is not there": (
        {"sensor_indices": [[0, 1], [2, 4]]},
        ("sensor_indices", "0 to 3"),
    ),
    "an entry of nobody": ({"sensor_indices": [[0, 1], [2]]}, ("sensor_indices", "all of them")),
    "a sensor of nothing": ({"sensor_indices": [[0, 1, 2, 3], []]}, ("sensor_indices",)),
    "an entry twice": ({"sensor_indices": [[0, 1, 1], [2, 3]]}, ("sensor_indices",)),
    "half an entry": ({"sensor_indices": [[0, 1.5], [2, 3]]}, ("sensor_indices",)),
    "a dictionary as observation": ({"env_id": "Wordy-v0"}, ("env_id = 'Wordy-v0'", "vector")),
    "a tuple as action": ({"env_id": "Tuples-v0"}, ("env_id = 'Tuples-v0'", "Tuple")),
    "no function": ({"controller": 3}, ("controller = 3", "function")),
    "an agent of nobody": ({"controller": "model:absent.zip"}, ("absent.zip", "no such file")),
    "two actions": ({"controller": lambda seen: np.zeros((len(seen), 2))}, ("controller", "shape")),
    "no predictor": ({"predictor": 3}, ("predictor = 3", "'hold'")),
    "half a prediction": ({"predictor": lambda seen, _: seen[:, :2]}, ("predictor", "shape")),
    "more than the best": ({"best_reward": 0.5}, ("best_reward = 0.5", "at least 1")),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_what_does_not_fit_is_refused(name: str) -> None:
    options, parts = REFUSALS[name]
    refused(lambda: task_of(**options), *parts)
