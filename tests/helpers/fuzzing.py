"""Options as nobody should write them: strategies made from an environment's options, and a judge.

All that is known of an environment is its dataclass of options (fields, types, defaults) and what
its errors say, so that a new one is covered without a change here.
"""

import copy
import decimal
import fractions
import functools
import math
import re
import signal
import types
import typing
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from hypothesis import HealthCheck
from hypothesis import strategies as st

from fusion_gym import ConfigurationError, make_task
from fusion_gym.envs.registration import options_of

Options = dict[str, Any]
STEPS, RUNS, SECONDS = 50, 3, 20
# Settings of hypothesis for tries that take long and are not kept.
FREE: Options = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}

# What belongs nowhere; the functions make what a copy could not be of.
_STRANGE: tuple[Any, ...] = (
    None, "", "two\nlines", "random", b"bytes", {}, {"a": 1.0}, set(), [], [[]],
    [[1.0], [1.0, 2.0]], [None], ["a", "b"],
    lambda: functools.reduce(lambda inner, _: [inner], range(80), 1.0),
    [True, False],
    lambda: memoryview(b"bytes"), lambda: (value for value in (1.0, 2.0)),
    lambda: (value := [], value.append(value))[0],
    1 + 2j, object(), int, range(3), 10**400, -(10**400),
    fractions.Fraction(1, 3), decimal.Decimal("0.5"), np.array("word"),
    np.array(["word", "other"]), np.array([None, 1.0]), np.array(2.0), np.array(7),
    np.array(True), np.zeros(0), np.ones((2, 2)), np.ones((3, 2, 2)), np.eye(40),
    [np.ones((2, 2)), np.ones((2, 2))], np.linspace(0.0, 1.0, 3000),
    np.ma.masked_array([1.0, 2.0], mask=[True, False]), np.float32(0.3), np.float16(3.0),
    np.longdouble("1e4000"), np.int64(3), np.uint8(200), np.bool_(True), np.str_("word"),
    np.datetime64("2020-01-01"), np.float64("nan"), np.array([1.0, np.nan]),
    [[1.0, math.inf], [0.0, 1.0]],
)  # fmt: skip
# 9¹² entries in twelve lists: a reader of options must count before it makes an array of it.
_EXPANDING = st.builds(lambda: functools.reduce(lambda inner, _: [inner] * 9, range(12), 1.0))
_EXTREME: tuple[Any, ...] = (
    True, False, 0, -1, 1, 2, 7, 10**3, 10**5, 10**6, 10**9, 2**63, 0.0, -0.0, 0.5, 2.5, -3.0,
    1e3, 1e6, 1e9, 1e12, 1e100, 1e154, 1e160, 1e300, 1e308, -1e9, -1e308,
    1e-3, 1e-6, 1e-9, 1e-12, 1e-160, 1e-308, 1e-320, 5e-324, math.nan, math.inf, -math.inf,
)  # fmt: skip


@functools.cache
def words(env_id: str, option: str) -> tuple[str, ...]:
    """The words that an option takes, as the error of a wrong one lists them."""
    try:
        make_task(env_id, **{option: "no such word"})
    except ConfigurationError as error:
        return tuple(re.findall(r"'([a-z_]+)'", str(error)))
    return ()


def values(env_id: str, option: str) -> st.SearchStrategy[Any]:
    """Good values and nearly good ones of an option, or hostile ones."""
    return st.one_of(_likely(env_id, option), _likely(env_id, option), HOSTILE, _EXPANDING)


def _likely(env_id: str, option: str) -> st.SearchStrategy[Any]:
    field = next(field for field in fields(options_of(env_id)) if field.name == option)
    hint, default = typing.get_type_hints(options_of(env_id))[option], field.default
    named = words(env_id, option)
    strategies: list[st.SearchStrategy[Any]] = [st.just(default)]
    if named:
        strategies += [st.sampled_from(named)] * 4
    if hint is bool or default is None:
        strategies += [st.booleans()]
    if hint is int:
        strategies += [st.integers(1, 2 * default), st.integers(1, 10**4)] * 2
    elif isinstance(default, float):
        strategies += [_factors().map(lambda factor: default * factor)] * 3
    elif isinstance(default, tuple) or (default is None and not named):
        strategies += [_arrays(default)] * 6
    return st.one_of(strategies)


def _magnitudes() -> st.SearchStrategy[float]:
    sign = st.sampled_from((1.0, 1.0, -1.0))
    return st.builds(lambda s, power: s * 10.0**power, sign, st.floats(-320.0, 308.0))


def _factors() -> st.SearchStrategy[float]:
    near = st.floats(0.3, 3.0)
    return near | near | st.floats(-12.0, 12.0).map(lambda power: 10.0**power)


def _fresh(strange: Any) -> Any:
    return strange() if isinstance(strange, types.FunctionType) else copy.deepcopy(strange)


HOSTILE: st.SearchStrategy[Any] = st.one_of(
    st.sampled_from(_EXTREME), st.sampled_from(_STRANGE).map(_fresh), _magnitudes()
)


def _arrays(default: Any) -> st.SearchStrategy[Any]:
    """Arrays like the default, or of any small shape: scaled, cut, turned, with one odd entry."""
    if default is None:
        shapes = st.lists(st.integers(1, 4), max_size=3).map(tuple)
        start = shapes.flatmap(
            lambda shape: st.lists(
                st.floats(-2.0, 2.0), min_size=math.prod(shape), max_size=math.prod(shape)
            ).map(lambda entries: np.array(entries).reshape(shape))
        )
    else:
        start = st.just(np.array(default))
    return st.builds(_changed, start, _changes(), _factors(), st.integers(0, 10**6), _odd())


def _changes() -> st.SearchStrategy[str]:
    return st.sampled_from(("scaled", "entry", "entry", "cut", "turned", "wrapped", "whole"))


def _odd() -> st.SearchStrategy[Any]:
    return st.sampled_from(_EXTREME[1:]) | st.floats(-3.0, 3.0) | _magnitudes()


def _changed(array: Any, change: str, factor: float, place: int, odd: Any) -> Any:
    if change == "entry" and array.size:
        result = array.astype(object)
        result.flat[place % array.size] = odd
        return result.tolist()
    changed = {
        "scaled": lambda: array * factor,
        "cut": lambda: array[: place % (len(array) + 1)] if array.ndim else array,
        "turned": lambda: array.T,
        "wrapped": lambda: array[None],
    }
    result = changed.get(change, lambda: array)()
    return result if place % 2 else result.tolist()


def options(env_id: str) -> st.SearchStrategy[Options]:
    """One to three options of an environment, at least one of them perhaps hostile."""
    names = [field.name for field in fields(options_of(env_id))]
    selection = st.lists(st.sampled_from(names), min_size=1, max_size=3, unique=True)
    return selection.flatmap(
        lambda drawn: st.fixed_dictionaries({name: values(env_id, name) for name in drawn})
    )


DELIBERATE = (
    "token_capacity = .* cannot all transmit",
    "token_rate = .* favour some",
    "backend='compiled' runs under NumPy",
)
_ROUNDING = "horizon = .* rounding errors may reach"


def flaw(env_id: str, settings: Options, seed: int = 0) -> str | None:
    """What is wrong with how an environment takes these options; ``None`` for nothing.

    Right is one line that names a given option, or finite steps, both within the time limit and
    without a warning.
    """
    extreme = _is_extreme(env_id, settings)
    with _time_limit(), warnings.catch_warnings():
        warnings.simplefilter("error")
        for deliberate in (*DELIBERATE, *[_ROUNDING] * extreme):
            warnings.filterwarnings("ignore", deliberate)
        try:
            env: VectorEnv[Any, Any, Any] = gymnasium.make_vec(
                env_id, RUNS, vectorization_mode="vector_entry_point", **settings
            )
        except ConfigurationError as error:
            return _misleading(str(error), settings)
        except Exception as error:
            return f"{type(error).__name__} when made: {error}"
        try:
            return _unsound(env, seed)
        except Exception as error:
            return f"{type(error).__name__} in a step: {error}"


def _is_extreme(env_id: str, settings: Options) -> bool:
    """Whether a number among the options is a million times its default, or a millionth."""
    default = options_of(env_id)()
    pairs = ((value, getattr(default, name)) for name, value in settings.items())
    plain = [(a, b) for a, b in pairs if {type(a), type(b)} <= {int, float}]
    return any(not 1e-6 * abs(b) <= abs(a) <= 1e6 * abs(b) for a, b in plain)


def _misleading(message: str, settings: Options) -> str | None:
    if "\n" in message or len(message) > 2000:
        return f"not one line: {message}"
    if not any(re.search(rf"\b{name}(\[\d+\])? ?=", message) for name in settings):
        return f"names none of the given options: {message}"
    return None


def _unsound(env: VectorEnv[Any, Any, Any], seed: int) -> str | None:
    observation, infos = env.reset(seed=seed)
    random = np.random.default_rng(seed)
    rate = random.choice((0.05, 0.5, 1.0))
    for step in range(STEPS):
        for name, value in (("observation", observation), *_numbers(infos)):
            if not np.isfinite(value).all():
                return f"{name} is not finite after {step} steps"
        env.action_space.seed(int(random.integers(2**31)))
        action = env.action_space.sample()
        action = np.where(random.random(action.shape) < 2.0 * rate, action, 0)
        observation, reward, _, _, infos = env.step(action)
        if not np.isfinite(reward).all():
            return f"a reward is not finite in step {step}"
    return None


def _numbers(infos: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in infos.items():
        if isinstance(value, dict):
            yield from _numbers(value)
        elif np.asarray(value).dtype.kind in "fiub":
            yield name, value


@contextmanager
def _time_limit() -> Iterator[None]:
    """Whatever hangs ends in a TimeoutError."""

    def late(*_: Any) -> None:
        raise TimeoutError(f"longer than {SECONDS} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
