"""Any value in any field of a training's YAML: one line that names the field, or a model."""

import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pydantic
import pytest
from fuzzing import FREE, HOSTILE
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from fusion_gym import ConfigurationError
from fusion_gym.training.config import TABLE, Experiment, checked, load_checked
from fusion_gym.training.run import check_run

Content = dict[str, Any]
_UNKNOWN = ("nobody_knows_this",)
SMALL = {"batch_size": 8, "buffer_size": 100, "n_steps": 8}


def plain(kind: str) -> Content:
    """A config of this algorithm with all its fields, small enough to make in no time."""
    content = load_checked(Experiment, "remote_estimation_ppo").model_dump(mode="json")
    content["environment"]["options"]["horizon"] = 20
    if "binary" not in TABLE[kind].actions:
        content["environment"]["options"]["action"] = "discrete"
    content["training"]["num_envs"] = 2
    content["algorithm"] = TABLE[kind].config(name=kind).model_dump(mode="json")
    content["algorithm"] |= {key: SMALL[key] for key in SMALL.keys() & content["algorithm"].keys()}
    content["algorithm"]["network"]["hidden"] = [4]
    return content


def fields(model: pydantic.BaseModel, content: Content) -> Iterator[tuple[str, ...]]:
    """The way to every field of a model, to those of models within it as well."""
    for name in type(model).model_fields:
        yield (name,)
        inner = getattr(model, name)
        if isinstance(inner, pydantic.BaseModel):
            yield from ((name, *rest) for rest in fields(inner, content[name]))


def values(default: Any) -> st.SearchStrategy[Any]:
    """What may stand in YAML, mostly where it does not belong."""
    numbers = HOSTILE.filter(lambda value: isinstance(value, (bool, int, float)))
    fitting = numbers.filter(lambda value: not 10**4 < abs(value) < 2**62)  # sizes, in memory
    words = st.sampled_from(("", "word", "two\nlines", "1000", "1e-3", "tanh", "ppo", "a2c", "dqn"))
    near = st.just(default)
    if isinstance(default, (int, float)) and not isinstance(default, bool):
        near = st.sampled_from((default, default * 2, default / 2, -default, str(default)))
    leaf = st.one_of(near, fitting, words, st.none())
    mapping = st.sampled_from((dict.fromkeys(_UNKNOWN, 1), {}))
    return st.one_of(leaf, leaf, st.lists(leaf, max_size=2), mapping)


def flaw(content: Content, path: tuple[str, ...]) -> str | None:
    """What is wrong with how a config is taken whose field at this path was changed."""
    try:
        model, env, _ = check_run(checked(Experiment, content, "config 'fuzz.yaml'"))
    except ConfigurationError as error:
        message = str(error)
        named = any(name in message for name in (*path[-2:], *_UNKNOWN))
        return None if named and "\n" not in message else f"names it not: {message}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None if model.get_env() is env else "a model of another environment"


@pytest.mark.parametrize("tries", [15, pytest.param(400, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", TABLE)
@pytest.mark.filterwarnings("ignore::UserWarning:stable_baselines3")
def test_any_value_in_any_field(kind: str, tries: int, tmp_path: Path) -> None:
    base = plain(kind) | {"output": str(tmp_path / "run")}
    assert flaw(base, ()) is None
    ways = list(fields(checked(Experiment, base, "config 'base.yaml'"), base))

    @settings(max_examples=tries, derandomize=True, phases=[Phase.generate], **FREE)
    @given(st.data())
    def sound(data: st.DataObject) -> None:
        path = data.draw(st.sampled_from(ways))
        content = copy.deepcopy(base)
        place = content
        for name in path[:-1]:
            place = place[name]
        place[path[-1]] = data.draw(values(place[path[-1]]))
        message = flaw(content, path)
        assert message is None, (message, path, place[path[-1]])
        assert not (tmp_path / "run").exists()

    sound()
