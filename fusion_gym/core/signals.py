"""What is believed, as signals by name, beside those that a system offers itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from fusion_gym.core.beliefs import Beliefs
from fusion_gym.core.memory import Owner
from fusion_gym.core.system import Signal, SignalError

# Knowledge as in a task with memory; without it these need no more than "coordinator" and "own".
MEMORY_SIGNALS = (
    Signal(
        "belief_difference",
        "coordinator_memory",
        "(n, N)",
        "what is believed beyond the centre's estimate if nobody transmits",
    ),
    Signal(
        "transmission_value",
        "coordinator_memory",
        "(sensors, N)",
        "what each packet alone is expected to take off its squared norm, in weights of mean 1",
    ),
    Signal("own_difference", "own_memory", "(sensors, n, N)", "the same as each sensor knows it"),
    Signal("own_value", "own_memory", "(sensors, N)", "the same as each sensor knows it"),
)


def memory_signals(owner: Owner, beliefs: Callable[[], Beliefs]) -> Mapping[str, Callable[[], Any]]:
    """The values of ``MEMORY_SIGNALS``, and the beliefs themselves for policies that plan.

    Those of the other owner than the batch's raise a :class:`SignalError` when looked at.
    """

    def missing() -> Any:
        raise SignalError(
            "this batch does not keep what these beliefs need: a policy that looks at what is "
            "believed declares whose beliefs as an attribute, remember = 'coordinator' or 'own'"
        )

    own = {
        "own_beliefs": beliefs,
        "own_difference": lambda: beliefs().difference,
        "own_value": lambda: beliefs().value(),
    }
    every = {
        "beliefs": beliefs,
        "belief_difference": lambda: np.asarray(beliefs().difference[0]),
        "transmission_value": lambda: beliefs().value(),
    }
    other = every if owner == "own" else own
    return own | every | dict.fromkeys(other, missing)
