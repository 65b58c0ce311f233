"""Any action at all, at every face: one line that begins with "action", or a step."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from fuzzing import FREE, HOSTILE
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

import fusion_gym

ENV_ID = "fusion_gym/TobitOscillator-v1"  # three sensors
KINDS: dict[str, dict[str, str]] = {
    "binary": {},
    "multidiscrete": {"action": "multidiscrete"},
    "discrete": {"action": "discrete"},
    "single": {"access": "single"},
}
RUNS = 2
Step = Callable[[Any], tuple[Any, ...]]


def shapes(kind: str) -> dict[str, tuple[int, ...]]:
    """The shape of an action at each face."""
    own = (3,) if kind in ("binary", "multidiscrete") else ()
    return {"single": own, "vector": (RUNS, *own), "sb3": (RUNS, *own), "local": (RUNS * 3,)}


def build_parts(interface: str, kind: str) -> Step:
    """A reset environment's step."""
    options: dict[str, Any] = {"horizon": 2_000, **KINDS[kind]}
    if interface == "single":
        single = gymnasium.make(ENV_ID, **options).unwrapped
        single.reset(seed=0)
        return single.step
    if interface == "vector":
        vector = gymnasium.make_vec(ENV_ID, RUNS, **options)
        vector.reset(seed=0)
        return vector.step
    rows = fusion_gym.make_sb3_vec_env(ENV_ID, RUNS, local=interface == "local", **options)
    rows.seed(0)
    rows.reset()
    return rows.step


def numbers(shape: tuple[int, ...]) -> st.SearchStrategy[Any]:
    """Arrays of about this shape, mostly of what is allowed."""
    near = st.sampled_from((shape, shape, shape, shape, (*shape, 1), (1, *shape), shape[1:], (7,)))
    entry = st.sampled_from(
        (0, 1, 1, 0, 1.0, True, 2, 3, 4, 7, 8, -1, 0.5, 2.0**70, np.nan, np.inf, "1", None, b"0")
    )
    kinds = st.sampled_from((None, None, np.int8, np.uint8, np.float32, np.bool_, object))

    def filled(shape: tuple[int, ...], entries: list[Any], kind: Any) -> Any:
        values = np.empty(shape, dtype=object)
        for place in range(values.size):
            values.flat[place] = entries[place % len(entries)]
        try:
            return values.tolist() if kind is None else values.astype(kind)
        except (TypeError, ValueError, OverflowError):
            return values

    return st.builds(filled, near, st.lists(entry, min_size=1, max_size=3), kinds)


def allowed(action: Any, shape: tuple[int, ...], highest: int) -> bool:
    """Whether an action is whole numbers from 0 to the highest, in this shape."""
    try:
        values = np.asarray(action)
    except ValueError:
        return False
    if values.dtype.kind not in "biuf" or values.shape != shape:
        return False
    return bool(np.isin(values, np.arange(highest + 1)).all())


def flaw(step: Step, twin: Step, action: Any, good: bool) -> str | None:
    """What is wrong with the answer to an action; the twin takes those that are allowed alone."""
    try:
        result = step(action)
    except ValueError as error:
        message = str(error)
        if good:
            return f"refused: {message}"
        return None if message.startswith("action") and "\n" not in message else message
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    if not good:
        return "accepted"
    same = np.array_equal(result[1], twin(action)[1])
    return None if same and np.isfinite(result[1]).all() else "another step"


@pytest.mark.parametrize("tries", [40, pytest.param(500, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("interface", ["single", "vector", "sb3", "local"])
@pytest.mark.filterwarnings("error")
def test_any_action(interface: str, kind: str, tries: int) -> None:
    (step, twin), shape = (build_parts(interface, kind) for _ in range(2)), shapes(kind)[interface]
    highest = 1 if interface == "local" else {"discrete": 7, "single": 3}.get(kind, 1)

    @settings(max_examples=tries, derandomize=True, phases=[Phase.generate], **FREE)
    @given(action=numbers(shape) | numbers(shape) | HOSTILE)
    def sound(action: Any) -> None:
        assert flaw(step, twin, action, allowed(action, shape, highest)) is None, repr(action)

    sound()


@pytest.mark.parametrize("tries", [40, pytest.param(500, marks=pytest.mark.slow)])
def test_any_actions_of_agents(tries: int) -> None:
    env, other = (fusion_gym.parallel_env(ENV_ID, horizon=2_000) for _ in range(2))
    env.reset(seed=0)
    other.reset(seed=0)
    names = [*env.possible_agents, "sensor_7", 3]
    choice = st.sampled_from((0, 1, 1.0, True, np.int64(1), np.array(0), 2, -1, "1")) | HOSTILE
    few = st.dictionaries(st.sampled_from(names), choice, max_size=4)
    right = st.fixed_dictionaries(dict.fromkeys(env.possible_agents, choice))

    def stepped(env: Any) -> Step:
        return lambda actions: (None, list(env.step(actions)[1].values()))

    @settings(max_examples=tries, derandomize=True, phases=[Phase.generate], **FREE)
    @given(actions=right | few | HOSTILE)
    def sound(actions: Any) -> None:
        complete = isinstance(actions, dict) and set(actions) == set(env.agents)
        good = complete and allowed([actions[name] for name in env.agents], (3,), 1)
        assert flaw(stepped(env), stepped(other), actions, good) is None, repr(actions)

    sound()
