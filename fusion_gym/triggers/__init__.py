"""Triggers: the analytic policies, from signals to requests."""

from fusion_gym.triggers.base import Policy, Requests, Trigger
from fusion_gym.triggers.registry import TRIGGERS, make_trigger, parse_settings, parse_value

__all__ = [
    "TRIGGERS",
    "Policy",
    "Requests",
    "Trigger",
    "make_trigger",
    "parse_settings",
    "parse_value",
]
