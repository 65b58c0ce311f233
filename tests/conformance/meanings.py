"""What the name of every observation block says, computed from signals by formulas of its own.

A block of a registered environment without a formula here fails the tests: bring one. Each takes
what there is to see of a batch and returns the entries (…, N), not yet clipped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.system import Signals

Array = NDArray[np.float64]


class Seen(NamedTuple):
    """A batch's system and state before a step, all its signals, and the state delivered last."""

    batch: EpisodeBatch
    system: Any
    state: Any
    last: Any
    signals: Signals

    @classmethod
    def of(cls, batch: EpisodeBatch) -> Seen:
        """Everything, whatever the task's information."""
        system = batch.task.system
        signals = Signals(dict(system.read(batch.state)))
        return cls(batch, system, batch.state, batch.delivered, signals)

    @property
    def open_loop(self) -> Array:
        """Open-loop variances (n, 1)."""
        return self.system.open_loop(self.batch.task.horizon)[:, None]

    @property
    def time(self) -> NDArray[np.int64]:
        """Sampling instants since the start, (N,)."""
        return self.batch.steps + 1


Formula = Callable[[Seen], Any]


def variances(covariance: Array) -> Array:
    """Diagonals (…, n, N) of covariances (…, n, n, N)."""
    return np.einsum("...iir->...ir", covariance)


def logarithm(ratio: Array) -> Array:
    """Of a ratio of deviations, from one of variances."""
    return np.log(np.sqrt(ratio))


def whitened(see: Seen) -> Array:
    """Innovations (sensors, …, N) in their deviations."""
    return see.signals["innovation"] / see.signals["innovation_deviation"]


def sampled(see: Seen) -> Any:
    """Whether the instant is one of the sensor's."""
    return see.time % see.system.sensors.period == 0


def phase(see: Seen) -> Any:
    """What is left of the instant after whole periods."""
    periods = see.time / see.system.sensors.period
    return periods - np.floor(periods)


def fused_innovation(see: Seen) -> Array:
    """Against the fused prediction; the measurement noise contains the plant's."""
    sensors = see.system.filter.sensors
    h, s = sensors.measurement_matrix[..., 0], sensors.cross_covariance[..., 0]
    crossed = 2.0 * np.einsum("smi,sim->sm", h, s)
    own = np.einsum("ssmm->sm", sensors.covariance[..., 0])
    spread = np.einsum("smi,ijr,smj->smr", h, see.signals["prior_covariance"], h)
    expected = np.einsum("smi,ir->smr", h, see.signals["prior_mean"])
    deviation = np.sqrt(spread + (crossed + own)[..., None])
    return (see.signals["measurement"] - expected) / deviation


def node_innovation(see: Seen) -> Array:
    """What the node's filter was surprised by, in the deviation of its tables."""
    tables, sensors = see.system.filters, range(see.system.sensor_count)
    at = tables.at(see.time)
    each = [tables.innovation_covariance[i, i][at] for i in sensors]
    return see.state.innovation / np.sqrt(np.array(each))


def copy_deviation(see: Seen) -> Array:
    """The copy's error is the node's plus the lag, which is orthogonal to it."""
    node = np.einsum("iidd...->id...", see.state.prediction.local)
    return logarithm((node + see.signals["innovation_deviation"] ** 2) / see.open_loop)


def mode_probability(see: Seen) -> Array:
    """The chain moves the probabilities that the last delivery left."""
    plant = see.system.plant
    before = plant.initial_probabilities[:, None] if see.last is None else see.last.belief[0]
    moved: Array = plant.mode_transition.T @ before
    return np.broadcast_to(moved, (plant.modes, see.batch.num_envs))


def central_difference(see: Seen) -> Array:
    """New minus held."""
    moved = see.signals["measurement"] - see.signals["held"]
    return moved[:, 0] / see.system.scale[:, None]


def node_prior(see: Seen) -> Array:
    """Variances (l, s, N) of the nodes' predictions, the runs' own or from the tables."""
    nodes, own = see.system.nodes, see.state.prediction.covariance
    if own is None:
        own = nodes.prior[..., np.minimum(see.time, nodes.prior.shape[-1] - 1)]
    return variances(own)


def last_fused(see: Seen) -> Array:
    """Variances (s, N) of the last fused estimate, at the start of the initial one."""
    nodes, runs = see.system.nodes, see.batch.num_envs
    if see.last is not None:
        return variances(see.system.fused(see.last)[1])
    tables = getattr(nodes, "fused", None)
    first = nodes.model.initial_covariance if tables is None else tables[..., :1]
    return np.broadcast_to(variances(first), (first.shape[0], runs))


def predicted_with_input(see: Seen) -> Array:
    """The state's prediction, and the last input as the model remembers it."""
    state, model = see.signals["prior_mean"], see.system.nodes.model
    last = model.initial_mean if see.last is None else see.system.fused(see.last)[0]
    inputs = np.broadcast_to(model.memory * last[len(state) :], (len(model.memory), state.shape[1]))
    return np.concatenate((state, inputs)) / see.system.magnitude[:, None]


def censored(see: Seen) -> Any:
    """At one of the thresholds, or beyond it where the sensors' are not those that are assumed."""
    sensors, y = see.system.centre.sensors, see.signals["measurement"]
    return (y <= sensors.threshold) | (y >= sensors.upper)


def noise_variances(see: Seen) -> Array:
    """(sensors, m, 1) of the sensors' noise."""
    if hasattr(see.system, "nodes"):
        return variances(see.system.nodes.sensors.covariance)
    return see.system.centre.sensors.variance


def age(see: Seen) -> Array:
    """1 - 10/(a + 10) of the age."""
    return 1.0 - 10.0 / (see.signals["age"] + 10.0)


def fused_deviation(see: Seen) -> Array:
    """Of the fused prediction, over open loop."""
    return logarithm(variances(see.signals["prior_covariance"]) / see.open_loop)


def fused_estimate(see: Seen) -> Array:
    """The fused prediction in root mean squares."""
    return see.signals["prior_mean"] / see.system.magnitude[:, None]


def held_difference(see: Seen) -> Array:
    """New minus held, in deviations of two noises (censored sensors: in two deviations)."""
    noises = 2.0 if hasattr(see.system, "nodes") else 4.0
    moved = see.signals["measurement"] - see.signals["held"]
    return moved / np.sqrt(noises * noise_variances(see))


def arrival(see: Seen) -> Any:
    """Probability (sensors, N) that a packet sent now arrives."""
    channel = getattr(see.system, "channel", None)
    if channel is None or not channel.loses:
        return 1.0
    kept = channel.transition @ (1.0 - channel.drop)  # (states before, sensors)
    each = [[kept[before, s] for before in row] for s, row in enumerate(see.state.channel)]
    return np.array(each)


def delivered(system: Any, state: Any, *sensors: int) -> Array:
    """The centre's mean (n, N) after these packets, none of which is lost."""
    if hasattr(state, "lost"):
        state = replace(state, lost=np.zeros_like(state.lost))
    granted = np.zeros((system.sensor_count, system.truth(state).shape[-1]), dtype=np.bool_)
    granted[list(sensors)] = True
    mean: Array = system.fused(system.deliver(state, granted))[0]
    return mean


def remembered(see: Seen) -> Array:
    """x* (n, N): with the shadow, or where packets hold all that was measured, without."""
    everyone = range(see.system.sensor_count)
    if see.batch.task.shadow is None:
        return delivered(see.system, see.state, *everyone)
    shadows: Any = see.batch.shadows
    return delivered(see.batch.task.shadow, shadows.every, *everyone)


def belief_difference(see: Seen) -> Array:
    """x* - x̂ in open-loop deviations, as ln(z + √(z² + 1)) of four times that."""
    apart = remembered(see) - delivered(see.system, see.state)
    z = np.abs(4.0 * apart / np.sqrt(see.open_loop))
    return np.sign(apart) * np.log(z + np.sqrt(z * z + 1.0))


def transmission_value(see: Seen) -> Array:
    """For nobody and for each sensor; a packet with an estimate leaves nothing."""
    weights = see.batch.task.reward.state_weights
    weights = weights / weights.mean()
    best, sensors = remembered(see), range(see.system.sensor_count)

    def left(mean: Array) -> Array:
        squared: Array = np.einsum("i,ir->r", weights[:, 0], (best - mean) ** 2)
        return squared

    silent = left(delivered(see.system, see.state))
    after = np.array([left(delivered(see.system, see.state, s)) for s in sensors])
    if see.batch.task.packet == "estimate":
        after = np.zeros_like(after)
    every = np.concatenate((silent[None], arrival(see) * (silent - after)))
    return 2.0 * np.sign(every) * np.sqrt(np.abs(every) / (weights * see.open_loop).sum())


NETWORK: dict[str, Formula] = {
    "tokens": lambda see: see.batch.tokens / see.batch.task.bucket.capacity,
    "admitted": lambda see: see.batch.admitted(),
    "time_left": lambda see: 1.0 - see.batch.steps / see.batch.task.horizon,
    "price": lambda see: (
        np.log(see.batch.price / see.batch.task.reward.price.span[0])
        / np.diff(np.log(see.batch.task.reward.price.span))
    ),
}
MEMORY: dict[str, Formula] = {
    "belief_difference": belief_difference,
    "transmission_value": transmission_value,
}
# By the class of the system.
FORMULAS: dict[str, dict[str, Formula]] = {
    "CensoredSystem": {
        "whitened_innovation": whitened,
        "censored": censored,
        "held_difference": held_difference,
        "uncensored_probability": lambda see: see.signals["uncensored_probability"],
        "age": age,
        "log_variance": lambda see: (
            2.0
            * logarithm(variances(see.signals["prior_covariance"]) / see.system.reference[:, None])
        ),
        "estimate": lambda see: see.signals["prior_mean"] / see.system.scale[:, None],
    },
    "CorrelatedTrackingSystem": {
        "whitened_innovation": whitened,
        "fused_innovation": fused_innovation,
        "age": age,
        "local_log_deviation": lambda see: logarithm(
            variances(see.state.prior_covariance[1:]) / see.open_loop
        ),
        "log_deviation": fused_deviation,
        "estimate": fused_estimate,
    },
    "MarkovJumpSystem": {
        "whitened_difference": whitened,
        "whitened_innovation": node_innovation,
        "sampled": sampled,
        "phase": phase,
        "age": age,
        "local_log_deviation": lambda see: logarithm(
            see.signals["local_variance"] / see.open_loop.sum()
        ),
        "copy_log_deviation": copy_deviation,
        "log_deviation": fused_deviation,
        "estimate": fused_estimate,
    },
    "MarkovJumpCentralSystem": {
        "whitened_innovation": lambda see: whitened(see)[:, 0],
        "difference": central_difference,
        "sampled": sampled,
        "phase": phase,
        "age": age,
        "innovation_log_deviation": lambda see: np.log(
            see.signals["innovation_deviation"][:, 0] / see.system.scale[:, None]
        ),
        "log_deviation": fused_deviation,
        "estimate": fused_estimate,
        "mode_probability": mode_probability,
    },
    "UnknownInputSystem": {
        "whitened_innovation": whitened,
        "held_difference": held_difference,
        "age": age,
        "local_log_deviation": lambda see: logarithm(node_prior(see) / see.open_loop),
        "log_deviation": lambda see: logarithm(last_fused(see) / see.open_loop),
        "estimate": predicted_with_input,
    },
    "RemoteEstimationSystem": {
        "error": lambda see: see.signals["innovation"][:, 0] / see.system.error_scale[:, None],
        "age": age,
        "channel": lambda see: np.stack(
            [see.signals["channel_state"] == kind for kind in (0, 1)], axis=1
        ),
    },
    "RandomWalk": {
        "surprise": lambda see: whitened(see)[:, 0],
        "age": age,
        "spread": lambda see: np.log(see.signals["prior_covariance"][0, 0] / see.system.q) / 10.0,
    },
}


def formula(system: Any, name: str) -> Formula:
    """The formula of a block of a system, of the network, or of what is remembered.

    Raises:
        LookupError: there is none; write one.
    """
    known = NETWORK | MEMORY | FORMULAS.get(type(system).__name__, {})
    if name not in known:
        raise LookupError(f"no formula for block {name!r} of {type(system).__name__}")
    return known[name]
