"""Closed loops: costs by recursions, estimation errors that no input changes, ends, refusals."""

import dataclasses
import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import linear_case
import numpy as np
import pytest
from refusals import refused
from scipy.linalg import solve_discrete_are

import fusion_gym
import fusion_gym.jax
from fusion_gym import Controller, Scenario
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.estimator import Reception
from fusion_gym.core.task import CommonOptions, Task
from fusion_gym.envs.privileged import PrivilegedVecEnv
from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.evaluation import record_episode, run_episodes
from fusion_gym.evaluation.episodes import run_several
from fusion_gym.solvers.silence import cost_bound

LINEAR = "fusion_gym/LinearFusion-v2"
PENDULUM = "examples.inverted_pendulum:examples/InvertedPendulum-v0"
Options = dict[str, Any]
FREE: Options = {"tokens": "unlimited"}
B = np.array([[0.0], [0.5]])
SCALAR: Options = {
    "transition": [[1.1]],
    "process_covariance": [[0.2]],
    "measurement_matrices": [[1.0]],
    "measurement_covariances": 0.1,
    "initial_covariance": [[0.5]],
    "input_matrix": [[0.5]],
    "control_weights": ([[2.0]], [[0.3]]),
    "horizon": 60,
}


# --- costs by recursions ------------------------------------------------------------------------


def periodic_cost(options: Options, gain: np.ndarray, period: int) -> float:
    """The mean cost of a step if every measurement is sent once in ``period`` steps.

    x̂ and e = x − x̂ are independent, so E xᵀQx + uᵀRu needs their covariances alone.
    """
    a, b, w, c = (
        np.atleast_2d(options[name])
        for name in ("transition", "input_matrix", "process_covariance", "measurement_matrices")
    )
    q, r = map(np.atleast_2d, options["control_weights"])
    error = np.atleast_2d(options["initial_covariance"])
    noise = np.eye(len(c)) * options["measurement_covariances"]
    mean, cost = np.zeros_like(error), 0.0
    for time in range(options["horizon"] + 1):
        if time > 0:
            mean, error = (a - b @ gain) @ mean @ (a - b @ gain).T, a @ error @ a.T + w
        if time == 0 or (time - 1) % period == 0:
            correction = error @ c.T @ np.linalg.solve(c @ error @ c.T + noise, c @ error)
            mean, error = mean + correction, error - correction
        if time > 0:
            cost += np.trace(q @ (mean + error)) + np.trace(r @ gain @ mean @ gain.T)
    return float(cost) / options["horizon"]


def regulator(options: Options) -> np.ndarray:
    a, b = (np.atleast_2d(options[name]) for name in ("transition", "input_matrix"))
    q, r = map(np.atleast_2d, options["control_weights"])
    p = solve_discrete_are(a, b, q, r)
    return np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)


def jax_costs(options: Options, period: int, runs: int) -> np.ndarray:
    env, params = fusion_gym.jax.make(LINEAR, **options)
    horizon = options["horizon"]

    def episode(key: Any) -> Any:
        first, key = jax.random.split(key)

        def step(state: Any, place: Any) -> Any:
            action = (place % period == 0).astype(int)[None]
            _, state, *_, info = env.step(jax.random.fold_in(key, place), state, action, params)
            return state, info["control_cost"]

        return jax.lax.scan(step, env.reset(first, params)[1], jax.numpy.arange(horizon))[1].mean()

    return np.asarray(jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(0), runs)))


@pytest.mark.parametrize(
    "backend",
    ["numpy", *(pytest.param(name, marks=pytest.mark.slow) for name in ("compiled", "jax"))],
)
@pytest.mark.parametrize(("period", "gain"), [(3, "lqr"), (7, "lqr"), (1, [[0.7]])])
def test_costs_of_periodic_transmission_are_the_recursion(
    period: int, gain: Any, backend: str
) -> None:
    options = SCALAR | FREE | {"gain": gain}
    own = regulator(SCALAR) if gain == "lqr" else np.array(gain)
    expected = periodic_cost(SCALAR, own, period)
    if backend == "jax":
        costs = jax_costs(options, period, 4000)
    else:
        task = fusion_gym.make_task(LINEAR, backend=backend, **options)
        policy = fusion_gym.make_policy(f"periodic:period={period}", task)
        costs = run_episodes(task, policy, 4000, seed=0).control_cost
    error = costs.std() / np.sqrt(len(costs))
    assert error < 0.02 * expected
    assert abs(costs.mean() - expected) < 3.5 * error


class Regulated(linear_case.Linear):
    """The linear case with an input."""

    gain = np.array([[0.3, 0.4]])

    def __init__(self) -> None:
        super().__init__()
        self.inputs = 1
        self.initial_mean = np.zeros(2)

    def control(self, mean: np.ndarray) -> np.ndarray:
        return -self.gain @ mean

    def cost(self, state: np.ndarray, control: np.ndarray) -> np.ndarray:
        return (state**2).sum(0) + 0.3 * control[0] ** 2

    def move(self, state: Any, noise: Any, control: Any) -> Any:  # type: ignore[override]
        return super().move(state, noise) + B @ control

    def predict(self, mean: Any, covariance: Any, control: Any) -> Any:  # type: ignore[override]
        moved, spread = super().predict(mean, covariance)
        return moved + B @ control, spread


def build_regulated(options: CommonOptions) -> Scenario:
    system = Regulated()
    return Scenario(options, system.plant, system.estimator, controller=system.controller)


@pytest.fixture(autouse=True)
def systems(registries: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Environments of one's own; the example registers its own when it is imported."""
    monkeypatch.delitem(sys.modules, "examples.inverted_pendulum", raising=False)
    for build in (build_regulated, without_controller, with_a_plant_without_input):
        monkeypatch.setitem(ENVIRONMENTS, f"own/{build.__name__}-v0", build)


def own_task(build: Callable[..., Scenario], **options: Any) -> Task:
    return fusion_gym.make_task(f"own/{build.__name__}-v0", **FREE | {"horizon": 60} | options)


def test_a_system_of_your_own_has_the_cost_of_the_recursion() -> None:
    task = own_task(build_regulated)
    options = {
        "transition": linear_case.A,
        "input_matrix": B,
        "process_covariance": linear_case.W,
        "measurement_matrices": linear_case.C,
        "measurement_covariances": linear_case.DEVIATION**2,
        "initial_covariance": linear_case.START,
        "control_weights": (np.eye(2), 0.3),
        "horizon": 60,
    }
    policy = fusion_gym.make_policy("periodic:period=4,staggered=false", task)
    costs = run_episodes(task, policy, 4000, seed=0).control_cost
    assert costs is not None
    error = costs.std() / np.sqrt(len(costs))
    assert abs(costs.mean() - periodic_cost(options, Regulated.gain, 4)) < 3.5 * error


# --- a law of every linear family ---------------------------------------------------------------

TOBIT, CORRELATED = "fusion_gym/TobitOscillator-v1", "fusion_gym/CorrelatedTracking-v1"
REMOTE, INPUT = "fusion_gym/RemoteEstimation-v1", {"input_matrix": B}
LOSSES: Options = {"channel": "independent", "drop_probability": 0.3}
FAMILIES: dict[str, tuple[str, Options]] = {
    "linear": (LINEAR, INPUT),
    "memory": (LINEAR, INPUT | {"memory": True}),
    "estimates": (LINEAR, INPUT | {"memory": True, "packet": "estimate"}),
    "told": (LINEAR, INPUT | {"memory": True, "broadcast": "estimate"}),
    "intersection": (LINEAR, INPUT | {"fusion": "ci"}),
    "joint": (LINEAR, INPUT | {"filter": "joint", "memory": True}),
    "late": (LINEAR, INPUT | LOSSES | {"delay": (0, 2)}),
    "wrong": (LINEAR, INPUT | {"gain": [[0.2, 0.8]], "true_process_noise": 2.0}),
    "tobit": (
        TOBIT, INPUT | {"filter": "tobit", "censoring_threshold": -np.inf, "memory": True},
    ),
    "oscillator": (TOBIT, INPUT | {"censoring_threshold": -np.inf, "silent": "predict"}),
    "correlated": (CORRELATED, {"input_matrix": [[0.0], [0.01], [1.0]], "memory": True}),
    "sources": (REMOTE, {"sensors": 2, "input_matrix": np.eye(2), "memory": True} | LOSSES),
    "vectors": (REMOTE, {"sources": (2, 0), "input_matrix": np.ones((4, 1))}),
}  # fmt: skip


def build(name: str, **options: Any) -> Task:
    env_id, own = FAMILIES[name]
    return fusion_gym.make_task(env_id, **FREE | own | options)


@pytest.mark.parametrize("name", FAMILIES)
def test_an_input_changes_no_estimation_error(name: str) -> None:
    """Of requests that read no measurements; nor what the scheduler's memory knows better."""
    open_loop = {"input_matrix": None} | ({"gain": "lqr"} if name == "wrong" else {})
    weights = {"state_weights": np.ones(len(build(name).plant.state_names))}
    batches = [
        EpisodeBatch.seeded(build(name, **weights, **other), 4, 3) for other in ({}, open_loop)
    ]
    generator, moved = np.random.default_rng(0), 0.0
    for _ in range(25):
        requests = generator.random((batches[0].task.sensors, 4)) < 0.5
        outcomes = [batch.step(requests) for batch in batches]
        size = 1.0 + max(float(abs(batch.task.plant.truth(batch.state.plant)).max())
                         for batch in batches)  # fmt: skip
        np.testing.assert_allclose(
            outcomes[0].error, outcomes[1].error, rtol=0.0, atol=1e-13 * size
        )
        if batches[0].task.options.memory:
            differences = [batch.beliefs().difference for batch in batches]
            np.testing.assert_allclose(*differences, rtol=0.0, atol=1e-13 * size)
        truths = [batch.task.plant.truth(batch.state.plant) for batch in batches]
        moved = max(moved, float(abs(truths[0] - truths[1]).max()))
        assert outcomes[1].control_cost is None
    assert moved > 1e-3


def transition_of(plant: Any) -> np.ndarray:
    if hasattr(plant, "coefficient"):
        return np.diag(plant.coefficient)
    if hasattr(plant, "whole"):
        return np.asarray(plant.whole(plant.transition)[..., 0])
    return np.asarray(getattr(plant, "dynamics", plant).transition[..., 0])


@pytest.mark.parametrize("name", [name for name in FAMILIES if name != "wrong"])
def test_the_cost_is_that_of_weighted_errors_for_every_policy(name: str) -> None:
    """xᵀPx falls by the step's cost and rises by tr(PW) + eᵀMe, whatever is sent: here by a rule
    that reads measurements, where P solves the Riccati equation."""
    task = build(name, horizon=30, objective="control")
    controller: Any = task.controller
    truth = task.plant.truth
    gain, q, r = (
        part[..., 0] for part in (controller.gain, controller.state_cost, controller.input_cost)
    )
    inputs = np.atleast_2d(FAMILIES[name][1]["input_matrix"])
    runs = 4000
    batch = EpisodeBatch.seeded(task, runs, 3)
    policy = fusion_gym.make_policy("send_on_delta:threshold=0.5", task)
    policy.reset(runs)
    a = transition_of(task.plant)
    p = solve_discrete_are(a, inputs, q, r)
    np.testing.assert_allclose(np.linalg.solve(r + inputs.T @ p @ inputs, inputs.T @ p @ a), gain)
    total = -np.einsum("in,ij,jn->n", truth(batch.state.plant), p, truth(batch.state.plant))
    for _ in range(29):
        before = truth(batch.state.plant).copy()
        outcome = batch.step(policy(batch.signals()))
        after = truth(batch.state.plant)
        noise = after - a @ before - inputs @ outcome.control
        weighted = np.einsum("in,ij,jn->n", outcome.error, controller.error_weights, outcome.error)
        total += outcome.control_cost - weighted - np.einsum("in,ij,jn->n", noise, p, noise)
        np.testing.assert_allclose(outcome.control, -gain @ (before - outcome.error), atol=1e-9)
    total += np.einsum("in,ij,jn->n", after, p, after)
    assert abs(total.mean()) < 4.0 * total.std() / np.sqrt(runs)
    assert total.std() > 0.0


# --- batches, branches, late packets ------------------------------------------------------------


def test_equal_seeds_with_other_policies_share_a_batch() -> None:
    """Measurements depend on the policy, so no memory is shared."""
    task = build("memory", horizon=40, token_rate=1.0, tokens="limited")
    policies = [
        fusion_gym.make_policy(f"value_of_information:threshold={threshold}", task)
        for threshold in (0.02, 0.2)
    ]
    alone = [run_episodes(task, policy, 20, seed=0) for policy in policies]
    for together, expected in zip(run_several(task, policies, 20, seed=0), alone, strict=True):
        for field in dataclasses.fields(expected):
            name = field.name
            np.testing.assert_allclose(
                getattr(together, name), getattr(expected, name), rtol=1e-12, err_msg=name
            )
    assert abs(alone[0].control_cost - alone[1].control_cost).min() > 0.0


def test_a_late_packet_moves_inputs_from_its_arrival_on() -> None:
    """Against one pass over the packets that had arrived, with the inputs of that time."""
    task = build("late", horizon=20)
    batch, rng, gain = EpisodeBatch.seeded(task, 5, 3), np.random.default_rng(0), task.controller
    start = np.stack(
        [batch.source.start(3 + run, 0, task.plant.start_channels) for run in range(5)]
    )
    first, announcement = task.plant.start(start.T.copy())
    measured, arrival, inputs, late = [], [], [batch.state.control], 0
    for now in range(15):
        measured.append(task.plant.measurement(batch.state.plant))
        draws = batch.state.network.draws
        outcome = batch.step(rng.random((2, 5)) < 0.6)
        arrival.append(np.where(outcome.granted & ~draws.lost, now + draws.delay, np.inf))
        estimate = task.estimator.start(task.plant.measurement(first), announcement)
        for place, measurement in enumerate(measured):
            estimate = task.estimator.predict(estimate, inputs[place])
            estimate = task.estimator.observe(estimate, measurement)
            estimate = task.estimator.update(estimate, Reception(arrival[place] <= now))
        late += int((np.isfinite(arrival[-1]) & (arrival[-1] > now)).sum())
        np.testing.assert_allclose(outcome.control, gain.act(task.estimator.mean(estimate)))
        inputs.append(outcome.control)
    assert late > 10


# --- costs and ends -----------------------------------------------------------------------------


def test_rewards_are_of_the_objective() -> None:
    options = (
        INPUT
        | FREE
        | {"error_weight": 3.0, "reward_scale": 2.0, "control_weights": (3.0 * np.eye(2), [[2.0]])}
    )
    outcomes = []
    for objective in ("control", "estimation"):
        task = fusion_gym.make_task(LINEAR, objective=objective, **options)
        batch = EpisodeBatch.seeded(task, 3, 0)
        states = task.plant.truth(batch.state.plant).copy()
        outcomes.append(outcome := batch.step(np.ones((2, 3), bool)))
        cost = 3.0 * (states**2).sum(0) + 2.0 * outcome.control[0] ** 2
        np.testing.assert_allclose(outcome.control_cost, cost)
        weights = task.controller.error_weights
        if objective == "estimation":
            cost = np.einsum("in,ij,jn->n", outcome.error, weights, outcome.error)
        np.testing.assert_allclose(outcome.reward_error, -6.0 * cost)
    assert (outcomes[0].reward_error < outcomes[1].reward_error).all()


def test_the_scale_of_a_loop_makes_an_even_pace_cost_one() -> None:
    task = fusion_gym.make_task(LINEAR, **INPUT)
    pace = fusion_gym.make_policy("periodic:period=12", task)  # a packet costs three tokens
    results = run_episodes(task, pace, 400, seed=0)
    assert results.error_cost.mean() == pytest.approx(1.0, rel=0.1)


def test_observations_scale_by_the_closed_loop() -> None:
    """Of a plant that grows without its input: by a factor of 300 in an episode."""
    task = fusion_gym.make_task(LINEAR, **SCALAR | FREE)
    batch, entries = EpisodeBatch.seeded(task, 50, 0), []
    place = list(batch.layout.names).index("estimate[x1]")
    for _ in range(50):
        batch.step(np.ones((1, 50), bool))
        entries.append(batch.observe()[:, place])
    assert 0.3 < np.std(entries) < 2.0


def test_the_last_state_is_charged_with_the_terminal_weight() -> None:
    weight = [[2.0, 1.0], [1.0, 3.0]]
    costs = []
    for options in ({}, {"terminal_weight": weight, "clock": True}):
        task = build("linear", horizon=4, reward_scale=1.0, **options)
        batch, each = EpisodeBatch.seeded(task, 3, 0), []
        for _ in range(4):
            last = task.plant.truth(batch.state.plant).copy()
            each.append(batch.step(np.ones((2, 3), bool)).control_cost)
        costs.append(np.array(each))
    expected = np.einsum("in,ij,jn->n", last, weight, last)
    np.testing.assert_allclose(costs[1] - costs[0], [*np.zeros((3, 3)), expected], atol=1e-12)


def fallen(horizon: int = 60, **options: Any) -> tuple[Task, np.ndarray, int]:
    """A pendulum that falls without packets: its costs without the charge of the end, and when."""
    task = fusion_gym.make_task(PENDULUM, horizon=horizon, reward_scale=None, **options)
    batch, costs = EpisodeBatch.seeded(task, 1, 5), []
    controller: Any = task.controller
    for _ in range(horizon):
        state = batch.state.plant
        outcome = batch.step(np.zeros((2, 1), bool))
        costs.append(controller.cost(state, outcome.control)[0])
        if outcome.ended[0]:
            break
    assert outcome.terminated[0]
    assert len(costs) < horizon
    return task, np.array(costs), horizon


def test_an_end_charges_the_forfeited_steps() -> None:
    task, costs, horizon = fallen()
    end = costs[-1] * (horizon - len(costs) + 1)
    results = run_episodes(task, fusion_gym.make_policy("never", task), 1, seed=5)
    assert results.control_cost is not None
    assert results.control_cost[0] * horizon == pytest.approx(costs[:-1].sum() + end)
    assert -results.returns[0] == pytest.approx(costs[:-1].sum() + end)
    film = record_episode(task, fusion_gym.make_policy("never", task), 5)
    assert film.control is not None
    assert (film.truth[len(costs) :] == film.truth[len(costs) - 1]).all()
    assert (film.control[len(costs) - 1 :] == 0.0).all()
    assert results.mse[0] * horizon == pytest.approx(
        ((film.truth - film.mean)[: len(costs)] ** 2).sum()
    )


def test_every_interface_says_that_a_fall_terminates() -> None:
    _, costs, horizon = fallen()
    options: Options = {"horizon": horizon, "reward_scale": None}
    steps = len(costs)
    env = gymnasium.make(PENDULUM, **options)
    env.reset(seed=5)
    results = [env.step(np.zeros(2, int)) for _ in range(steps)]
    assert [result[2:4] for result in results] == [(False, False)] * (steps - 1) + [(True, False)]
    assert results[-1][-1]["control_cost"] == pytest.approx(costs[-1] * (horizon - steps + 1))
    assert results[0][-1]["control"].shape == (1,)
    envs = gymnasium.make_vec(PENDULUM, 1, vectorization_mode="vector_entry_point", **options)
    envs.reset(seed=5)
    several = [envs.step(np.zeros((1, 2), int)) for _ in range(steps)]
    assert [float(result[1][0]) for result in several] == [float(item[1]) for item in results]
    assert (several[-1][2], several[-1][3]) == ([True], [False])
    agents = fusion_gym.parallel_env(PENDULUM, **options)
    agents.reset(seed=5)
    for _ in range(steps):
        *_, terminated, truncated, _ = agents.step(dict.fromkeys(agents.agents, 0))
    assert set(terminated.values()) == {True}
    assert set(truncated.values()) == {False}
    learner = fusion_gym.make_sb3_vec_env(PENDULUM, 1, seed=5, **options)
    learner.reset()
    for _ in range(steps):
        *_, dones, infos = learner.step(np.zeros((1, 2), int))
    assert dones[0]
    assert infos[0]["TimeLimit.truncated"] is False


def test_training_sees_the_cost_of_the_loop() -> None:
    """Of a system of one's own, which has no error weights."""
    task = own_task(build_regulated)
    envs = PrivilegedVecEnv(task, 3)
    envs.seed(0)
    envs.reset()
    _, rewards, *_ = envs.step(np.ones((3, 2), int))
    batch = EpisodeBatch.seeded(task, 3, 0)
    expected = batch.step(np.ones((2, 3), bool))
    np.testing.assert_allclose(rewards, expected.reward, rtol=1e-6)
    cost = task.reward.control_scale * expected.control_cost
    np.testing.assert_allclose(expected.reward_error, -cost)
    refused(
        lambda: PrivilegedVecEnv(task, 3, error="mismatch", reference=task.estimator),
        "error = 'mismatch'", "cost of the loop",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("options", "exchanged"),
    [({}, True), ({"state_weights": [1.0, 1.0]}, False), ({"true_transition": 0.9}, False)],
)
def test_an_agent_learns_from_errors_only_where_they_rank_as_the_cost(
    options: Options, exchanged: bool
) -> None:
    """By the controller's own weights, in the model of its regulator."""
    task = build("linear", horizon=20, **options)
    envs = PrivilegedVecEnv(task, 3)
    envs.seed(0)
    envs.reset()
    _, rewards, *_ = envs.step(np.ones((3, 2), int))
    outcome = EpisodeBatch.seeded(task, 3, 0).step(np.ones((2, 3), bool))
    reward = outcome.reward
    if exchanged:
        controller: Any = task.controller
        scaled = task.reward.control_scale * controller.error_weights
        error = np.einsum("in,ij,jn->n", outcome.error, scaled, outcome.error)
        reward = outcome.reward_communication - error
    np.testing.assert_allclose(rewards, reward, rtol=1e-6)


def test_a_new_episode_empties_the_strip_of_the_input() -> None:
    env: Any = gymnasium.make(LINEAR, render_mode="rgb_array", **INPUT)
    env.reset(seed=0)
    empty = env.render()
    for _ in range(3):
        env.step(np.ones(2, int))
    assert (env.render() != empty).any()
    env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), empty)


# --- refusals -----------------------------------------------------------------------------------


class Uncontrolled(linear_case.Linear):
    """It has inputs and no method for them."""

    def __init__(self) -> None:
        super().__init__()
        self.inputs = 1


class Constant(Controller):
    """An input of zero."""

    def act(self, mean: np.ndarray) -> np.ndarray:
        return 0.0 * mean[:1]

    def cost(self, state: Any, control: np.ndarray) -> np.ndarray:
        return (state.truth**2).sum(0)


def without_controller(options: CommonOptions) -> Scenario:
    system = Regulated()
    return Scenario(options, system.plant, system.estimator)


def with_a_plant_without_input(options: CommonOptions) -> Scenario:
    task = fusion_gym.make_task("fusion_gym/MarkovJumpTracking-v1")
    return Scenario(options, task.plant, task.estimator, controller=Constant())


REFUSALS: dict[str, tuple[Callable[[], Any], tuple[str, ...]]] = {
    "hold": (lambda: build("linear", filter="hold"), ("input_matrix", "filter='hold'")),
    "memory of held values": (
        lambda: build("memory", memory_filter="hold"), ("input_matrix", "memory_filter='hold'"),
    ),
    "a schedule": (
        lambda: build("linear", schedule={"transition": np.stack([0.9 * np.eye(2), np.eye(2)])}),
        ("schedule", "input_matrix"),
    ),
    "acknowledgements": (
        lambda: build("sources", acknowledgements=0.5), ("acknowledgements", "the input"),
    ),
    "no input matrix": (
        lambda: build("linear", input_matrix=None, gain=[[1.0, 0.0]]), ("gain", "input_matrix"),
    ),
    "a gain of another shape": (lambda: build("linear", gain=[[1.0]]), ("gain", "(1, 2)")),
    "another word": (lambda: build("linear", gain="pid"), ("gain = 'pid'", "'lqr'")),
    "a gain that diverges": (lambda: build("linear", gain=[[-90.0, 0.0]]), ("gain", "radius")),
    "what no input reaches": (
        lambda: build("linear", input_matrix=[[0.0], [0.0]]), ("input_matrix", "lqr"),
    ),
    "a free input": (
        lambda: build("linear", control_weights=(np.eye(2), 0.0)), ("control_weights[1]",),
    ),
    "one weight": (lambda: build("linear", control_weights=(np.eye(2),)), ("control_weights",)),
    "an objective without a controller": (
        lambda: fusion_gym.make_task(LINEAR, objective="control"), ("objective", "controller"),
    ),
    "another error": (lambda: build("linear", error="trace"), ("error = 'trace'", "objective")),
    "an end that nobody sees": (
        lambda: build("linear", terminal_weight=np.eye(2)), ("terminal_weight", "clock=True"),
    ),
    "a system without its controller": (
        lambda: run_episodes(
            task := own_task(without_controller),
            fusion_gym.make_policy("always", task), 1, 0,
        ),
        ("inputs = 1", "controller"),
    ),
    "a system without its methods": (
        lambda: Uncontrolled().controller, ("inputs = 1", "'control'"),
    ),
    "a plant without an input": (
        lambda: own_task(with_a_plant_without_input), ("controller", "'control'"),
    ),
    "a bound of estimation": (
        lambda: cost_bound(build("linear", state_weights=[1.0, 1.0]), 1.0),
        ("controller", "solves estimation"),
    ),
    "an optimum of estimation": (
        lambda: fusion_gym.make_policy(
            "optimal", build("sources", sensors=1, input_matrix=[[1.0]])
        ),
        ("controller", "solves estimation"),
    ),
    "a recording": (
        lambda: fusion_gym.make_task(
            "fusion_gym/RecordedFusion-v1", input_matrix=[[0.0], [1.0]]
        ),
        ("input_matrix",),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSALS)
def test_what_a_loop_does_not_allow_is_refused(name: str) -> None:
    use, parts = REFUSALS[name]
    refused(use, *parts)
