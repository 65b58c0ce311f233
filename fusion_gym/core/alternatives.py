"""What a step would have brought, had other requests been made on the same noise."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym.arrays import Array, take_runs
from fusion_gym.core.beliefs import Beliefs
from fusion_gym.core.runs import Branch, Outcome

_MOST_BITS = 62  # of a whole number that holds the sensors' grants and the run


class Alternatives(NamedTuple):
    """A steps that could have been taken in each of N runs.

    ``error`` (n, A, N) of the fused estimate, ``communication`` (A, N) the cost's term of the
    reward, ``observation`` (A, N, entries) float32 of the state that follows. Of an episode that
    has ended it is the state with which it would have gone on.
    """

    error: Array
    communication: Array
    observation: NDArray[np.float32]


def alternatives(
    before: Branch,
    requests: NDArray[np.bool_],
    noise: Array,
    taken: Outcome,
    observation: NDArray[np.float32],
    beliefs: Beliefs,
) -> Alternatives:
    """What each of the requests (A, sensors, N) would have brought to the runs of ``before``.

    On the standard normals (channels, N) on which the step was ``taken`` that led to what is
    observed, (N, entries), and to these ``beliefs``.
    Requests that the network would have answered alike are stepped once, those that it would have
    answered as in the step taken not at all. Nothing that is given moves.
    """
    many, sensors, runs = requests.shape
    values = np.tile(np.arange(runs), many)  # where each one's results are; first the taken ones
    granted = before.answer(requests.transpose(1, 0, 2).reshape(sensors, -1), values).granted
    other = np.flatnonzero((granted != np.tile(taken.granted, many)).any(0))
    error, communication = taken.error, taken.reward_communication
    if other.size:
        first = np.arange(other.size)
        if sensors + runs.bit_length() <= _MOST_BITS:
            codes = (1 << np.arange(sensors)) @ granted[:, other] * runs + other % runs
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
        observation = np.concatenate((observation, branch.observe()))
    return Alternatives(
        error[:, values].reshape(-1, many, runs),
        communication[values].reshape(many, runs),
        observation[values].reshape(many, runs, -1),
    )
