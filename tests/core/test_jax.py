"""Environments as pure functions of JAX: NumPy's results on the same noise, and autoresets."""

import copy
import multiprocessing
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from test_namespace import MORE_TASKS, TASKS

import fusion_gym
import fusion_gym.jax
from fusion_gym.arrays import arrays_of
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.noise import PhiloxNoise
from fusion_gym.evaluation import run_episodes
from fusion_gym.jax import FiveValueEnv, FunctionalEnv
from fusion_gym.validation import ConfigurationError

HORIZON, EPISODES = 30, 3
TOBIT, LINEAR = "fusion_gym/TobitOscillator-v1", "fusion_gym/LinearFusion-v2"
SMALL = "fusion_gym/RemoteEstimation-v1"  # compiles soonest
RULES = (
    "innovation_threshold:threshold=1.1",
    "innovation_threshold:threshold=1.1,whitened=true,at_most=1",
    "send_on_delta:threshold=0.9",
    "report_on_change:reportable_change=20,percent=true",
    "information_gain:threshold=0.03,at_most=none",
    "information_gain:threshold=0.01",
)


def slowly(tasks: Iterable[tuple[Any, ...]], *quick: str) -> list[Any]:
    """Cases that are slow, but for those with one of the words."""
    slow = pytest.mark.slow
    return [pytest.param(*t, marks=() if any(w in t for w in quick) else slow) for t in tasks]


@pytest.mark.parametrize(
    ("name", "options"), slowly(dict(TASKS).items(), "LinearFusion-v2", "RemoteEstimation-v1")
)
def test_episodes_equal_numpy(name: str, options: dict[str, Any]) -> None:
    task = fusion_gym.make_task(f"fusion_gym/{name}", **options | {"horizon": HORIZON})
    env, parts = FunctionalEnv(task), (task.plant, task.network)
    sources = [PhiloxNoise(), PhiloxNoise(stream=1)]
    space = env.action_space()
    space.seed(0)
    reset, step = jax.jit(env.reset_env), jax.jit(env.step_env)
    rules = [fusion_gym.make_policy(text, task) for text in RULES]
    decide = jax.jit(lambda state: [rule(env.signals(state)) for rule in rules])
    batch = EpisodeBatch(task, 1)
    batch.seed(np.arange(1), [7])
    for episode in range(EPISODES):
        batch.reset()
        starts, steps = [], []
        for source, part in zip(sources, parts, strict=True):
            starts.append(source.start(7, episode, part.start_channels))
            steps.append(source.steps(7, episode, 0, HORIZON + 1, part.noise_channels))
        start, noise = np.hstack(starts)[:, None], np.hstack(steps)[..., None]
        uniform = np.array([sources[0].uniform(7, episode)])
        observation, state = reset(start, noise[0], uniform)
        for place in range(HORIZON):
            np.testing.assert_allclose(observation, batch.observe()[0], rtol=1e-6, atol=1e-6)
            for rule, requests in zip(rules, decide(state), strict=True):
                np.testing.assert_array_equal(requests, rule(batch.signals()))
            action = space.sample()
            outcome = batch.step(np.asarray(env.requests(action)))
            observation, state, result = step(noise[place + 1], state, action)
            for ours, theirs in zip(arrays_of(result), arrays_of(outcome), strict=True):
                np.testing.assert_allclose(
                    np.asarray(ours, np.float64), theirs, rtol=1e-9, atol=1e-9
                )
        assert bool(result.ended[0])


@pytest.mark.parametrize(
    ("name", "options"),
    [
        *TASKS[:-3],
        *slowly((*TASKS[-3:], *MORE_TASKS)),
        (
            "LinearFusion-v2",
            {"memory": True, "cost_weight": "random", "price_range": (0.1, 1.0)},
        ),
    ],
)
def test_compiled_code_equals_numpy_and_itself_in_any_batch(
    name: str, options: dict[str, Any]
) -> None:
    close = 1e-11
    options = {"horizon": HORIZON, "vectorization_mode": "vector_entry_point"} | options
    envs = [
        gymnasium.make_vec(f"fusion_gym/{name}", runs, backend=backend, **options)
        for runs, backend in ((3, "numpy"), (3, "compiled"), (1, "compiled"))
    ]
    envs[0].action_space.seed(0)
    results: list[Any] = [
        (env.reset(seed=seed)[0],) for env, seed in zip(envs, (7, 7, 8), strict=True)
    ]
    for step in range(200):
        numpy, compiled, single = ([*jax.tree.leaves(result)] for result in results)
        for a, b, c in zip(numpy, compiled, single, strict=True):
            same = 1e-6 if a.dtype == np.float32 else close
            np.testing.assert_allclose(b, a, rtol=same, atol=same)
            np.testing.assert_array_equal(c, b[1:2])
        actions = envs[0].action_space.sample()
        results = [
            env.step(part) for env, part in zip(envs, (actions, actions, actions[1:2]), strict=True)
        ]
        if step % 40 == 0:  # what is computed on demand
            batches = [env.unwrapped.batch for env in envs[:2]]
            states = [(batch.state, batch.delivered, batch.price, batch.steps) for batch in batches]
            for a, b in zip(*map(arrays_of, states), strict=True):
                np.testing.assert_allclose(
                    np.asarray(b, np.float64), np.asarray(a, np.float64), rtol=close, atol=close
                )


def test_interfaces_of_learners_and_rules_run_in_compiled_code() -> None:
    options: dict[str, Any] = {"filter": "tobit", "horizon": HORIZON}
    sums = []
    for backend in ("numpy", "compiled"):
        task = fusion_gym.make_task(TOBIT, backend=backend, **options)
        rule = fusion_gym.make_policy("value_of_information", task)
        total = [run_episodes(task, rule, 3, seed=0).returns]
        envs = fusion_gym.make_sb3_vec_env(
            TOBIT, 3, seed=0, training_error="mismatch", stagger=True, backend=backend, **options
        )
        envs.reset()
        total += [envs.step(np.ones((3, 3)))[1] for _ in range(2 * HORIZON)]
        agents = fusion_gym.parallel_env(TOBIT, backend=backend, **options)
        agents.reset(seed=0)
        total.append(agents.step(dict.fromkeys(agents.agents, 1))[1]["sensor_0"])
        sums.append(np.hstack(total))
    np.testing.assert_allclose(*sums, rtol=1e-9)


def test_runs_together_are_the_runs_alone() -> None:
    env, params = fusion_gym.jax.make(SMALL, sensors=2, horizon=4)
    reset, step_alone = jax.jit(env.reset), jax.jit(env.step)
    step_together = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))
    keys = jax.random.split(jax.random.key(0), 3)
    alone = [reset(key, params) for key in keys]
    observation, together = jax.jit(jax.vmap(env.reset, (0, None)))(keys, params)
    for step in range(6):
        for run, (seen, state) in enumerate(alone):
            own = jax.tree.map(lambda x, run=run: x[run], (observation, together))
            jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), (seen, state), own)
        if step == 2:  # another episode's end
            alone[1] = alone[1][0], alone[1][1]._replace(limit=np.array([3]))
            together = together._replace(limit=np.array([[4], [3], [4]]))
        action = np.arange(6).reshape(3, 2) % 2
        alone = [
            step_alone(k, s, a, params)[:2]
            for k, (_, s), a in zip(keys, alone, action, strict=True)
        ]
        observation, together, *_ = step_together(keys, together, action, params)


def test_an_episode_that_ends_is_reset() -> None:
    env, params = fusion_gym.jax.make(SMALL, horizon=3)
    key, step = jax.random.key(0), jax.jit(env.step)
    _, state = jax.jit(env.reset)(key, params)
    for number in range(1, 7):
        key, own = jax.random.split(key)
        observation, state, _, terminated, truncated, info = step(own, state, ACTION, params)
        assert (bool(terminated), bool(truncated)) == (False, number % 3 == 0)
        assert int(state.steps[0]) == number % 3
        same = np.array_equal(observation, info["final_observation"])
        assert same == (number % 3 != 0)
    env, params = fusion_gym.jax.make(SMALL, horizon=1, clock=True)
    *_, terminated, truncated, _ = jax.jit(env.step)(
        key, jax.jit(env.reset)(key, params)[1], ACTION, params
    )
    assert bool(terminated)
    assert not bool(truncated)


@pytest.mark.parametrize(
    ("name", "options"), slowly(dict(TASKS).items(), "LinearFusion-v2", "RemoteEstimation-v1")
)
def test_programs_do_not_grow_with_the_number_of_runs(name: str, options: dict[str, Any]) -> None:
    env, params = fusion_gym.jax.make(f"fusion_gym/{name}", **options)
    action = np.zeros(env.action_space().shape, np.int64)

    def lengths(runs: int) -> np.ndarray[Any, Any]:
        keys = jax.random.split(jax.random.key(0), runs)
        reset = jax.jit(jax.vmap(lambda key: env.reset(key, params)[1]))
        step = jax.jit(jax.vmap(lambda key, state: env.step(key, state, action, params)))
        states = jax.eval_shape(reset, keys)
        programs = reset.lower(keys), step.lower(keys, states)
        return np.array([len(program.as_text()) for program in programs])

    runs = 16_384
    arrays = 4 * 16 * runs  # hexadecimal digits of four numbers per run
    assert (lengths(runs) < 1.2 * lengths(64) + arrays).all()


def test_an_action_of_another_shape_is_refused() -> None:
    for options, action in (({}, [1, 0, 1]), ({"access": "single"}, [1, 0])):
        env, params = fusion_gym.jax.make("fusion_gym/LinearFusion-v2", **options)
        _, state = env.reset(jax.random.key(0), params)
        with pytest.raises(ValueError, match=r"^action of shape .* is not allowed"):
            env.step(jax.random.key(1), state, np.array(action), params)


@pytest.mark.slow
def test_parameters_may_be_mapped() -> None:
    env, params = fusion_gym.jax.make(LINEAR)
    key, request, reset = jax.random.key(0), np.array([1, 0]), jax.jit(env.reset)

    @jax.jit
    def reward(variance: Any) -> Any:
        changed = params._replace(measurement_variance=variance)
        _, state = env.reset(key, changed)
        return env.step(key, state, np.ones(2), changed)[2]

    variances = np.stack([factor * params.measurement_variance for factor in (0.5, 1.0, 2.0)])
    together = jax.jit(jax.vmap(reward))(variances)
    np.testing.assert_allclose(together, [reward(v) for v in variances], rtol=1e-12)
    assert len(set(together.tolist())) == 3
    rule = fusion_gym.make_policy("innovation_threshold", env.task)
    state, thresholds = reset(key, params)[1], np.linspace(0.0, 2.0, 9)
    decide = jax.jit(lambda x: replace(rule, threshold=x)(env.signals(state)))
    requests = jax.jit(jax.vmap(decide))(thresholds)
    each = [decide(x) for x in thresholds.tolist()]
    np.testing.assert_array_equal(requests, each)
    noise = np.ones((env.task.plant.noise_channels, 1))
    certain = jax.jit(env.expected_step)(noise, state, 1.0 * request, params)
    _, *step = jax.jit(env.step_env)(noise, state, request, params)
    for ours, theirs in zip(jax.tree.leaves(certain), jax.tree.leaves(step), strict=True):
        if ours.dtype == np.float64:
            np.testing.assert_allclose(ours, theirs, rtol=1e-12)
    dear = params._replace(price=100.0)
    _, state = reset(key, dear)
    info = jax.jit(env.step)(key, state, np.ones(2), dear)[-1]
    assert float(info["reward_cost"]) == -100.0 * float(info["cost"]) < 0.0


TRUNCATED = {"filter": "truncated", "trigger": "report_on_change", "trigger_threshold": 0.8}
UNREPORTED = {"channel": "independent", "acknowledgements": "none"}


@pytest.mark.parametrize(
    ("name", "options", "field"),
    [
        ("TobitOscillator-v1", {"memory": True}, "memory"),
        ("TobitOscillator-v1", {"belief_features": ["value"]}, "belief_features"),
        ("LinearFusion-v2", {"filter": "hold"}, "filter"),
        ("LinearFusion-v2", {"true_process_noise": 2.0}, "true_process_noise"),
        ("LinearFusion-v2", {"error": "numpy:trace"}, "error"),
        ("LinearFusion-v2", {"delay": 1}, "delay"),
        ("LinearFusion-v2", TRUNCATED, "filter"),
        ("RemoteEstimation-v1", UNREPORTED, "acknowledgements"),
        ("RecordedFusion-v1", {}, "plant"),
    ],
)
def test_what_jax_does_not_run_is_refused(name: str, options: dict[str, Any], field: str) -> None:
    options = {"error": lambda error, _: (error**2).sum(0)} if field == "error" else options
    where = "in pure functions" if field in ("memory", "belief_features") else "under JAX"
    with pytest.raises(ConfigurationError, match=rf"^{field} = .* is not allowed {where}"):
        fusion_gym.jax.make(f"fusion_gym/{name}", **options)


ACTION = np.array([1])
MAKERS: dict[str, Callable[..., Any]] = {
    "single": gymnasium.make,
    "vector": partial(gymnasium.make_vec, num_envs=2, vectorization_mode="vector_entry_point"),
    "sb3": partial(fusion_gym.make_sb3_vec_env, num_envs=2),
}


def test_resets_and_steps_draw_from_independent_keys() -> None:
    """A reset takes its noise and its price, a step its noise and its reset, from a key each."""
    env, params = fusion_gym.jax.make(
        SMALL, horizon=1, initial_deviation=1.0, cost_weight="random", price_range=(1.0, 9.0)
    )
    plant, keys = env.task.plant, jax.random.split(jax.random.key(0))
    start, channels = plant.start_channels, plant.noise_channels
    normals = jax.random.normal(keys[0], (start + channels, 1))
    uniform = jax.random.uniform(keys[1], (1,))
    first = env.reset(jax.random.key(0), params)
    expected = jax.jit(env.reset_env)(normals[:start], normals[start:], uniform, params)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-6), first, expected)
    _, renewed, reward, *_, info = env.step(jax.random.key(0), first[1], ACTION, params)
    noise = jax.random.normal(keys[0], (channels, 1))
    observation, _, outcome = jax.jit(env.step_env)(noise, first[1], ACTION, params)
    np.testing.assert_allclose(reward, outcome.reward[0], rtol=1e-12)
    np.testing.assert_allclose(info["final_observation"], observation, rtol=1e-6)
    again = env.reset(keys[1], params)[1]
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-12), renewed, again)


@pytest.mark.parametrize(
    "options", [{"action": "discrete"}, {"action": "multidiscrete"}, {"access": "single"}, {}]
)
def test_requests_are_those_of_the_usual_interfaces(options: dict[str, Any]) -> None:
    env = fusion_gym.jax.make(SMALL, sensors=3, **options)[0]
    bits = [[0, 0, 1], [1, 0, 0], [1, 1, 0]]
    actions = bits if env.action_space().shape else range(env.num_actions)
    for action in actions:
        np.testing.assert_array_equal(env.requests(action), env._view.action.requests(action, None))


def test_the_earlier_interface_is_done_at_a_termination() -> None:
    env = FiveValueEnv(fusion_gym.make_task(SMALL, horizon=1, clock=True))
    key = jax.random.key(0)
    *_, done, info = env.step(key, env.reset(key)[1], ACTION)
    assert (done, info["terminated"], info["truncated"]) == (True, True, False)


def test_the_filter_of_silence_takes_parameters() -> None:
    env, params = fusion_gym.jax.make(TOBIT, filter="stochastic", stochastic_weight=1.0)
    jax.eval_shape(env.reset, jax.random.key(0), params)


@pytest.mark.parametrize("kind", MAKERS)
def test_copies_continue_as_the_original(kind: str) -> None:
    """After a reset, and after steps; the last observation stays that of the backend."""
    drawn: Any = {"cost_weight": "random", "price_range": (1.0, 9.0)}
    env = MAKERS[kind](SMALL, sensors=2, backend="compiled", horizon=4, **drawn)
    actions = np.array([1, 0] if kind == "single" else [[1, 0], [1, 1]])
    pickle.loads(pickle.dumps(env)).reset()
    env.reset()
    for _ in range(2):
        twins = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
        batches = [getattr(e, "unwrapped", e).batch for e in (env, *twins)]
        assert len({batch.observe().tobytes() for batch in batches}) == 1
        expected, *others = [[e.step(actions)[:3] for _ in range(2)] for e in (env, *twins)]
        for other in others:
            jax.tree.map(np.testing.assert_array_equal, other, expected)


def test_functional_environments_are_copied() -> None:
    env, params = fusion_gym.jax.make(SMALL)
    key = jax.random.key(0)
    state = env.reset(key, params)[1]
    expected = env.step(key, state, ACTION, params)
    for other, start in (copy.deepcopy((env, state)), pickle.loads(pickle.dumps((env, state)))):
        result = other.step(key, start, ACTION, params)
        jax.tree.map(np.testing.assert_array_equal, result, expected)


@pytest.mark.slow
def test_programs_at_the_default_level_of_xla_equal_numpy() -> None:
    """The other tests compile without XLA's optimization."""
    chosen = "episodes_equal_numpy and (LinearFusion or UnknownInput)"
    words = [sys.executable, "-m", "pytest", "-q", __file__, "-k", chosen]
    subprocess.run(words, env=os.environ | {"XLA_FLAGS": ""}, check=True)


@pytest.mark.slow
def test_workers_take_environments() -> None:
    """A new process knows neither the environment's state class nor its program."""
    from stable_baselines3.common.vec_env import SubprocVecEnv

    env = gymnasium.make(SMALL, backend="compiled")
    env.reset(seed=3)
    expected = env.step(ACTION)[0]
    pure, params = fusion_gym.jax.make(SMALL)
    key = jax.random.PRNGKey(0)
    state = pure.reset(key, params)[1]
    envs = SubprocVecEnv(
        [lambda: (pure.step(key, state, ACTION, params), env)[1]], start_method="spawn"
    )
    try:
        envs.seed(3)
        envs.reset()
        np.testing.assert_array_equal(envs.step(ACTION[None])[0], expected[None])
    finally:
        envs.close()


def test_a_fork_of_a_process_that_has_run_jax_is_refused() -> None:
    pure, params = fusion_gym.jax.make(SMALL)
    key = jax.random.key(0)
    state = pure.reset(key, params)[1]
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)

    def child() -> None:
        jobs: list[Callable[[], Any]] = [
            lambda: pure.reset(key, params),
            lambda: pure.step(key, state, ACTION, params),
            lambda: gymnasium.make_vec(SMALL, 3, backend="numpy").reset()[0].shape,
        ]
        for job in jobs:
            try:
                sender.send(str(job()))
            except RuntimeError as error:
                sender.send(str(error))

    process = context.Process(target=child)
    with pytest.warns(RuntimeWarning, match="fork"):
        process.start()
    try:
        lines = [receiver.recv() for _ in range(3) if receiver.poll(6.0)]
    finally:
        process.kill()
    assert len(lines) == 3
    assert all(
        line.startswith("JAX may hang in a fork") and "'spawn'" in line for line in lines[:2]
    )
    assert lines[2] == "(3, 3)"


def test_parameters_of_linearfusion_are_the_ones_that_it_has() -> None:
    """A filter without nodes has no shares of information."""
    for kind, shares in (("kalman", [0.5, 0.5]), ("adf", None)):
        _, params = fusion_gym.jax.make("fusion_gym/LinearFusion-v2", filter=kind)
        np.testing.assert_array_equal(params.measurement_variance, [[0.25], [0.25]])
        if shares is None:
            assert params.information_shares is None
        else:
            np.testing.assert_array_equal(params.information_shares, shares)
