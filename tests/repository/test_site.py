"""The reference has a page for every public name; `make docs` checks the rest of the site."""

import re

from paths import ROOT

import fusion_gym
from fusion_gym import evaluation
from fusion_gym.envs.registration import ENVIRONMENTS, options_of
from fusion_gym.fusion.table import RULES
from fusion_gym.policies.registry import Kind, policy_maker, policy_names

KINDS: list[Kind] = ["rule", "reference"]
DOCS = ROOT / "docs"


def listed() -> set[str]:
    """The names that have a page of their own on the site."""
    lines = (line.strip() for line in (DOCS / "names.rst").read_text().splitlines())
    return {line for line in lines if line.startswith("fusion_gym.")}


def linked(page: str) -> set[str]:
    """The names whose source the tables of a page link."""
    return set(re.findall(r"\[`([\w.]+)`\]\(\.\./fusion_gym/", (DOCS / page).read_text()))


def in_reference() -> set[str]:
    return linked("reference.md")


def paths(owners: list[object]) -> set[str]:
    return {f"{owner.__module__}.{owner.__qualname__}" for owner in owners}  # type: ignore[attr-defined]


def test_the_reference_has_every_public_name() -> None:
    modules = {"evaluation", "jax", "zoo"}
    names = {f"fusion_gym.{name}" for name in {*fusion_gym.__all__} - modules - {"__version__"}}
    names |= {f"fusion_gym.evaluation.{name}" for name in evaluation.__all__}
    names |= paths([options_of(env_id) for env_id in ENVIRONMENTS])
    assert names <= in_reference()


def test_every_name_policy_filter_and_fusion_rule_has_a_page() -> None:
    policies = [policy_maker(name) for kind in KINDS for name in policy_names(kind)]
    filters = [owner for env_id in ENVIRONMENTS for owner in options_of(env_id).filters.values()]
    rules = [type(row.make()) for row in RULES.values()]
    assert in_reference() | paths([*policies, *filters, *rules]) == listed()
    assert {owner.__name__ for owner in policies} == linked("rules.md")
    assert {owner.__name__ for owner in (*filters, *rules)} == linked("filters.md")
