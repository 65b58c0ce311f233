"""The signals of the beliefs, in addition to a system's own signals."""

from collections.abc import Callable, Mapping
from typing import Any

from fusion_gym.core.beliefs import Beliefs, Owner
from fusion_gym.core.knowledge import Signal
from fusion_gym.core.task import ONE_STEP

# Knowledge in a task with memory; without memory "scheduler" and "own" suffice.
MEMORY_SIGNALS = (
    Signal(
        "belief_difference",
        "scheduler_memory",
        "(n, N)",
        "x* − x̂, the scheduler's estimate minus the centre's without a transmission",
    ),
    Signal(
        "transmission_value",
        "scheduler_memory",
        "(sensors, N)",
        "v(m) = ‖x* − x̂‖² − E‖x* − x̂(m)‖², in weights of mean 1",
    ),
    Signal("own_difference", "own_memory", "(sensors, n, N)", "x* − x̂ of each sensor"),
    Signal("own_value", "own_memory", "(sensors, N)", "v(m) of each sensor"),
)
NETWORK_SIGNALS = (
    Signal(
        "energy",
        "centre",
        "(sensors, N)",
        "tokens that pay for a sensor's packets: its own with budget='sensor', or the shared ones",
        "own",
    ),
    Signal(
        "channel_state",
        "centre",
        "(sensors, N)",
        "state of the channel at the step before: 0 bad, 1 good; (sensors, channels, N) with "
        '`access="assignment"`',
        "own",
    ),
    Signal(
        "arrival_probability",
        "centre",
        "(sensors, N)",
        "probability that a packet sent now arrives now, by the model, on the best channel",
        "own",
    ),
    Signal(
        "link_probability",
        "centre",
        "(sensors, channels, N)",
        "probability that a packet sent now on this channel of an assignment arrives now",
        "own",
    ),
)
# For policies that plan, and for saved agents.
PLANNING_SIGNALS = (
    Signal("estimate", "scheduler", "a state", "the estimator's state"),
    Signal("beliefs", "scheduler_memory", "beliefs", "the scheduler's belief of the state"),
    Signal("own_beliefs", "own_memory", "beliefs", "each sensor's belief of the state"),
)

# Signals of a packet that arrives at once, which a delay excludes.
_AT_ONCE = ("transmission_value", "own_value", "variance_reduction", "greedy_variance")

_OWN = ("own_beliefs", "own_difference", "own_value")
_EVERY = ("beliefs", "belief_difference", "transmission_value")


def memory_signals(owner: Owner, beliefs: Callable[[], Beliefs]) -> Mapping[str, Callable[[], Any]]:
    """Return the owner's beliefs and ``MEMORY_SIGNALS`` by name, as functions."""
    if owner == "own":
        values = (beliefs, lambda: beliefs().difference, lambda: beliefs().value)
        return dict(zip(_OWN, values, strict=True))
    values = (beliefs, lambda: beliefs().difference[0], lambda: beliefs().value)
    return dict(zip(_EVERY, values, strict=True))


def missing_signals(owner: Owner, delayed: bool) -> Mapping[str, str]:
    """Return the names of absent signals, and the reason for their absence."""
    late = "is absent, because the network has a delay and"
    hidden = {name: f"signal {name!r} {late} {ONE_STEP}" for name in _AT_ONCE if delayed}
    why = (
        "is absent, because this batch does not compute it: a policy that reads beliefs must "
        "declare the attribute memory_owner = 'scheduler' or 'own'"
    )
    absent = _EVERY if owner == "own" else _OWN
    return {name: f"signal {name!r} {why}" for name in absent} | hidden
