"""The outcomes of a step for alternative requests on the same noise."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array, take_runs
from fusion_gym.core.beliefs import Beliefs
from fusion_gym.core.runs import Branch, Outcome

_MOST_BITS = 62  # of an integer that encodes grants and run


class Alternatives(NamedTuple):
    """The outcomes of A alternative decisions in each of N runs.

    Attributes:
        error: Truth minus fused estimate (n, A, N).
        communication: Token term of the reward (A, N).
        observation: (A, N, entries) float32 of the next state, which for an ended episode is the
            state without a reset.
    """

    error: Array
    communication: Array
    observation: NDArray[np.float32]


def alternatives(
    before: Branch,
    requests: NDArray[Any],
    noise: Array,
    taken: Outcome,
    observation: NDArray[np.float32],
    beliefs: Beliefs,
    local: bool = False,
) -> Alternatives:
    """Return the outcomes of alternative requests; equal grants share one simulated step.

    Args:
        before: Runs before the step; they remain unchanged.
        requests: (A, sensors, N), the alternatives, bool or channels of an assignment.
        noise: Standard normals (channels, N) of the step.
        taken: Outcome of the step with the actual requests.
        observation: Observations (N, entries) after that step.
        beliefs: Beliefs after that step.
        local: Whether observations have what the sensors suppose.
    """
    many, sensors, runs = requests.shape
    values = np.tile(np.arange(runs), many)  # columns of results, the taken step first
    each = requests.transpose(1, 0, 2).reshape(sensors, -1)
    granted, base = before.answer(each, values).granted, 2
    other = np.flatnonzero((granted != np.tile(taken.granted, many)).any(0))
    if each.dtype != np.bool_:  # channels, which the outcome does not have
        granted, base, other = granted * each, before.task.network.slots + 1, np.arange(values.size)
    error, communication = taken.error, taken.reward_communication
    if other.size:
        first = np.arange(other.size)
        if sensors * (base - 1).bit_length() + runs.bit_length() <= _MOST_BITS:
            codes = base ** np.arange(sensors) @ granted[:, other] * runs + other % runs
            _, first, place = np.unique(codes, return_index=True, return_inverse=True)
            values[other] = runs + place
        else:
            values[other] = runs + first
        places = other[first]
        run, sent = places % runs, granted[:, places]
        if before.memory.keeps_every:
            branch = before.branch_memory(run)
            outcome = branch.step(sent, noise[:, run], take_runs(beliefs.best, run))
        else:
            branch = before.branch(run)
            outcome = branch.step(sent, noise[:, run])
        error = np.concatenate((error, outcome.error), axis=-1)
        communication = np.concatenate((communication, outcome.reward_communication))
        observation = np.concatenate((observation, branch.observe(local)))
    return Alternatives(
        error[:, values].reshape(-1, many, runs),
        communication[values].reshape(many, runs),
        observation[values].reshape(many, runs, -1),
    )
