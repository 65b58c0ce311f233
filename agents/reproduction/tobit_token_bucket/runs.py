"""Episodes of the token-bucket paper with everything that its figures show."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.system import Signals
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Policy, Requests
from fusion_gym.policies.rules.dynamic_event import DynamicEvent
from fusion_gym.systems.tobit.oscillator import TobitOscillatorOptions

TRIGGER = "dynamic_event"
SENSORS = 3


class History(NamedTuple):
    """E episodes of H steps; t = 1..H first, episodes last.

    ``truth`` (H, n, E) · ``measurement`` (H, l, m, E), censored · ``held`` (H, l, m, E), what the
    filters have of it after the step, and ``held_before`` · ``requested``, ``granted`` (H, l, E) ·
    ``tokens`` (H, E) after the step, ``tokens_before`` · ``prior_mean`` (H, n, E) and
    ``prior_covariance`` (H, n, n, E) of the centre · ``uncensored`` and ``hazard`` (H, l, m, E),
    q and λ of the prediction · ``local_mean`` (H, l, n, E), ``local_bound`` (H, l, n, n, E) of the
    nodes before the feedback · ``mean`` (H, n, E), ``bound`` (H, n, n, E) fused.
    """

    truth: Array
    measurement: Array
    held: Array
    held_before: Array
    requested: NDArray[np.bool_]
    granted: NDArray[np.bool_]
    tokens: Array
    tokens_before: Array
    prior_mean: Array
    prior_covariance: Array
    uncensored: Array
    hazard: Array
    local_mean: Array
    local_bound: Array
    mean: Array
    bound: Array

    @property
    def local_error(self) -> Array:
        """The nodes' squared errors eᵀe (H, l, E)."""
        return np.square(self.truth[:, None] - self.local_mean).sum(2)

    @property
    def fused_error(self) -> Array:
        """The centre's squared error (H, E)."""
        return np.square(self.truth - self.mean).sum(1)

    @property
    def local_trace(self) -> Array:
        """Traces (H, l, E) of the nodes' bounds."""
        return np.trace(self.local_bound, axis1=2, axis2=3)

    @property
    def fused_trace(self) -> Array:
        """Trace (H, E) of the fused bound."""
        return np.trace(self.bound, axis1=1, axis2=2)


@dataclass
class Failing:
    """The paper's trigger, but one sensor never sends: it has failed."""

    policy: Policy
    sensor: int
    knowledge: Any = "own_memory"

    def reset(self, runs: int, seed: int = 0) -> None:
        """Forget everything."""
        self.policy.reset(runs, seed)

    def __call__(self, signals: Signals) -> Requests:
        """The trigger's requests, without those of the failed sensor."""
        requests = self.policy(signals).copy()
        requests[self.sensor] = False
        return requests


def scheme(**options: Any) -> Task:
    """The paper's example with other ``options`` where they are named."""
    return fusion_gym.make_task(TobitOscillatorOptions(**options))


def single_sensor(sensor: int) -> Task:
    """A sensor whose filter works by itself, with its third of the bucket and no feedback."""
    options, trigger = TobitOscillatorOptions(), DynamicEvent()
    return scheme(
        measurement_matrices=(np.eye(2).tolist(),),
        token_rate=options.token_rate / SENSORS,
        token_capacity=options.token_capacity / SENSORS,
        initial_tokens=options.initial_tokens / SENSORS,
        trigger_threshold=trigger.column("threshold", SENSORS)[sensor],
        trigger_decay=trigger.column("decay", SENSORS)[sensor],
    )


def record_history(task: Task, episodes: int, seed: int, policy: Policy | None = None) -> History:
    """Run the paper's trigger, or another policy, and keep everything."""
    policy = fusion_gym.make_policy(TRIGGER, task) if policy is None else policy
    batch = EpisodeBatch.seeded(task, episodes, seed)
    policy.reset(episodes, seed)
    rows: dict[str, list[NDArray[Any]]] = {name: [] for name in History._fields}
    for _ in range(task.horizon):
        before, tokens = batch.state, batch.tokens
        outcome = batch.step(policy(batch.signals()))
        state = batch.delivered
        planned, expected = state.prediction.outcomes, state.prediction.expectation
        values = {
            "truth": state.truth,
            "measurement": state.measurement,
            "held": state.held,
            "held_before": before.held,
            "requested": outcome.requested,
            "granted": outcome.granted,
            "tokens": batch.tokens,
            "tokens_before": tokens,
            "prior_mean": state.prior_mean,
            "prior_covariance": state.prior_covariance,
            "uncensored": expected.uncensored_probability,
            "hazard": expected.hazard,
            "local_mean": state.local_mean,
            "local_bound": np.where(
                outcome.granted[:, None, None],
                planned.delivered_covariance,
                planned.silent_covariance,
            ),
            "mean": state.mean,
            "bound": state.covariance,
        }
        for name, value in values.items():
            rows[name].append(np.array(value))
    return History(**{name: np.array(row) for name, row in rows.items()})
