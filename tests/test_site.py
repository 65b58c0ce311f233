"""The reference has a page for every public name; `make docs` checks the rest of the site."""

from pathlib import Path

import fusion_gym
from fusion_gym import evaluation
from fusion_gym.envs.registration import ENVIRONMENTS, options_of
from fusion_gym.fusion.table import RULES
from fusion_gym.policies.registry import policy_maker, policy_names

DOCS = Path(__file__).parent.parent / "docs"


def listed(page: str) -> set[str]:
    """The names of the tables of a page that are links to the reference."""
    lines = (line.strip() for line in (DOCS / page).read_text().splitlines())
    return {line for line in lines if line.startswith("fusion_gym.")}


def paths(owners: list[object]) -> set[str]:
    return {f"{owner.__module__}.{owner.__qualname__}" for owner in owners}  # type: ignore[attr-defined]


def test_the_reference_has_every_public_name() -> None:
    modules = {"evaluation", "jax", "zoo"}
    names = {f"fusion_gym.{name}" for name in {*fusion_gym.__all__} - modules - {"__version__"}}
    names |= {f"fusion_gym.evaluation.{name}" for name in evaluation.__all__}
    names |= paths([options_of(env_id) for env_id in ENVIRONMENTS])
    assert names <= listed("reference.md")


def test_every_policy_filter_and_fusion_rule_has_a_page() -> None:
    kinds: list[str] = [*policy_names("rule"), *policy_names("reference")]
    assert paths([policy_maker(name) for name in kinds]) == listed("rules.md")
    filters = [owner for env_id in ENVIRONMENTS for owner in options_of(env_id).filters.values()]
    rules = [type(row.make()) for row in RULES.values()]
    assert paths([*filters, *rules]) == listed("filters.md")
