"""What cannot be used is refused at once, by an error that names the field and its value."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from refusals import refused
from rules import make_rule

from fusion_gym import CommonOptions, ConfigurationError, make_sb3_vec_env, make_task, parallel_env
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.registration import present_id
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy

TOBIT, REMOTE, CORRELATED = "TobitOscillator", "RemoteEstimation", "CorrelatedTracking"
LINEAR, MARKOV, INPUT = "LinearFusion", "MarkovJumpTracking", "UnknownInput"
BIASED = "BiasedOscillator"
ENV_ID = present_id(TOBIT)
GILBERT_ELLIOTT, MEMORY = {"channel": "gilbert_elliott"}, {"memory": True}
ESTIMATE, CENTRE, THREE = {"packet": "estimate"}, {"information": "centre"}, {"sensors": 3}
UNSTABLE = (((1.1, 0.0), (0.0, 1.0)),) * 2
FIXED = {"token_capacity": 2.5, "initial_tokens": 1.0, "sharing": "fixed"}
HUGE = {"state_weights": (1e15, 1e15), "process_variance": 1e5}
CENSORED = {"measurement_matrices": [[[1, 0], [0, 1]]], "censoring_threshold": 0.0}
SILENT = {"filter": "truncated", "trigger": "send_on_delta", "trigger_threshold": 1.0}
QUALITIES = {"drop_probability": ((0.1, 0.8), (0.7, 0.2), (0.4, 0.5))}
PAIRS = {"access": "assignment", "channels": 2, "tokens": "unlimited"}


def make_vector(num_envs: Any = 3, env_id: str = ENV_ID, **options: Any) -> Any:
    return gymnasium.make_vec(env_id, num_envs, **options).unwrapped


WAYS: tuple[Callable[..., Any], ...] = (
    make_task,
    gymnasium.make,
    lambda env_id, **options: make_vector(env_id=env_id, **options),
    lambda env_id, **options: make_sb3_vec_env(env_id, 2, **options),
)
# The environment, what is handed in, and what the message must contain.
OPTIONS: list[tuple[Any, ...]] = [
    (TOBIT, {"initial_covariance": ((1, 0.5), (0.2, 1))}, "0.5", "0.2", "symmetric"),
    (TOBIT, {"process_noise": "ful"}, "'ful'", "did you mean 'full'"),
    (TOBIT, {"measurement_matrices": (((1, 0, 0),),)}, "(any, any, 2)", "(1, 1, 3)"),
    (TOBIT, {"censoring_threshold": np.inf}, "inf", "finite"),
    (TOBIT, {"token_cost": (3.0, 0.0, 3.0)}, "(3.0, 0.0, 3.0)", "> 0"),
    (TOBIT, {"token_capacity": 8.9}, "8.9", "at least 9", "sharing='equal'", "costs up to 3"),
    (TOBIT, FIXED | {"token_capacity": 2.5}, "2.5", "at least", "cost of a transmission, 3"),
    (TOBIT, {"initial_tokens": 31.0}, "31.0", "<= 30"),
    (TOBIT, {"silent": "hold", "filter": "tobit"}, "'hold'", "filter='tobit'", "'paper'"),
    (TOBIT, {"event_error": True, "filter": "tobit"}, "True", "filter='tobit'", "'paper'"),
    (TOBIT, {"information_shares": (0.5, 0.2, 0.2)}, "[0.5, 0.2, 0.2]", "sum 1", "0.9"),
    (TOBIT, {"horizon": 10.0}, "10.0", "whole number >= 1"),
    # Two options that contradict each other, one of them a default
    (TOBIT, {"token_capacity": 10.0, "initial_tokens": 11.0}, "capacity = 10", "11.0", "<= 10"),
    (TOBIT, {"token_capacity": 9.5}, "token_capacity = 9.5", "initial_tokens = 10.0"),
    (TOBIT, {"token_cost": 50.0}, "token_cost = 50.0", "token_capacity = 30", "at least 150"),
    (TOBIT, {"transition": np.eye(3)}, "process_gain", "(3)", "transition = [[1.0, 0.0, 0.0]"),
    (TOBIT, {"token_cost": (1, 2), "transition": np.eye(2)}, "(1, 2)", "(3,)"),
    # Something else where a word, a number or a boolean belongs
    (TOBIT, {"silent": [np.ones((2, 2))], "filter": "tobit"}, "[[[1.0, 1.0]", "'hold', 'predict'"),
    (TOBIT, {"tokens": b"limited"}, "b'limited'", "'limited', 'unlimited'"),
    (TOBIT, {"error_weight": 10**400}, "finite number"),
    (TOBIT, {"process_variance": np.longdouble("1e4000")}, "1e+4000", "finite"),
    (TOBIT, {"transition": np.ones((140, 140))}, "(any, any)", "up to 100", "(140, 140)"),
    # Numbers that float64 cannot square, divide by or wait for
    (TOBIT, {"measurement_variance": 1e308}, "1e+308", "at most 1e+15"),
    (TOBIT, {"initial_covariance": np.diag([1.0, -1.0])}, "-1.0", "positive semi-definite"),
    (TOBIT, {"horizon": 10**9}, "1000000000", "<= 50000"),
    (TOBIT, {"transition": ((1, 2), (3, 4))}, "((1, 2), (3, 4))", "horizon = 100", "up to 1e+32"),
    (TOBIT, {"error_weight": 1e15} | HUGE, "1e+15", "state_weights = ", "1e+32"),
    (TOBIT, {"bound_epsilon": (1e-12,) * 14}, "1e-12", "at least 1e-09"),
    (TOBIT, {"trigger_decay": 1e6}, "1000000.0", "trigger_divisor = 5.0", "horizon = 100", "+120"),
    # Options of other environments
    (REMOTE, {"sensors": 17, "action": "discrete"}, "'discrete'", "17 sensors"),
    (REMOTE, {"token_capacity": 0.5}, "token_capacity = 0.5", "initial_tokens = 1.0"),
    (REMOTE, {"coefficient": 9.0}, "coefficient = 9.0", "horizon = 200", "1e+32"),
    (CORRELATED, {"token_capacity": 3.5}, "= 3.5", "initial_tokens = 10.0"),
    (INPUT, {"input_amplitude": 0.0}, "input_amplitude = 0.0", "differ from zero"),
    (BIASED, {"censoring_threshold": 1e9}, "1000000000.0", "censoring_upper"),
    (BIASED, {"censoring_threshold": 5.0}, "is not allowed"),
    (BIASED, {"bias_gain": [[0.1]]}, "is not allowed"),
    (REMOTE, {"coefficient": 100.0}),
    (REMOTE, {"drop_probability": 0.1}),
    (REMOTE, {"channel_transition": np.eye(2), "channel": "independent"}),
    (REMOTE, GILBERT_ELLIOTT | {"channel_transition": ((0.5, 0.4), (0, 1))}),
    (REMOTE, GILBERT_ELLIOTT | {"channel_transition": np.eye(2)}, "initial_channel"),
    # Packets and memory
    (TOBIT, {"broadcast": "none"}, "broadcast = 'none'", "'estimate' or 'packets'"),
    (TOBIT, MEMORY | CENTRE, "memory = True", "must be False"),
    (TOBIT, {"memory_filter": "adf"}, "= 'adf'", "unless memory=True"),
    (
        TOBIT,
        {"belief_features": ["value"]} | CENTRE,
        "features = ['value']",
        "information='centre'",
    ),
    (TOBIT, {"packet": "estimate", "filter": "tobit"}, "= 'estimate'", "memory=True"),
    (TOBIT, ESTIMATE | MEMORY, "packet = 'estimate'", "silent='hold'"),
    (MARKOV, ESTIMATE | MEMORY, "packet = 'estimate'", "already"),
    (INPUT, ESTIMATE | MEMORY, "packet = 'estimate'", "the centre computes"),
    (REMOTE, ESTIMATE | MEMORY, "packet = 'estimate'", "source's value"),
    (CORRELATED, {"memory_filter": "imm"} | MEMORY, "= 'imm'", "one filt"),
    (REMOTE, {"memory_filter": "adf"} | MEMORY, "= 'adf'", "one filter"),
    # Systems of one's own
    (LINEAR, {"measurement_matrices": []}, "measurement_matrices = []"),
    (LINEAR, {"measurement_matrices": 3}, "a list with a matrix for each sensor"),
    (LINEAR, {"measurement_matrices": [[1, 0], [[1, 0, 0]]]}, "measurement_matrices[1]"),
    (LINEAR, {"state_names": ["a", "b", "a"]}, "2 different words"),
    (LINEAR, {"state_names": ["a", "b,c"]}, "2 different words"),
    (LINEAR, {"measurement_covariances": [1.0]}, "each of the 2 sensors"),
    (LINEAR, {"measurement_covariances": [1.0, [[1, 2], [2, 1]]]}, "measurement_covariances[1]"),
    (LINEAR, {"measurement_covariances": [[[1, 0.5], [0.5, 1]]]} | CENSORED, "diagonal"),
    (LINEAR, {"censoring_threshold": [0.0, [1.0, 2.0]]}, "censoring_threshold[1]"),
    (LINEAR, {"censoring_threshold": 1.0, "censoring_upper": 0.0}),
    (LINEAR, {"transition": [[2.0, 0.0], [0.0, 1.5]]}),
    # Correlated and jumping plants
    (CORRELATED, {"horizon": 300, "transition": np.diag([1.3, 1, 1])}, "= 300", "at most 127"),
    (CORRELATED, {"noise_scale": 0.0}, "noise_scale = 0.0", "> 0"),
    (CORRELATED, {"noise_scale": 1.5}, "noise_scale = 1.5", "<= 1"),
    (CORRELATED, {"fusion": "information"}, "= 'information'", "process noise"),
    (CORRELATED, {"fusion": "federated"}, "fusion = 'federated'", "'sici'"),
    (CORRELATED, {"order": (0, 1, 2), "fusion": "ci"}, "order = ", "fusion='ci'"),
    (CORRELATED, {"order": (0, 1, 1)}, "order = (0, 1, 1)", "once"),
    (CORRELATED, {"order": (1, 2, 3)}),
    (CORRELATED, {"transition": ((1.0, 0.1),)}),
    (CORRELATED, {"process_variance": 0.0}),
    (MARKOV, {"fusion": "information"}, "= 'information'", "correlated"),
    (MARKOV, {"fusion": "federated"}, "fusion = 'federated'", "shares of"),
    (MARKOV, {"mode_transition": ((0.6, 0.3), (0.4, 0.6))}, "[0.9, 1.0]"),
    (MARKOV, {"transitions": UNSTABLE}, "mean-square stable"),
    (MARKOV, {"sampling_periods": 0}),
    (MARKOV, {"fading_values": ((1.5, 0.5),) * 3}, "from 0 to 1"),
    (MARKOV, {"fading_probabilities": ((0.5, 0.4, 0.0),) * 3}, "add up to 1"),
    (MARKOV, {"initial_probabilities": (0.5, 0.4)}, "add up to 1, not 0.9"),
    (MARKOV, {"filter": "central"}, "did you mean 'centralised'"),
    (MARKOV, {"fusion": "matrix", "filter": "imm"}, "filter='imm': ", "left out"),
    (MARKOV, {"fusion": "ci", "filter": "centralised"}, "filter='centralised'"),
    # Access without a use
    (REMOTE, {"slots": 2}, "slots = 2", "access='any'"),
    (REMOTE, {"slots": 2, "access": "single"}, "slots = 2", "access='single'"),
    (REMOTE, {"slots": 2, "access": "collision"}, "slots = 2", "access='collision'"),
    (REMOTE, {"slots": 2, "access": "assignment"}, "slots = 2", "access='assignment'"),
    (REMOTE, {"slots": 4, "access": "slots"} | THREE, "slots = 4", "<= 3"),
    (REMOTE, {"slots": 0, "access": "slots"} | THREE, "slots = 0", ">= 1"),
    (REMOTE, {"channels": 2}, "channels = 2", "access='any'"),
    (REMOTE, {"channels": 1.5, "access": "collision"}, "channels = 1.5", "whole number"),
    (CORRELATED, {"channels": 65, "access": "assignment"}, "channels = 65", "<= 64"),
    (REMOTE, {"discrepancy": "held"}, "discrepancy = 'held'", "access='any'"),
    (REMOTE, {"discrepancy_weights": (1, 0, 1), "access": "try_once_discard"} | THREE),
    (REMOTE, {"discrepancy_weights": (1, 2, 1)} | THREE, "access='any'"),
    (REMOTE, {"access": "collision"} | THREE | SILENT, "access = 'collision'", "no silence"),
    (REMOTE, {"access": "assignment"} | SILENT, "access = 'assignment'", "no silence"),
    (CORRELATED, {"action": "assignment"}, "action = 'assignment'", "access='any'"),
    (CORRELATED, QUALITIES | PAIRS | {"channels": 3, "channel": "independent"}, "shape (3, 3)"),
    (CORRELATED, QUALITIES | {"channel": "independent"}, "shape (3,)"),
    (CORRELATED, QUALITIES | PAIRS | GILBERT_ELLIOTT, "a pair of probabilities"),
    (CORRELATED, {"drop_probability": (0.3, 0.2, 0.1)} | GILBERT_ELLIOTT, "a pair of"),
    (TOBIT, {"own_number": 1}, "own_number = 1 "),
]


@pytest.mark.parametrize("row", OPTIONS, ids=lambda row: str(row)[:60])
def test_options(row: tuple[Any, ...]) -> None:
    """Every way to an environment says the same; the field that is to blame comes first."""
    name, options, *parts = row
    messages = {
        refused(lambda way=way: way(present_id(name), **options), next(iter(options)), *parts)
        for way in WAYS
    }
    assert len(messages) == 1
    assert len(messages.pop()) < 1000


@pytest.mark.parametrize("num_envs", [0, -2, 2.0, "2", True, None], ids=repr)
def test_number_of_environments(num_envs: Any) -> None:
    for make in (make_vector, lambda count: make_sb3_vec_env(ENV_ID, count)):
        message = f"num_envs = {num_envs!r}"
        refused(lambda make=make: make(num_envs), message, "whole number >= 1")


CALLS: list[tuple[Any, ...]] = [
    (
        lambda: make_task("fusion_gym/TobitOscilator-v0"),
        *("'fusion_gym/TobitOscilator-v0'", "did you mean 'fusion_gym/TobitOscillator-v1'"),
    ),
    (lambda: make_task("CartPole-v1"), "'CartPole-v1'", "cartpole:CartPoleEnv"),
    (lambda: make_vector(autoreset_mode="same_step"), "'same_step'", "mean 'SameStep'"),
    (lambda: make_vector(autoreset_mode=3), "autoreset_mode = 3", "'Disabled'"),
    (lambda: make_vector(max_episode_steps=0), "max_episode_steps = 0"),
    (lambda: make_vector(render_mode="human"), "render_mode = 'human'"),
    (lambda: make_sb3_vec_env(ENV_ID, 2, stagger=1), "stagger = 1", "True or False"),
    (lambda: make_sb3_vec_env(ENV_ID, 2, reward="vector"), "reward = 'vector'"),
    (lambda: make_sb3_vec_env(ENV_ID, 2, render_mode="human"), "render_mode = 'human'"),
    (lambda: make_sb3_vec_env(ENV_ID, 2, wrapper_class=dict), "wrapper_class", "a VecEnvWrapper"),
    (lambda: parallel_env(ENV_ID, reward="vector"), "reward = 'vector'"),
    (lambda: gymnasium.make(ENV_ID).reset(options={"phase": 1}), "'phase'"),
    (lambda: make_vector().reset(options=["reset_mask"]), "options = ['reset_mask']"),
    (lambda: make_vector().reset(options={"reset_masks": 1}), "did you mean 'reset_mask'"),
    (lambda: make_vector().reset(seed=[1, "a", 2]), "seed = [1, 'a', 2]", "whole numbers"),
    (lambda: make_vector().reset(seed=[1, 2, -3]), "seed = -3", "whole number >= 0"),
    (lambda: gymnasium.make(ENV_ID, self=1), "unexpected keyword argument 'self'"),
    (lambda: make_task(3), "env = 3", "id"),  # type: ignore[arg-type]
    (lambda: run_episodes(make_task(ENV_ID), make_rule("never"), 0, 1), "episodes = 0"),
    (lambda: run_episodes(make_task(ENV_ID), make_rule("never"), 5, -1), "seed = -1"),
]


@pytest.mark.parametrize("row", CALLS, ids=lambda row: row[1])
def test_calls(row: tuple[Any, ...]) -> None:
    call, *parts = row
    refused(call, *parts)


def test_calls_that_gymnasium_refuses() -> None:
    refused(lambda: make_vector().reset(seed=[1, 2]), "2 entries", "3", kind=ValueError)
    refused(lambda: make_vector().reset(seed=-1), "-1", kind=gymnasium.error.Error)
    for kind in (ConfigurationError, TypeError):
        with pytest.raises(kind, match="render_mode = 'ansi'"):
            gymnasium.make(ENV_ID, render_mode="ansi")


VALUE, OPTIMUM = "value_of_information", "periodic_optimum"
POLICIES: list[tuple[Any, ...]] = [
    (TOBIT, {}, "randm", "unknown policy 'randm'", "did you mean 'random'"),
    (TOBIT, {}, "", "unknown policy ''", "always, centre_variance"),
    (TOBIT, {}, "random:rat=0.1", "'rat'", "did you mean 'rate'"),
    (TOBIT, {}, "random:rate", "'rate'", "key=value"),
    (TOBIT, {}, "random:rate=0.1,rate=0.2", "'rate'", "twice"),
    (TOBIT, {}, "random:rate=1.5", "rate = 1.5", "<= 1"),
    (TOBIT, {}, "dynamic_event:threshold=0.1/-1/0.3", "threshold = (0.1, -1, 0.3)", ">= 0"),
    (
        TOBIT,
        {},
        "centre_variance:threshold=0.1/0.2/0.3",
        "threshold = (0.1, 0.2, 0.3)",
    ),
    (TOBIT, {}, "innovation_threshold:at_most=0", "at_most = 0", "whole number >= 1"),
    (TOBIT, {}, "rollout:price=-1,base=never", "price = -1"),
    (TOBIT, {}, "round_robin:period=2.5", "period = 2.5", "whole number >= 1"),
    (TOBIT, {}, "model:", "model ''", "no such file"),
    (TOBIT, {}, "model:nowhere/agent.zip", "'nowhere/agent.zip'", "no such file"),
    (TOBIT, {}, "model:nowhere,greedy=true", "'greedy'", "deterministic"),
    (TOBIT, {}, "rollout", "policy 'rollout' needs a parameter 'base': write base="),
    (TOBIT, {}, "rollout:base=always:samples=3", "of policy 'always' 'samples'"),
    (TOBIT, {}, "rollout:steps=0,base=never", "steps = 0"),
    (TOBIT, {}, "rollout:base=dynamic_event", "'dynamic_event'", "of the present step"),
    (TOBIT, {}, "rollout:base=rollout:base=never", "base = 'rollout:base=never'"),
    (TOBIT, {}, "rollout:base=value_of_information:own=true", "a scheduler's policy"),
    (TOBIT, CENTRE, "rollout:base=never", "information = 'centre'"),
    (TOBIT, {}, f"{VALUE}:threshold=0.1,price=0.1", "price = 0.1", "with threshold"),
    (TOBIT, {}, f"{VALUE}:own=true,at_most=2", "at_most = 2", "own=True"),
    (TOBIT, {}, "estimate_difference:own=true,at_most=2", "at_most = 2", "own=True"),
    (TOBIT, {}, "kullback_leibler:own=true,at_most=3", "at_most = 3", "own=True"),
    (TOBIT, CENTRE, VALUE, "information = 'centre'"),
    (MARKOV, {}, f"{OPTIMUM}:packets=19", "packets = 19", "<= 18"),
    (MARKOV, {}, f"{OPTIMUM}:packets=12,period=8", "packets = 12", "2704156 schedules"),
    (MARKOV, {"access": "single"}, OPTIMUM, "access = 'single'", "'any'"),
    (MARKOV, {"filter": "imm"}, OPTIMUM, "depend only on deliveries"),
    (REMOTE, {"access": "assignment"}, "optimal", "access = 'assignment'"),
    (REMOTE, {"access": "assignment"}, "whittle", "access = 'assignment'"),
    (CORRELATED, PAIRS, OPTIMUM, "access = 'assignment'"),
]


@pytest.mark.parametrize("row", POLICIES, ids=lambda row: str(row)[:60])
def test_policies(row: tuple[Any, ...]) -> None:
    name, options, spec, *parts = row
    task = make_task(present_id(name), **options)
    refused(lambda: make_policy(spec, task), *parts)


# Hostile actions of every kind, at every interface: test_fuzz_actions.py.
ACTIONS: list[tuple[Any, ...]] = [
    ("binary", [1, np.nan, 0], "nan", "0 or 1"),
    ("binary", [0, -1, 0], "= -1", "0 or 1"),
    ("binary", [[1, 0, 1]], "shape"),
    ("multidiscrete", [1, np.nan, 0], "nan", "0 or 1"),
    ("multidiscrete", [0, 2, 0], "= 2", "0 or 1"),
    ("multidiscrete", [1, 0, 1, 0], "shape"),
    ("discrete", 8, "= 8", "0..7"),
    ("discrete", np.array(3, dtype=object), "object"),
]


@pytest.mark.parametrize("row", ACTIONS, ids=lambda row: str(row)[:40])
def test_actions(row: tuple[Any, ...]) -> None:
    kind, action, *parts = row
    single, vector = gymnasium.make(ENV_ID, action=kind).unwrapped, make_vector(1, action=kind)
    for env, given in ((single, action), (vector, np.array([action]))):
        env.reset(seed=0)
        refused(lambda env=env, given=given: env.step(given), "action", *parts, kind=ValueError)


def test_the_first_bad_action_of_a_batch_is_named() -> None:
    env = make_vector(4)
    env.reset(seed=0)
    actions = np.zeros((4, 3))
    actions[2, 1] = 7.0
    refused(lambda: env.step(actions), "[2, 1]", "7.0", kind=ValueError)
    refused(lambda: env.step(np.zeros((3, 3))), "(3, 3)", "(4, 3)", kind=ValueError)


@pytest.mark.parametrize(
    "mask", [[True, False, True], np.ones((3, 1), bool), np.zeros(3, bool)], ids=repr
)
def test_reset_masks(mask: Any) -> None:
    env = make_vector()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"reset_mask = (.|\n)*\(3,\)") as caught:
        env.reset(options={"reset_mask": mask})
    assert repr(mask) in str(caught.value)


def test_a_reset_comes_first() -> None:
    nothing = np.zeros((3, 3), dtype=np.int8)
    some = {"reset_mask": np.array([True, False, True])}
    env = make_vector()
    refused(lambda: env.step(nothing), "reset", kind=ResetNeeded)
    refused(lambda: env.reset(options=some), "reset_mask", "never reset", kind=ValueError)
    single = gymnasium.make(ENV_ID).unwrapped
    refused(lambda: single.step(nothing[0]), "reset", kind=ResetNeeded)


def test_finished_runs_must_be_reset_when_autoreset_is_disabled() -> None:
    env = make_vector(3, autoreset_mode="Disabled", horizon=2)
    env.reset(seed=0)
    nothing = np.zeros((3, 3), dtype=np.int8)
    env.step(nothing)
    env.reset(options={"reset_mask": np.array([False, True, False])})
    assert env.step(nothing)[3].tolist() == [True, False, True]
    refused(lambda: env.step(nothing), "[0, 2]", "reset_mask", kind=ResetNeeded)
    env.reset(options={"reset_mask": np.array([True, False, False])})
    refused(lambda: env.step(nothing), "[2]", kind=ResetNeeded)


@pytest.mark.parametrize("backend", ["numpy", "compiled"])
@pytest.mark.parametrize("kind", [int, float, object, list], ids=lambda kind: kind.__name__)
def test_requests_of_another_kind_move_nothing(backend: str, kind: Any) -> None:
    task = make_task("fusion_gym/RemoteEstimation-v1", backend=backend)
    batch = EpisodeBatch.seeded(task, 2, 0)
    before, steps = batch.observe().copy(), batch.steps.copy()
    requests = [[False, False]] if kind is list else np.zeros((1, 2), kind)
    refused(lambda: batch.step(requests), "requests = [[", "it must be bool")
    np.testing.assert_array_equal(batch.observe(), before)
    np.testing.assert_array_equal(batch.steps, steps)


@dataclass(frozen=True)
class HeavierOptions(CommonOptions):
    """Another default, without the mark of the option's first declaration."""

    error_weight: float = 2.0


def test_limits_hold_where_an_environment_overrides_a_default() -> None:
    assert HeavierOptions().error_weight == 2.0
    refused(lambda: HeavierOptions(error_weight=-1.0), "error_weight = -1.0", ">= 0")
