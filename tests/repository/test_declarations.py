"""Every policy, fusion rule, filter, metric and algorithm of the library declares itself."""

import re
from typing import Any

import pytest

from docs.tables import task_of
from fusion_gym.docstrings import read
from fusion_gym.envs.registration import ENVIRONMENTS, options_of
from fusion_gym.evaluation.metrics import METRICS
from fusion_gym.fusion.table import RULES
from fusion_gym.policies.registry import (
    Context,
    make_policy,
    policy_maker,
    policy_names,
    policy_parameters,
)
from fusion_gym.training.algorithms import TABLE

POLICIES = [policy_maker(name) for kind in ("rule", "reference") for name in policy_names(kind)]
FILTERS = [owner for env_id in ENVIRONMENTS for owner in options_of(env_id).filters.values()]
FUSION = [type(row.make()) for row in RULES.values()]
DECLARED: list[Any] = list(dict.fromkeys([*POLICIES, *FILTERS, *FUSION]))


@pytest.mark.parametrize("owner", DECLARED, ids=lambda owner: owner.__name__)
def test_a_declaration_is_complete(owner: Any) -> None:
    result = read(owner)
    expected = {"Equation", "Assumes", "Source"} | ({"Example"} if owner in POLICIES else set())
    assert result.summary.endswith((".", ":"))
    assert expected <= result.labelled.keys()
    assert all(result.labelled[label].strip() for label in expected)
    assert result.labelled["Equation"].count("$$") in range(2, 99, 2)


@pytest.mark.parametrize("name", [*policy_names("rule"), *policy_names("reference")])
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
