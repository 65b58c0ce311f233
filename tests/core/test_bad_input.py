"""What cannot be used is refused at once, by an error that names the field and its value."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from rules import make_rule

from fusion_gym import ConfigurationError, make_sb3_vec_env, make_task
from fusion_gym.envs.registration import present_id
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy

ENV_ID = "fusion_gym/TobitOscillator-v1"


def make_vector(num_envs: Any = 3, **options: Any) -> Any:
    return gymnasium.make_vec(
        ENV_ID, num_envs, vectorization_mode="vector_entry_point", **options
    ).unwrapped


def refused(call: Callable[[], Any], kind: type[Exception], parts: tuple[str, ...]) -> str:
    with pytest.raises(kind) as caught:
        call()
    message = str(caught.value)
    assert [part for part in parts if part not in message] == [], message
    return message


# Options of the environment: what is handed in, and what the message must contain.
BAD_OPTIONS: list[tuple[dict[str, Any], tuple[str, ...]]] = [
    ({"initial_covariance": ((1, 0.5), (0.2, 1))}, ("0.5", "0.2", "symmetric")),
    ({"process_noise": "ful"}, ("'ful'", "did you mean 'full'")),
    ({"measurement_matrices": (((1, 0, 0),),)}, ("(any, any, 2)", "(1, 1, 3)")),
    ({"censoring_threshold": np.inf}, ("inf", "finite")),
    ({"token_cost": (3.0, 0.0, 3.0)}, ("(3.0, 0.0, 3.0)", "> 0")),
    ({"token_capacity": 8.9}, ("8.9", "at least 9", "sharing='equal'", "costs up to 3")),
    (
        {"token_capacity": 2.5, "initial_tokens": 1.0, "sharing": "fixed"},
        ("2.5", "at least", "cost of a transmission, 3"),
    ),
    ({"initial_tokens": 31.0}, ("31.0", "<= 30")),
    ({"silent": "hold", "filter": "tobit"}, ("'hold'", "filter='tobit'", "'paper'")),
    ({"event_error": True, "filter": "tobit"}, ("True", "filter='tobit'", "'paper'")),
    ({"information_shares": (0.5, 0.2, 0.2)}, ("[0.5, 0.2, 0.2]", "sum 1", "0.9")),
    ({"horizon": 10.0}, ("10.0", "whole number >= 1")),
    # Two options that contradict each other, one of them a default
    ({"token_capacity": 10.0, "initial_tokens": 11.0}, ("token_capacity = 10", "11.0", "<= 10")),
    ({"token_capacity": 9.5}, ("token_capacity = 9.5", "initial_tokens = 10.0")),
    ({"token_cost": 50.0}, ("token_cost = 50.0", "token_capacity = 30", "at least 150")),
    ({"transition": np.eye(3)}, ("process_gain", "(3)", "transition = [[1.0, 0.0, 0.0]")),
    ({"token_cost": (1, 2), "transition": np.eye(2)}, ("(1, 2)", "(3,)")),
    # Something else where a word, a number or a boolean belongs
    ({"silent": [np.ones((2, 2))], "filter": "tobit"}, ("[[[1.0, 1.0]", "'hold', 'predict'")),
    ({"tokens": b"limited"}, ("b'limited'", "'limited', 'unlimited'")),
    ({"error_weight": 10**400}, ("finite number",)),
    ({"process_variance": np.longdouble("1e4000")}, ("1e+4000", "finite")),
    ({"transition": np.ones((140, 140))}, ("(any, any)", "up to 100", "(140, 140)")),
    # Numbers that float64 cannot square, divide by or wait for
    ({"measurement_variance": 1e308}, ("1e+308", "at most 1e+15")),
    ({"initial_covariance": np.diag([1.0, -1.0])}, ("-1.0", "positive semi-definite")),
    ({"horizon": 10**9}, ("1000000000", "<= 50000")),
    ({"transition": ((1, 2), (3, 4))}, ("((1, 2), (3, 4))", "horizon = 100", "up to 1e+32")),
    (
        {"error_weight": 1e15, "state_weights": (1e15, 1e15), "process_variance": 1e5},
        ("1e+15", "state_weights = ", "1e+32"),
    ),
    ({"bound_epsilon": (1e-12,) * 14}, ("1e-12", "at least 1e-09")),
    ({"trigger_decay": 1e6}, ("1000000.0", "trigger_divisor = 5.0", "horizon = 100", "1e+120")),
]


@pytest.mark.parametrize(("options", "parts"), BAD_OPTIONS, ids=lambda value: str(value)[:60])
def test_options(options: dict[str, Any], parts: tuple[str, ...]) -> None:
    """Every way to an environment says the same; the field that is to blame comes first."""
    field = next(iter(options))
    ways: list[Callable[[], Any]] = [
        lambda: make_task(ENV_ID, **options),
        lambda: gymnasium.make(ENV_ID, **options),
        lambda: make_vector(**options),
        lambda: make_sb3_vec_env(ENV_ID, 2, **options),
    ]
    messages = {refused(way, ConfigurationError, (field, *parts)) for way in ways}
    assert len(messages) == 1
    assert "\n" not in messages.pop()


def test_an_unknown_option() -> None:
    """Also a ``TypeError``, which gymnasium.make passes on with a remark of its own."""
    for make in (make_task, gymnasium.make, lambda _, **value: make_vector(**value)):
        for kind in (ConfigurationError, TypeError):
            message = refused(
                lambda make=make: make(ENV_ID, horizn=np.ones((2, 2))),
                kind,
                (f"{ENV_ID} got an unexpected keyword argument 'horizn'", "mean 'horizon'?"),
            )
            assert "\n" not in message


# What a process noise of rank one leaves of it is no covariance that could be inverted.
GILBERT_ELLIOTT, MEMORY = {"channel": "gilbert_elliott"}, {"memory": True}
ESTIMATE = {"packet": "estimate"}
UNSTABLE = (((1.1, 0.0), (0.0, 1.0)),) * 2
# Options of all environments.
ELSEWHERE: list[tuple[str, dict[str, Any], tuple[str, ...]]] = [
    ("RemoteEstimation", {"sensors": 17, "action": "discrete"}, ("'discrete'", "17 sensors")),
    ("RemoteEstimation", {"token_capacity": 0.5}, ("token_capacity = 0.5", "initial_tokens = 1.0")),
    ("RemoteEstimation", {"coefficient": 9.0}, ("coefficient = 9.0", "horizon = 200", "1e+32")),
    ("CorrelatedTracking", {"token_capacity": 3.5}, ("= 3.5", "initial_tokens = 10.0")),
    ("UnknownInput", {"input_amplitude": 0.0}, ("input_amplitude = 0.0", "differ from zero")),
    ("BiasedOscillator", {"censoring_threshold": 1e9}, ("1000000000.0", "censoring_upper")),
    ("BiasedOscillator", {"censoring_threshold": 5.0}, ("is not allowed",)),
    ("BiasedOscillator", {"bias_gain": [[0.1]]}, ("is not allowed",)),
    ("BiasedOscillator", {"information_shares": [0.5, 0.5], "filter": "adf"}, ("is not allowed",)),
    ("RemoteEstimation", {"coefficient": 100.0}, ()),
    ("RemoteEstimation", {"drop_probability": 0.1}, ()),
    ("RemoteEstimation", {"channel_transition": np.eye(2), "channel": "independent"}, ()),
    ("RemoteEstimation", GILBERT_ELLIOTT | {"channel_transition": ((0.5, 0.4), (0, 1))}, ()),
    ("RemoteEstimation", GILBERT_ELLIOTT | {"channel_transition": np.eye(2)}, ("initial_channel",)),
    # Packets and memory
    ("TobitOscillator", {"broadcast": "none"}, ("broadcast = 'none'", "'estimate' or 'packets'")),
    ("TobitOscillator", MEMORY | {"information": "centre"}, ("memory = True", "must be False")),
    ("TobitOscillator", {"memory_filter": "adf"}, ("= 'adf'", "unless memory=True")),
    (
        "TobitOscillator",
        {"belief_features": ["value"], "information": "centre"},
        ("belief_features = ['value']", "information='centre'"),
    ),
    ("TobitOscillator", {"memory_filter": "best"} | MEMORY, ("= 'best'", "'adf'")),
    ("TobitOscillator", {"belief_features": "x"} | MEMORY, ("= 'x'", "'difference'")),
    ("TobitOscillator", {"packet": "estimate", "filter": "tobit"}, ("= 'estimate'", "memory=True")),
    ("TobitOscillator", ESTIMATE | MEMORY, ("packet = 'estimate'", "silent='hold'")),
    ("MarkovJumpTracking", ESTIMATE | MEMORY, ("packet = 'estimate'", "already")),
    ("UnknownInput", ESTIMATE | MEMORY, ("packet = 'estimate'", "the centre computes")),
    ("RemoteEstimation", ESTIMATE | MEMORY, ("packet = 'estimate'", "source's value")),
    ("CorrelatedTracking", {"memory_filter": "imm"} | MEMORY, ("= 'imm'", "one filt")),
    ("RemoteEstimation", {"memory_filter": "adf"} | MEMORY, ("= 'adf'", "one filter")),
    # Systems of one's own
    ("LinearFusion", {"measurement_matrices": []}, ("measurement_matrices = []",)),
    ("LinearFusion", {"measurement_matrices": 3}, ("a list with a matrix for each sensor",)),
    ("LinearFusion", {"measurement_matrices": [[1, 0], [[1, 0, 0]]]}, ("measurement_matrices[1]",)),
    ("LinearFusion", {"state_names": ["a", "a"]}, ("2 different words",)),
    ("LinearFusion", {"state_names": ["a", "b", "a"]}, ("2 different words",)),
    ("LinearFusion", {"state_names": ["a", "b,c"]}, ("2 different words",)),
    ("LinearFusion", {"measurement_covariances": [1.0]}, ("each of the 2 sensors",)),
    (
        "LinearFusion",
        {"measurement_covariances": [1.0, [[1, 2], [2, 1]]]},
        ("measurement_covariances[1]",),
    ),
    (
        "LinearFusion",
        {
            "measurement_covariances": [[[1, 0.5], [0.5, 1]]],
            "measurement_matrices": [[[1, 0], [0, 1]]],
            "censoring_threshold": 0.0,
        },
        ("diagonal",),
    ),
    ("LinearFusion", {"censoring_threshold": [0.0, [1.0, 2.0]]}, ("censoring_threshold[1]",)),
    ("LinearFusion", {"censoring_threshold": 1.0, "censoring_upper": 0.0}, ()),
    ("LinearFusion", {"transition": [[2.0, 0.0], [0.0, 1.5]]}, ()),
    # Correlated and jumping plants
    (
        "CorrelatedTracking",
        {"horizon": 300, "transition": np.diag([1.3, 1.0, 1.0])},
        ("horizon = 300", "at most 127"),
    ),
    ("CorrelatedTracking", {"noise_scale": 0.0}, ("noise_scale = 0.0", "> 0")),
    ("CorrelatedTracking", {"noise_scale": 1.5}, ("noise_scale = 1.5", "<= 1")),
    ("CorrelatedTracking", {"fusion": "information"}, ("= 'information'", "process noise")),
    ("CorrelatedTracking", {"fusion": "federated"}, ("fusion = 'federated'", "'sici'")),
    ("CorrelatedTracking", {"fusion": "scii"}, ("did you mean 'sci",)),
    ("CorrelatedTracking", {"order": (0, 1, 2), "fusion": "ci"}, ("order = ", "fusion='ci'")),
    ("CorrelatedTracking", {"order": (0, 1, 1)}, ("order = (0, 1, 1)", "once")),
    ("CorrelatedTracking", {"order": (1, 2, 3)}, ()),
    ("CorrelatedTracking", {"transition": ((1.0, 0.1),)}, ()),
    ("CorrelatedTracking", {"process_variance": 0.0}, ()),
    ("CorrelatedTracking", {"initial_covariance": -np.eye(3)}, ()),
    ("CorrelatedTracking", {"thresholds": 1.0}, ("unknown option", "trigger_threshold")),
    ("MarkovJumpTracking", {"fusion": "information"}, ("= 'information'", "correlated")),
    ("MarkovJumpTracking", {"fusion": "federated"}, ("fusion = 'federated'", "shares of")),
    ("MarkovJumpTracking", {"fusion": "matrx"}, ("did you mean 'matrix'",)),
    ("MarkovJumpTracking", {"mode_transition": ((0.6, 0.3), (0.4, 0.6))}, ("[0.9, 1.0]",)),
    ("MarkovJumpTracking", {"transitions": UNSTABLE}, ("mean-square stable",)),
    ("MarkovJumpTracking", {"sampling_periods": 0}, ()),
    ("MarkovJumpTracking", {"fading_values": ((1.5, 0.5),) * 3}, ("from 0 to 1",)),
    ("MarkovJumpTracking", {"fading_probabilities": ((0.5, 0.4, 0.0),) * 3}, ("add up to 1",)),
    ("MarkovJumpTracking", {"initial_probabilities": (0.5, 0.4)}, ("add up to 1, not 0.9",)),
    ("MarkovJumpTracking", {"sampling_period": 2}, ("unknown option", "sampling_periods")),
    ("MarkovJumpTracking", {"filter": "central"}, ("did you mean 'centralised'",)),
    ("MarkovJumpTracking", {"fusion": "matrix", "filter": "imm"}, ("filter='imm': ", "left out")),
    ("MarkovJumpTracking", {"fusion": "ci", "filter": "centralised"}, ("filter='centralised'",)),
]


@pytest.mark.parametrize(("name", "options", "parts"), ELSEWHERE, ids=lambda value: str(value)[:60])
def test_options_elsewhere(name: str, options: dict[str, Any], parts: tuple[str, ...]) -> None:
    message = refused(
        lambda: make_task(present_id(name), **options),
        ConfigurationError,
        (next(iter(options)), *parts),
    )
    assert "\n" not in message
    assert len(message) < 1000


@pytest.mark.parametrize("num_envs", [0, -2, 2.0, "2", True, None], ids=repr)
def test_number_of_environments(num_envs: Any) -> None:
    for make in (make_vector, lambda count: make_sb3_vec_env(ENV_ID, count)):
        refused(
            lambda make=make: make(num_envs),
            ConfigurationError,
            (f"num_envs = {num_envs!r}", "whole number >= 1"),
        )


@pytest.mark.parametrize(
    ("call", "parts"),
    [
        (
            lambda: make_task("fusion_gym/TobitOscilator-v0"),
            ("'fusion_gym/TobitOscilator-v0'", "did you mean 'fusion_gym/TobitOscillator-v1'"),
        ),
        (lambda: make_task("CartPole-v1"), ("'CartPole-v1'", "cartpole:CartPoleEnv")),
        (lambda: make_vector(autoreset_mode="same_step"), ("'same_step'", "mean 'SameStep'")),
        (lambda: make_vector(autoreset_mode=3), ("autoreset_mode = 3", "'Disabled'")),
        (lambda: make_vector(max_episode_steps=0), ("max_episode_steps = 0",)),
        (lambda: make_sb3_vec_env(ENV_ID, 2, stagger=1), ("stagger = 1", "True or False")),
        (lambda: gymnasium.make(ENV_ID).reset(options={"phase": 1}), ("'phase'",)),
        (lambda: make_vector().reset(options=["reset_mask"]), ("options = ['reset_mask']",)),
        (lambda: make_vector().reset(seed=[1, "a", 2]), ("seed = [1, 'a', 2]", "whole numbers")),
        (lambda: gymnasium.make(ENV_ID, self=1), ("unexpected keyword argument 'self'",)),
        (lambda: make_task(3), ("env = 3", "id")),  # type: ignore[arg-type]
        (
            lambda: make_vector().reset(options={"reset_masks": 1}),
            ("'reset_masks'", "did you mean 'reset_mask'"),
        ),
        (lambda: run_episodes(make_task(ENV_ID), make_rule("never"), 0, 1), ("episodes = 0",)),
        (lambda: run_episodes(make_task(ENV_ID), make_rule("never"), 5, -1), ("seed = -1",)),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "call",
)
def test_calls(call: Callable[[], Any], parts: tuple[str, ...]) -> None:
    refused(call, ConfigurationError, parts)


@pytest.mark.parametrize(
    ("spec", "parts"),
    [
        ("randm", ("unknown policy 'randm'", "did you mean 'random'")),
        ("", ("unknown policy ''", "always, centre_variance")),
        ("random:rat=0.1", ("'rat'", "did you mean 'rate'")),
        ("random:rate", ("'rate'", "key=value")),
        ("random:rate=0.1,rate=0.2", ("'rate'", "twice")),
        ("random:rate=1.5", ("rate = 1.5", "<= 1")),
        ("random:rate=often", ("rate = 'often'", "number")),
        ("dynamic_event:threshold=0.1/-1/0.3", ("threshold = (0.1, -1, 0.3)", ">= 0")),
        ("information_gain:threshold=0.1/0.2/0.3,at_most=none", ("threshold = (0.1, 0.2, 0.3)",)),
        ("innovation_threshold:at_most=0", ("at_most = 0", "whole number >= 1")),
        ("rollout:price=-1,base=never", ("price = -1",)),
        ("round_robin:period=2.5", ("period = 2.5", "whole number >= 1")),
        ("model:", ("model ''", "no such file")),
        ("model:nowhere/agent.zip", ("'nowhere/agent.zip'", "no such file")),
        ("model:nowhere,greedy=true", ("'greedy'", "deterministic")),
    ],
)
def test_policies(spec: str, parts: tuple[str, ...]) -> None:
    refused(lambda: make_policy(spec, make_task(ENV_ID)), ConfigurationError, parts)


TOBIT, VALUE, OPTIMUM = "TobitOscillator", "value_of_information", "periodic_optimum"
CENTRE, MARKOV = {"information": "centre"}, "MarkovJumpTracking"


@pytest.mark.parametrize(
    ("name", "options", "spec", "parts"),
    [
        (TOBIT, {}, "rollout", ("policy 'rollout' needs a parameter 'base': write base=",)),
        (TOBIT, {}, "rollout:base=always:samples=3", ("of policy 'always' 'samples'",)),
        (TOBIT, {}, "rollout:steps=0,base=never", ("steps = 0",)),
        (TOBIT, {}, "rollout:base=dynamic_event", ("'dynamic_event'", "of the present step")),
        (TOBIT, {}, "rollout:base=rollout:base=never", ("base = 'rollout:base=never'",)),
        (TOBIT, {}, "rollout:base=value_of_information:own=true", ("a scheduler's policy",)),
        (TOBIT, CENTRE, "rollout:base=never", ("information = 'centre'",)),
        (TOBIT, {}, f"{VALUE}:threshold=0.1,price=0.1", ("price = 0.1", "with threshold")),
        (TOBIT, {}, f"{VALUE}:own=true,at_most=2", ("at_most = 2", "own=True")),
        (TOBIT, {}, "estimate_difference:own=true,at_most=2", ("at_most = 2", "own=True")),
        (TOBIT, {}, "kullback_leibler:own=true,at_most=3", ("at_most = 3", "own=True")),
        (TOBIT, CENTRE, VALUE, ("information = 'centre'",)),
        (MARKOV, {}, f"{OPTIMUM}:packets=19", ("packets = 19", "<= 18")),
        (MARKOV, {}, f"{OPTIMUM}:packets=12,period=8", ("packets = 12", "2704156 schedules")),
        (MARKOV, {"access": "single"}, OPTIMUM, ("access = 'single'", "'any'")),
        (MARKOV, {"filter": "imm"}, OPTIMUM, ("depend only on deliveries",)),
    ],
)
def test_policies_elsewhere(
    name: str, options: dict[str, Any], spec: str, parts: tuple[str, ...]
) -> None:
    task = make_task(present_id(name), **options)
    message = refused(lambda: make_policy(spec, task), ConfigurationError, parts)
    assert "\n" not in message


# Hostile actions of every kind: test_fuzz_actions.py.
BAD_ACTIONS: list[tuple[str, Any, tuple[str, ...]]] = [
    ("binary", [1, np.nan, 0], ("nan", "0 or 1")),
    ("binary", [0, -1, 0], ("= -1", "0 or 1")),
    ("binary", [[1, 0, 1]], ("shape",)),
    ("multidiscrete", [1, np.nan, 0], ("nan", "0 or 1")),
    ("multidiscrete", [0, 2, 0], ("= 2", "0 or 1")),
    ("multidiscrete", [1, 0, 1, 0], ("shape",)),
    ("discrete", 8, ("= 8", "0..7")),
    ("discrete", np.array(3, dtype=object), ("object",)),
]


@pytest.mark.parametrize(
    ("kind", "action", "parts"), BAD_ACTIONS, ids=lambda value: repr(value)[:40]
)
def test_actions(kind: str, action: Any, parts: tuple[str, ...]) -> None:
    """Nothing moves when an action is refused: the next good step is that of an untouched twin."""
    good = 3 if kind == "discrete" else [1, 1, 0]
    single, twin = (gymnasium.make(ENV_ID, action=kind).unwrapped for _ in range(2))
    vector, sb3 = make_vector(1, action=kind), make_sb3_vec_env(ENV_ID, 1, action=kind)
    sb3.seed(0)
    for env in (single, twin, vector):
        env.reset(seed=0)
    sb3.reset()
    refused(lambda: single.step(action), ValueError, ("action", *parts))
    batch = np.asarray(action)[None]
    refused(lambda: vector.step(batch), ValueError, ("action", *parts))
    refused(lambda: sb3.step(batch), ValueError, ("action", *parts))
    expected = twin.step(good)[1]
    assert single.step(good)[1] == pytest.approx(expected, rel=1e-12)
    assert vector.step(np.array([good]))[1] == pytest.approx(expected, rel=1e-10)
    assert sb3.step(np.array([good]))[1] == pytest.approx(expected, rel=1e-6)


def test_the_first_bad_action_of_a_batch_is_named() -> None:
    env = make_vector(4)
    env.reset(seed=0)
    actions = np.zeros((4, 3))
    actions[2, 1] = 7.0
    refused(lambda: env.step(actions), ValueError, ("[2, 1]", "7.0"))
    refused(lambda: env.step(np.zeros((3, 3))), ValueError, ("(3, 3)", "(4, 3)"))


@pytest.mark.parametrize(
    "mask", [[True, False, True], np.ones((3, 1), bool), np.zeros(3, bool)], ids=repr
)
def test_reset_masks(mask: Any) -> None:
    env = make_vector()
    env.reset(seed=0)
    message = refused(
        lambda: env.reset(options={"reset_mask": mask}), ValueError, ("reset_mask = ", "(3,)")
    )
    assert repr(mask) in message


@pytest.mark.parametrize(
    ("seed", "kind", "parts"),
    [
        ([1, 2], ValueError, ("2 entries", "3")),
        ([1, 2, -3], ConfigurationError, ("seed = -3", "whole number >= 0")),
        (-1, gymnasium.error.Error, ("-1",)),
    ],
    ids=str,
)
def test_seeds(seed: Any, kind: type[Exception], parts: tuple[str, ...]) -> None:
    refused(lambda: make_vector().reset(seed=seed), kind, parts)


def test_a_reset_comes_first() -> None:
    nothing = np.zeros((3, 3), dtype=np.int8)
    some = {"reset_mask": np.array([True, False, True])}
    env = make_vector()
    refused(lambda: env.step(nothing), ResetNeeded, ("reset",))
    refused(lambda: env.reset(options=some), ValueError, ("reset_mask", "never reset"))
    single = gymnasium.make(ENV_ID).unwrapped
    refused(lambda: single.step(nothing[0]), ResetNeeded, ("reset",))


def test_finished_runs_must_be_reset_when_autoreset_is_disabled() -> None:
    env = make_vector(3, autoreset_mode="Disabled", horizon=2)
    env.reset(seed=0)
    nothing = np.zeros((3, 3), dtype=np.int8)
    env.step(nothing)
    env.reset(options={"reset_mask": np.array([False, True, False])})
    assert env.step(nothing)[3].tolist() == [True, False, True]
    refused(lambda: env.step(nothing), ResetNeeded, ("[0, 2]", "reset_mask"))
    env.reset(options={"reset_mask": np.array([True, False, False])})
    refused(lambda: env.step(nothing), ResetNeeded, ("[2]",))
