"""Rules for no task in particular."""

from typing import Any

from fusion_gym.policies.base import Policy
from fusion_gym.policies.registry import _make


def make_rule(spec: str, defaults: dict[str, dict[str, Any]] | None = None) -> Policy:
    """The rule that ``NAME`` or ``NAME:key=value,…`` names, by a scenario's own parameters."""
    context: Any = {"task": None, "trust": False}
    return _make(spec, defaults or {}, context)
