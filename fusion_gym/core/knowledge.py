"""Who knows what: one order for signals, observations, policies and fair comparisons."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, get_args

from fusion_gym import validation

Knowledge = Literal[
    "clock", "centre", "own", "coordinator", "own_memory", "coordinator_memory"
]  # fmt: skip
KNOWLEDGE: tuple[Knowledge, ...] = get_args(Knowledge)
MEANING: dict[Knowledge, str] = {
    "clock": "nothing but the time in the episode",
    "centre": "what the fusion centre knows before anything is sent",
    "own": "a sensor's new measurement and what the centre tells all sensors",
    "coordinator": "all sensors' new measurements and what the centre knows",
    "own_memory": "the same as own, and what that sensor measured and did not send",
    "coordinator_memory": "the same as coordinator, and what all sensors measured and did not send",
}
# What each class knows besides itself.
_BELOW: dict[Knowledge, tuple[Knowledge, ...]] = {
    "clock": (),
    "centre": ("clock",),
    "own": ("clock",),
    "coordinator": ("clock", "centre", "own"),
    "own_memory": ("clock", "own"),
    "coordinator_memory": ("clock", "centre", "own", "coordinator", "own_memory"),
}


def covers(knower: Knowledge, known: Knowledge) -> bool:
    """Whether whoever has the class ``knower`` knows all that belongs to the class ``known``.

    clock < centre and own < coordinator, and own and coordinator also with memory; centre and own
    do not cover each other.

    Raises:
        ConfigurationError: an unknown class.
    """
    for name, value in (("knower", knower), ("known", known)):
        validation.choice(name, value, KNOWLEDGE)
    return known == knower or known in _BELOW[knower]


def least_covering(classes: Iterable[Knowledge]) -> Knowledge:
    """The least class that covers all the given ones; ``"clock"`` for none."""
    wanted = tuple(classes)
    able = [k for k in KNOWLEDGE if all(covers(k, one) for one in wanted)]
    return min(able, key=lambda k: len(_BELOW[k]))
