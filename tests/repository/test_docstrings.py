"""The library declares its parts, its reference has every name, and the examples run."""

import doctest
import functools
import inspect
import pickle
import re
from typing import Any

import pytest
from paths import ROOT

import fusion_gym
from docs.tables import task_of
from fusion_gym import evaluation, recordings, wrappers
from fusion_gym.core.task import CommonOptions
from fusion_gym.docstrings import read
from fusion_gym.envs import registration
from fusion_gym.envs.option_text import options_in
from fusion_gym.envs.registration import ENVIRONMENTS, options_of
from fusion_gym.evaluation.metrics import METRICS
from fusion_gym.fusion.table import RULES
from fusion_gym.importing import import_named
from fusion_gym.policies import registry
from fusion_gym.policies.registry import (
    Context,
    make_policy,
    policy_maker,
    policy_names,
    policy_parameters,
)
from fusion_gym.recordings import FittedPlant, Recording, fit
from fusion_gym.training.config import TABLE

POLICY_NAMES = [*policy_names("rule"), *policy_names("reference")]
POLICIES = [policy_maker(name) for name in POLICY_NAMES]
FILTERS = [owner for env_id in ENVIRONMENTS for owner in options_of(env_id).filters.values()]
FUSION = [type(row.make()) for row in RULES.values()]
DECLARED: list[Any] = list(dict.fromkeys([*POLICIES, *FILTERS, *FUSION]))
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def linked(page: str) -> set[str]:
    """The names whose source the tables of a page link."""
    text = (ROOT / "docs" / page).read_text()
    return set(re.findall(r"\[`([\w.]+)`\]\(\.\./fusion_gym/", text))


def paths(owners: list[Any]) -> set[str]:
    return {f"{owner.__module__}.{owner.__qualname__}" for owner in owners}


REFERENCE = linked("reference.md")
NAMES = sorted(REFERENCE)


# --- every name has its page ---------------------------------------------------------------------


def test_the_reference_has_every_public_name() -> None:
    modules = {"evaluation", "wrappers", "zoo"}
    names = {f"fusion_gym.{name}" for name in {*fusion_gym.__all__} - modules - {"__version__"}}
    names |= {f"fusion_gym.evaluation.{name}" for name in evaluation.__all__}
    names |= {f"fusion_gym.wrappers.{name}" for name in wrappers.__all__}
    names |= paths([options_of(env_id) for env_id in ENVIRONMENTS])
    assert names <= REFERENCE


def test_every_name_policy_filter_and_fusion_rule_has_a_page() -> None:
    listed = re.findall(
        r"^ *(fusion_gym\.\S+)$", (ROOT / "docs/names.rst").read_text(), re.MULTILINE
    )
    assert REFERENCE | paths(DECLARED) == set(listed)
    assert {owner.__name__ for owner in POLICIES} == linked("rules.md")
    assert {owner.__name__ for owner in (*FILTERS, *FUSION)} == linked("filters.md")


# --- declarations --------------------------------------------------------------------------------


@pytest.mark.parametrize("owner", DECLARED, ids=lambda owner: owner.__name__)
def test_a_declaration_is_complete(owner: Any) -> None:
    result = read(owner)
    expected = {"Equation", "Assumes", "Source"} | ({"Example"} if owner in POLICIES else set())
    assert result.summary.endswith((".", ":"))
    assert expected <= result.labelled.keys()
    assert all(result.labelled[label].strip() for label in expected)
    assert result.labelled["Equation"].count("$$") in range(2, 99, 2)


@pytest.mark.parametrize("name", POLICY_NAMES)
def test_a_policy_declares_its_parameters_and_runs_as_its_example(name: str) -> None:
    declared = read(policy_maker(name))
    arguments = [key for key in declared.arguments if key not in Context.__annotations__]
    assert arguments == list(policy_parameters(name))
    spec, env = re.findall("``(.+?)``", " ".join(declared.labelled["Example"].split()))
    assert spec.partition(":")[0] == name
    make_policy(spec, task_of(env))


def test_rows_say_what_they_mean() -> None:
    rows: list[Any] = [*RULES.values(), *METRICS.values(), *TABLE.values()]
    assert all(row.meaning for row in rows)
    assert all(row.source for row in TABLE.values())


def test_sections_are_reported_apart() -> None:
    def bare() -> None:
        """What it *is*: all of it.

        More.

        Args:
            a: one thing
                in two lines.
            b: another.

        Sources: nobody;
        nowhere.
        """

    result = read(bare)
    assert result.summary == "What it *is*: all of it."
    assert result.text.endswith("More.")
    assert result.arguments == {"a": "one thing in two lines.", "b": "another."}
    assert result.labelled["Source"] == "nobody;\nnowhere."


# --- docstrings ----------------------------------------------------------------------------------


def owner(name: str) -> Any:
    return import_named("name", ":".join(name.rsplit(".", 1)))


@pytest.mark.parametrize("name", NAMES)
def test_a_docstring_names_every_argument(name: str) -> None:
    result = owner(name)
    parts = result.__mro__ if isinstance(result, type) else (result,)  # of a base, too
    text = "\n".join(inspect.getdoc(part) or "" for part in parts)
    described = set(re.findall(r"^ {4}\*{0,2}(\w+):", text, re.MULTILINE))
    if isinstance(result, type) and issubclass(result, CommonOptions):  # its fields have docstrings
        described = {key for key, option in options_in(result).items() if option.meaning}
    if not getattr(result, "_is_protocol", False):
        assert inspect.signature(result).parameters.keys() <= described


FITS: dict[bytes, FittedPlant] = {}


@functools.wraps(fit)
def fit_once(recording: Recording, **options: Any) -> FittedPlant:
    """The same fit is part of several examples."""
    key = pickle.dumps((recording, options))
    if key not in FITS:
        FITS[key] = fit(recording, **options)
    return FITS[key]


LONG = ("fusion_gym.recordings.", "fusion_gym.jax.FiveValueEnv")


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow if n.startswith(LONG) else ()) for n in NAMES],
)
def test_an_example_runs(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registration, "ENVIRONMENTS", dict(registration.ENVIRONMENTS))
    monkeypatch.setattr(registry, "_ROWS", dict(registry._ROWS))
    monkeypatch.setattr(recordings, "fit", fit_once)
    text = inspect.getdoc(owner(name)) or ""
    test = doctest.DocTestParser().get_doctest(text, {}, name, None, None)
    assert test.examples
    assert doctest.DocTestRunner(optionflags=FLAGS).run(test).failed == 0
