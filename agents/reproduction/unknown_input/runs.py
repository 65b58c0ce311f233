"""Runs of the unknown-input examples with all that the figures and claims need."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.systems.unknown_input.environment import UnknownInputOptions
from fusion_gym.systems.unknown_input.nodes import TableNodes
from fusion_gym.systems.unknown_input.system import UnknownInputSystem

PRINTED, CARTS = "paper", "two_carts"
EXAMPLES = (PRINTED, CARTS)
NAMES = {PRINTED: "the printed example", CARTS: "two carts"}
STEPS = 100
TRIGGER = "adaptive_threshold"


class Record(NamedTuple):
    """E episodes of H sampling instants, times first, episodes last.

    ``truth`` (H, s, E) of [x(k); d(k - 1)] · ``local`` (H, l, s, E) the nodes' estimates, ``fused``
    (H, s, E) · ``held`` (H, l, m, E) the last delivered measurements after the step · ``square``
    (H, l, E) |σ|² before it · ``granted`` (H, l, E).
    """

    truth: Array
    local: Array
    fused: Array
    held: Array
    square: Array
    granted: NDArray[np.bool_]

    @property
    def errors(self) -> Array:
        """Errors (H, l + 1, s, E), the fused estimate first."""
        every = np.concatenate((self.fused[:, None], self.local), axis=1)
        return self.truth[:, None] - every


def make_example(**options: Any) -> tuple[Task, UnknownInputSystem]:
    """The task of these options with its system."""
    task = fusion_gym.make_task(UnknownInputOptions(horizon=STEPS, **options))
    assert isinstance(task.system, UnknownInputSystem)
    return task, task.system


def tables(system: UnknownInputSystem) -> TableNodes:
    """The nodes of a system with the paper's filter."""
    assert isinstance(system.nodes, TableNodes)
    return system.nodes


def record_run(task: Task, policy: str, episodes: int, seed: int) -> Record:
    """Run a policy and keep what the figures show."""
    rule = fusion_gym.make_policy(policy, task)
    batch = EpisodeBatch.seeded(task, episodes, seed)
    rule.reset(episodes, seed)
    rows: dict[str, list[NDArray[Any]]] = {name: [] for name in Record._fields}
    for _ in range(task.horizon):
        apart = batch.state.measurement - batch.state.held
        outcome = batch.step(rule(batch.signals()))
        state = batch.delivered
        for name, value in (
            ("truth", state.truth),
            ("local", state.estimates.mean),
            ("fused", state.estimates.fused_mean),
            ("held", state.held),
            ("square", (apart**2).sum(1)),
            ("granted", outcome.granted),
        ):
            rows[name].append(np.array(value))
    return Record(**{name: np.array(row) for name, row in rows.items()})


def halves(value: Array, states: int, axis: int) -> Array:
    """Sums over the states and over the inputs, stacked along ``axis`` in the place of both."""
    first, last = np.split(value, [states], axis=axis)
    return np.stack((first.sum(axis), last.sum(axis)), axis=axis)


def leading(errors: Array, bounds: Array) -> Array:
    """How far errors (H, n, E) fill their bounds (n, n, H): sample (E,) in the worst direction.

    The errors are whitened with the bounds, 1 is what a bound allows; the direction is that in
    which they are largest over all times and episodes.
    """
    root = np.linalg.inv(np.linalg.cholesky(np.moveaxis(bounds, -1, 0)))
    z = root @ errors
    moment = np.einsum("hie,hje->ije", z, z) / len(z)
    direction = np.linalg.eigh(moment.mean(-1))[1][:, -1]
    return np.einsum("i,ije,j->e", direction, moment, direction)
