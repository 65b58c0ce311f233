"""Runs of the tracking example side by side: several policies and noise scales on one noise."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.runs import Outcome
from fusion_gym.core.system import Signals
from fusion_gym.policies.rules.adaptive_innovation import AdaptiveInnovation
from fusion_gym.systems.correlated.environment import CorrelatedTrackingOptions
from fusion_gym.systems.correlated.system import CorrelatedTrackingState, CorrelatedTrackingSystem

STEPS = 600
SENSORS = ("sensor 1", "sensor 2", "sensor 3")
STATES = ("position", "velocity", "acceleration")
UNITS = ("m", "m/s", "m/s²")
SCALES = (0.8, 0.6, 0.4)  # the three sets of actual variances, over their bounds

# Signals and the trigger's requests (sensors, N) to the requests of the same runs.
Ask = Callable[[Signals, NDArray[np.bool_]], NDArray[np.bool_]]


class Lane(NamedTuple):
    """A setting in which every episode is run: actual over bound variances, who requests.

    ``ask`` instead of the trigger's own requests; ``known_start`` puts x(0) at its mean.
    """

    scale: float = 1.0
    ask: Ask | None = None
    known_start: bool = False


def always(signals: Signals, event: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Every sensor, at every step."""
    return np.ones_like(event)


@dataclass(frozen=True, kw_only=True)
class SideBySide(CorrelatedTrackingSystem):
    """The system with a noise scale for each run, (N,), and runs that begin at the mean, (N,)."""

    scales: Array
    known_start: NDArray[np.bool_]

    def _scale(self, noise: Array) -> Array:
        return self.scales

    def start(self, noise: Array) -> CorrelatedTrackingState:
        """Time 0, as in the system itself but for the runs that begin at the mean."""
        state = super().start(noise)
        truth = np.where(self.known_start, state.mean[0], state.truth)
        return replace(state, truth=truth)


class Step(NamedTuple):
    """A step of all lanes: ``state`` after the delivery, ``outcome`` the network's answer."""

    number: int
    state: CorrelatedTrackingState
    outcome: Outcome
    innovation: Array  # (sensors, N)


def steps(
    lanes: list[Lane], episodes: int, seed: int, fusion: str, track_actual: bool
) -> Iterator[Step]:
    """The paper's example, each lane with the same episodes, one lane after another along N."""
    options = CorrelatedTrackingOptions(horizon=STEPS, fusion=fusion, track_actual=track_actual)
    task = fusion_gym.make_task(options)
    system = SideBySide(
        **vars(task.system),
        scales=np.repeat([lane.scale for lane in lanes], episodes),
        known_start=np.repeat([lane.known_start for lane in lanes], episodes),
    )
    batch = EpisodeBatch(replace(task, system=system), len(lanes) * episodes)
    runs = np.arange(batch.num_envs)
    batch.seed(runs, (seed + runs % episodes).tolist())
    batch.reset()
    trigger = fusion_gym.make_policy("adaptive_innovation", task)
    trigger.reset(batch.num_envs, seed)
    for number in range(STEPS):
        signals = batch.signals()
        innovation = signals["innovation"][:, 0].copy()
        event = trigger(signals)
        requests = event.copy()
        for place, lane in enumerate(lanes):
            if lane.ask is not None:
                own = slice(place * episodes, (place + 1) * episodes)
                requests[:, own] = lane.ask(signals, event)[:, own]
        outcome = batch.step(requests)
        yield Step(number, batch.delivered, outcome, innovation)


def of_other_episodes(episodes: int) -> Ask:
    """What the trigger requests in the next episode of the first lane.

    The same rates and patterns of requests, but independent of the episode's own noise.
    """

    def ask(signals: Signals, event: NDArray[np.bool_]) -> NDArray[np.bool_]:
        others = np.roll(event[:, :episodes], -1, axis=1)
        return np.tile(others, event.shape[1] // episodes)

    return ask


def innovation_thresholds(
    rule: AdaptiveInnovation, innovation: Array, requested: NDArray[np.bool_]
) -> Array:
    """Thresholds (H, sensors, N) that were in force at the requests of a run, times first."""
    last = np.zeros(innovation.shape[1:])
    values = np.empty(innovation.shape)
    for step, (size, requests) in enumerate(zip(np.abs(innovation), requested, strict=True)):
        values[step] = rule.threshold_after(last)
        last = np.where(requests, size, last)
    return values
