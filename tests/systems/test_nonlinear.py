"""The base of a system of one's own, and the example that uses it."""

import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from gymnasium.utils.env_checker import check_env
from linear_case import DEVIATION, MEAN, START, A, C, Linear, W, build
from numpy.typing import NDArray
from parts import Parts
from paths import ROOT

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import CommonOptions, Scenario, Task
from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.systems.linear_plant import LinearPlant
from fusion_gym.systems.nonlinear import NonlinearSystem
from fusion_gym.validation import ConfigurationError

EXAMPLE = ROOT / "examples" / "pendulum_ekf.py"
Array = NDArray[np.float64]


@pytest.fixture
def linear(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setitem(ENVIRONMENTS, "me/Linear-v0", build)
    return fusion_gym.make_task("me/Linear-v0", tokens="unlimited")


@pytest.fixture(scope="module")
def pendulum() -> Iterator[ModuleType]:
    specification = importlib.util.spec_from_file_location("pendulum_ekf", EXAMPLE)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules["pendulum_ekf"] = module
    specification.loader.exec_module(module)
    yield module
    del ENVIRONMENTS["examples/Pendulum-v0"], gym.registry["examples/Pendulum-v0"]
    del sys.modules["pendulum_ekf"]


def test_a_linear_case_is_filterpys(linear: Any) -> None:
    batch = EpisodeBatch.seeded(linear, 1, 3)
    beside = KalmanFilter(dim_x=2, dim_z=1)
    beside.x, beside.P, beside.F, beside.Q = MEAN.copy(), START.copy(), A, W
    generator = np.random.default_rng(0)
    for _ in range(40):
        signals = batch.signals()
        beside.predict()
        np.testing.assert_allclose(signals["prior_covariance"][..., 0], beside.P, atol=1e-12)
        deviation = np.sqrt(np.diag(C @ beside.P @ C.T) + DEVIATION**2)
        np.testing.assert_allclose(signals["innovation_deviation"][:, 0, 0], deviation, rtol=1e-9)
        reduction = signals["variance_reduction"][:, 0]
        requests = generator.random((2, 1)) < 0.4
        for sensor in range(2):
            stored = beside.P.copy(), beside.x.copy()
            prior = np.trace(beside.P)
            measured = signals["measurement"][sensor, :, 0]
            beside.update(measured, R=DEVIATION[sensor] ** 2, H=C[sensor][None])
            if sensor == 0:
                assert reduction[0] == pytest.approx(prior - np.trace(beside.P))
            if not requests[sensor, 0]:
                beside.P, beside.x = stored
        batch.step(requests)
        mean, covariance = Parts.of(linear).fused(batch.delivered)
        np.testing.assert_allclose(mean[:, 0], beside.x, atol=1e-10)
        np.testing.assert_allclose(covariance[..., 0], beside.P, atol=1e-12)


def test_a_known_start_is_the_limit_of_uncertain_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    results = []
    for start in (0.0, 1e-12):
        monkeypatch.setattr("linear_case.START", start * np.eye(2))
        made = Linear()
        system = Parts(made.plant, made.estimator)
        noise = np.random.default_rng(0).standard_normal((6, 6, 3))
        state = system.start(noise[0, :4])
        assert (state.estimate.covariance == start * np.eye(2)[..., None]).all()
        for step in noise[1:]:
            state = system.deliver(system.sense(state, step[:4]), step[4:] > 0.0)
        mean, covariance = system.fused(state)
        results.append(np.concatenate([mean, covariance.reshape(4, 3)]))
    np.testing.assert_allclose(*results, rtol=1e-4, atol=1e-5)


def test_open_loop_by_simulation(linear: Any) -> None:
    plant = LinearPlant.create(A, W, MEAN, START)
    # A mean of squares over 1,000 correlated runs: about 1/√500 of it.
    np.testing.assert_allclose(linear.plant.open_loop(30), plant.open_loop(30), rtol=0.12)
    assert linear.plant.open_loop(30).tolist() == Linear().plant.open_loop(30).tolist()


def test_the_example_runs() -> None:
    root = EXAMPLE.parent.parent
    done = subprocess.run([sys.executable, EXAMPLE], cwd=root, capture_output=True, text=True,
                          env={"PYTHONPATH": str(root), "PATH": ""}, check=True)  # fmt: skip
    assert done.stdout.count("NEES") == 4


def test_the_pendulums_filter_is_consistent(pendulum: ModuleType) -> None:
    task = fusion_gym.make_task("examples/Pendulum-v0")
    for name in ("always", "periodic:period=6"):
        results = run_episodes(task, make_policy(name, task), 400, 0)
        assert results.nees.mean() == pytest.approx(1.0, abs=0.1)
        assert not results.diverged.any()
    watchful = make_policy("value_of_information:threshold=0.02,at_most=1", task)
    periodic = run_episodes(task, make_policy("periodic:period=6", task), 400, 0)
    outcome = run_episodes(task, watchful, 400, 0)
    assert outcome.mse.mean() < periodic.mse.mean()
    assert outcome.rate.mean() < 1.1 * periodic.rate.mean()


def test_the_pendulum_has_every_interface(pendulum: ModuleType) -> None:
    name = "examples/Pendulum-v0"
    check_env(gym.make(name, memory=True, horizon=20).unwrapped, skip_render_check=True)
    rows = fusion_gym.make_sb3_vec_env(name, num_envs=3, local=True, memory=True, horizon=20)
    assert np.isfinite(rows.reset()).all()
    envs = gym.make_vec(name, num_envs=4, horizon=5, packet="estimate", memory=True)
    envs.reset(seed=0)
    for _ in range(11):
        observation, reward, *_ = envs.step(envs.action_space.sample())
        assert np.isfinite(observation).all()
        assert np.isfinite(reward).all()
    task = fusion_gym.make_task(name, horizon=30)
    policy = make_policy("rollout:samples=4,price=0.01,base=periodic:period=5", task)
    assert np.isfinite(run_episodes(task, policy, 4, 0).mse).all()


def test_what_does_not_fit_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigurationError, match="initial_covariance"):
        Shaped(initial_covariance=-np.eye(2))
    with pytest.raises(ConfigurationError, match="sensors = 0"):
        Shaped(sensors=0)
    narrow: Any = type("Narrow", (Linear,), {"available": lambda self, state, noise: noise[0] < 0})
    with pytest.raises(ValueError, match=r"available of shape \(1000,\) .* it must be \(2, 1000\)"):
        narrow().plant.open_loop(2)
    monkeypatch.setitem(ENVIRONMENTS, "me/Flat-v0", build_flat)
    with pytest.raises(ValueError, match="measure of shape"):
        fusion_gym.make_task("me/Flat-v0")


class Dropping(Linear):
    """Readings at random, and none of the second sensor where the first state is positive."""

    def available(self, state: Array, noise: Array) -> NDArray[np.bool_]:
        return (noise < 0.8) & (np.array([[-np.inf], [0.0]]) < -state[0])


def kalman(mean: Array, covariance: Array, measured: Array, arrived: Array) -> tuple[Array, Array]:
    """One step of a Kalman filter with the packets that arrive, in one update."""
    mean, covariance = A @ mean, A @ covariance @ A.T + W
    rows, noise = C[arrived], np.diag(DEVIATION[arrived] ** 2)
    gain = covariance @ rows.T @ np.linalg.inv(rows @ covariance @ rows.T + noise)
    return mean + gain @ (measured[arrived] - rows @ mean), covariance - gain @ rows @ covariance


def test_a_sensor_without_a_reading_neither_requests_nor_counts() -> None:
    """Whatever is requested, also in a memory of all readings; everything from the normals."""
    system, request = Dropping(), np.random.default_rng(0).random((40, 2, 1)) < 0.7
    options = CommonOptions(memory=True, tokens="unlimited", reward_scale=1.0)
    task = Task.create(Scenario(options, system.plant, system.estimator))
    batch = EpisodeBatch.seeded(task, 1, 5)
    truth = Parts.of(task).truth(batch.state)[:, 0]
    sent = every = MEAN, START
    missing = np.zeros(2)
    for step, requests in enumerate(request):
        normals = batch.normals()[:, 0]
        truth = A @ truth + np.sqrt(W) @ normals[:2] if step else truth
        measured = C @ truth + DEVIATION * normals[2:4]
        present = (normals[4:] < 0.8) & ((truth[0] < 0.0) | np.array([True, False]))
        missing += ~present
        signals = batch.signals()
        np.testing.assert_array_equal(signals["sampled"][:, 0], present)
        np.testing.assert_array_equal(signals["admitted"][:, 0], present)
        assert not signals["innovation"][~present].any()
        assert not signals["variance_reduction"][~present].any()
        np.testing.assert_allclose(signals["measurement"][present, 0, 0], measured[present])
        every = kalman(*every, measured, present)
        best = batch.beliefs().best
        np.testing.assert_allclose(best.mean[0, :, 0], every[0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(best.covariance[0, ..., 0], every[1], rtol=0, atol=1e-12)
        outcome = batch.step(requests)
        np.testing.assert_array_equal(outcome.granted[:, 0], requests[:, 0] & present)
        sent = kalman(*sent, measured, requests[:, 0] & present)
        mean, covariance = Parts.of(task).fused(batch.delivered)
        np.testing.assert_allclose(mean[:, 0], sent[0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(covariance[..., 0], sent[1], rtol=0, atol=1e-12)
    assert (missing > 3).all()
    assert Linear().plant.noise_channels + 2 == system.plant.noise_channels


class Shaped(Linear):
    """Other arguments, and measurements without an axis for the channels."""

    def __init__(self, **changes: Any) -> None:
        content = {"sensors": 2, "initial_covariance": START} | changes
        NonlinearSystem.__init__(self, ("a", "b"), process_channels=2, initial_mean=MEAN, **content)

    def measure(self, state: Array, noise: Array) -> Array:
        return C @ state


def build_flat(options: CommonOptions) -> Scenario:
    system = Shaped()
    return Scenario(options, system.plant, system.estimator)
