"""Public docstrings name every argument, and their examples run."""

import doctest
import inspect
import re
from typing import Any

import pytest
from test_site import in_reference

from fusion_gym.core.options import CommonOptions
from fusion_gym.envs import registration
from fusion_gym.envs.option_text import options_in
from fusion_gym.importing import import_named
from fusion_gym.policies import registry

NAMES = sorted(in_reference())
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def owner(name: str) -> Any:
    return import_named("name", ":".join(name.rsplit(".", 1)))


@pytest.mark.parametrize("name", NAMES)
def test_a_docstring_names_every_argument(name: str) -> None:
    result, text = owner(name), inspect.getdoc(owner(name)) or ""
    described = set(re.findall(r"^ {4}\*{0,2}(\w+):", text, re.MULTILINE))
    if isinstance(result, type) and issubclass(result, CommonOptions):  # its fields have docstrings
        described = {key for key, option in options_in(result).items() if option.meaning}
    if not getattr(result, "_is_protocol", False):
        assert inspect.signature(result).parameters.keys() <= described


@pytest.mark.parametrize("name", NAMES)
def test_an_example_runs(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registration, "ENVIRONMENTS", dict(registration.ENVIRONMENTS))
    monkeypatch.setattr(registry, "_ROWS", dict(registry._ROWS))
    text = inspect.getdoc(owner(name)) or ""
    test = doctest.DocTestParser().get_doctest(text, {}, name, None, None)
    assert test.examples
    assert doctest.DocTestRunner(optionflags=FLAGS).run(test).failed == 0
