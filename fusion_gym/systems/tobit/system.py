"""A linear plant and censored sensors, with nodes and a fusion centre.

Source: tobit_token_bucket (Chen, Han, Song and Zhang, Complex Eng. Syst. 4:19, 2024);
round_robin_tobit (Geng, Wang, Alsaadi, Alharbi and Cheng, 2020).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core.nature import AS_ASSUMED, Nature, true_noise
from fusion_gym.core.system import (
    Block,
    Signal,
    SignalArray,
    System,
    age_block,
    common_signals,
    numbered,
    sensed,
)
from fusion_gym.namespace import namespace
from fusion_gym.systems.linear_plant import LinearPlant, largest_ratio, variance_loss
from fusion_gym.systems.tobit.centre import Centre, CentrePrediction, Feedback

_TINY = float(np.finfo(float).tiny)  # stands for a variance of zero
_RANGE = 5.0  # whitened quantities and logarithms of variance ratios are clipped here


@dataclass(slots=True)
class CensoredState:
    """The state of N runs at one time; n states, l sensors, m components.

    ``truth`` (n, N) · ``measurement`` (l, m, N) · ``held`` (l, m, N), the last delivered
    measurement · ``age`` (l, N), steps since then · ``time`` (N,), the step in the episode ·
    ``prior_mean`` (n, N), ``prior_covariance`` (n, n, N), the centre's prediction · ``prediction``
    of the measurements · ``mean`` (n, N), ``covariance`` (n, n, N), the fused posterior ·
    ``departure`` (4, N) of the truth from the model, if any.
    """

    truth: Array
    measurement: Array
    held: Array
    age: Array
    time: Array
    prior_mean: Array
    prior_covariance: Array
    prediction: CentrePrediction | None
    mean: Array
    covariance: Array
    departure: Array | None = None


_OF_CENSORING = ("censored", "uncensored_probability")
_COMPONENTS = "(sensors, m, N)"
SIGNALS = (
    *common_signals(_COMPONENTS, measurement="the new censored measurement"),
    Signal("censored", "own", _COMPONENTS, "whether the component is at its threshold"),
    Signal("uncensored_probability", "centre", _COMPONENTS, "predicted P(uncensored)"),
)


@dataclass(frozen=True)
class CensoredSystem(System[CensoredState]):
    """A plant, censored sensors, and a centre with or without nodes.

    ``model`` is the plant that the filters assume. The true plant is ``plant``, modified by
    ``nature``, which also modifies the sensors.

    ``random_start`` draws the direction of the initial mean uniformly; the filters know it. For the
    oscillator that is a random phase. ``scale`` (n,) divides observed state estimates and
    ``reference`` (n,) observed variances. With ``known_start`` the estimate begins with the first
    measurement of every sensor.
    """

    plant: LinearPlant
    model: LinearPlant
    centre: Centre
    random_start: bool
    state_names: tuple[str, ...]
    scale: Array
    reference: Array
    nature: Nature = AS_ASSUMED
    known_start: bool = False
    signals = SIGNALS
    covariance_cycle = 1  # the recursion of the covariances does not depend on time
    extensions = ("state_weights", "with_model")

    def with_possible(self, state: CensoredState, possible: NDArray[np.bool_]) -> CensoredState:
        """See :class:`System`."""
        return replace(state, prediction=sensed(state.prediction)._replace(possible=possible))

    @property
    def numpy_only(self) -> str | None:
        """See :class:`System`."""
        return self.centre.numpy_only

    @property
    def sensor_count(self) -> int:
        """Number of sensors."""
        return self.centre.sensors.count

    @property
    def state_weights(self) -> Array:
        """Weights (n,) of the traces among the signals: all 1, a plain trace as in the papers."""
        return np.ones(self.plant.size)

    @property
    def noise_channels(self) -> int:
        """Normals of one step: process noise, then the sensors'."""
        return self.plant.noise_channels + self.centre.sensors.noise_channels

    @property
    def start_channels(self) -> int:
        """Normals of a start: direction, deviation, noise of the first measurement, nature's."""
        own = 2 * self.plant.size + self.centre.sensors.noise_channels
        return own + self.nature.channels

    def with_model(
        self,
        process_covariance: Array | None = None,
        measurement_variance: Array | None = None,
        information_shares: Array | None = None,
    ) -> CensoredSystem:
        """Return the system with other parameters of its filters; the truth stays.

        Arrays of JAX allow derivatives with respect to them.

        Args:
            process_covariance: W (n, n).
            measurement_variance: R (sensors, m).
            information_shares: (sensors,), of sum 1.
        """
        model, centre = self.model, self.centre
        if process_covariance is not None:
            model = replace(model, process_covariance=process_covariance[..., None])
        if measurement_variance is not None:
            variance = measurement_variance[..., None]
            deviation = namespace(variance).sqrt(variance)
            sensors = replace(centre.sensors, variance=variance, deviation=deviation)
            node: Any = cast(Any, centre).filter
            centre = replace(cast(Any, centre), filter=replace(node, sensors=sensors))
        if information_shares is not None:
            feedback = Feedback(information_shares[:, None])
            centre = replace(cast(Any, centre), feedback=feedback)
        return replace(self, model=model, centre=centre)

    def offers(self, capability: str) -> bool:
        """See :class:`System`; Kalman filters without censoring have a covariance cycle.

        With federated fusion, or one filter at the centre, the covariances are then the actual ones
        if ``model`` is the plant; with covariance intersection they are bounds.
        """
        if capability == "with_possible":
            return self.centre.reads_silence
        if capability == "covariance_cycle":
            return self.centre.predictable
        if capability == "single_deliveries":
            return self.centre.separable
        return super().offers(capability)

    @property
    def observation(self) -> tuple[Block, ...]:
        """Blocks of the observation, without the censoring blocks if nothing is censored."""
        sensors, nodes = self.centre.sensors, numbered(self.sensor_count)
        own = partial(Block, labels=(nodes, numbered(sensors.size)), node="own")
        new = partial(own, knowledge="own", limit=_RANGE)
        shared = partial(Block, labels=(self.state_names,), node="broadcast", limit=_RANGE)
        at_threshold = "whether the component is at its threshold"
        uncensored = "predicted probability that the component is not censored"
        moved = "new minus last delivered measurement, over two noise deviations"
        variance = "logarithm of the predicted variance over its open-loop mean"
        blocks = [
            new("whitened_innovation", "innovation over its predicted deviation", _whitened),
            new("censored", at_threshold, lambda s: sensors.censored(s.measurement), limit=None),
            new(
                "held_difference",
                moved,
                lambda s: (s.measurement - s.held) / (2.0 * sensors.deviation),
                constants={"two noise deviations": 2.0 * sensors.deviation[..., 0]},
            ),
            own(
                "uncensored_probability",
                uncensored,
                lambda s: sensed(s.prediction).expectation.uncensored_probability,
            ),
            age_block(nodes),
            shared(
                "log_variance",
                variance,
                self._log_variance,
                constants={"open-loop mean": self.reference},
            ),
            shared(
                "estimate",
                "prediction over the state's root mean square",
                lambda s: s.prior_mean / self.scale[:, None],
                constants={"root mean square": self.scale},
            ),
        ]
        if sensors.unlimited:  # these two would say nothing
            blocks = [block for block in blocks if block.name not in _OF_CENSORING]
        return tuple(blocks)

    @property
    def censored_beyond(self) -> dict[int, tuple[float, float]]:
        """Lowest and highest uncensored value of states, by their number, for pictures.

        It covers states that a sensor measures separately; the widest interval where sensors
        differ.
        """
        result: dict[int, tuple[float, float]] = {}
        sensors = self.centre.sensors
        rows = sensors.measurement_matrix[..., 0].reshape(-1, self.plant.size)
        limits = zip(sensors.threshold.ravel(), sensors.upper.ravel(), strict=True)
        for row, (low, high) in zip(rows, limits, strict=True):
            (states,) = np.nonzero(row)
            if len(states) == 1:
                state = int(states[0])
                ends = sorted((low / row[state], high / row[state]))
                before = result.get(state, (np.inf, -np.inf))
                result[state] = (min(before[0], ends[0]), max(before[1], ends[1]))
        return result

    def start(self, noise: Array) -> CensoredState:
        """Draw the initial state; every first measurement is known without charge."""
        n, sensors = self.plant.size, self.centre.sensors
        noise, departure = self.nature.begin(noise)
        xp, runs = namespace(noise), noise.shape[-1]
        mean = xp.array(np.broadcast_to(self.plant.initial_mean, (n, runs)))
        if self.random_start:
            direction = noise[:n] / linalg.dot(noise[:n], noise[:n]) ** 0.5
            mean = xp.sqrt(linalg.dot(mean, mean)) * direction
        truth = self.plant.start(mean, noise[n : 2 * n])
        own = true_noise(departure, noise[:0], noise[2 * n :])[1]
        measurement = sensors.measure(truth, own, departure)
        covariance = xp.array(np.broadcast_to(self.model.initial_covariance, (n, n, runs)))
        first = CensoredState(
            truth=truth,
            measurement=measurement,
            held=measurement,
            age=np.zeros((sensors.count, runs)),
            time=np.zeros(runs),
            prior_mean=mean,
            prior_covariance=covariance,
            prediction=None,
            mean=mean,
            covariance=covariance,
            departure=departure,
        )
        if not self.known_start:
            return first
        prediction = self.centre.predict(mean, covariance, measurement, first.time)
        everyone = xp.ones((sensors.count, runs), dtype=np.bool_)
        result = self.deliver(replace(first, prediction=prediction), everyone)
        return replace(result, prediction=None)

    def sense(self, state: CensoredState, noise: Array) -> CensoredState:
        """Move the plant, measure, and predict at centre and nodes.

        Source: tobit_token_bucket, equations (1), (2), (21), (23), (29).
        """
        r, departure = self.plant.noise_channels, state.departure
        process, own = true_noise(departure, noise[:r], noise[r:])
        truth = self.plant.advance(state.truth, process, departure)
        (prior_mean, prior_covariance), prediction = self.centre.advance(self.model, state)
        return replace(
            state,
            truth=truth,
            measurement=self.centre.sensors.measure(truth, own, departure),
            age=state.age + 1.0,
            time=state.time + 1.0,
            prior_mean=prior_mean,
            prior_covariance=prior_covariance,
            prediction=prediction,
        )

    def deliver(self, state: CensoredState, granted: NDArray[np.bool_]) -> CensoredState:
        """Update nodes and centre with the granted (sensors, N) measurements.

        Source: tobit_token_bucket, equations (20), (22), (30), (50).
        """
        prior, prediction = (state.prior_mean, state.prior_covariance), sensed(state.prediction)
        mean, covariance = self.centre.update(prior, prediction, state.measurement, granted)
        xp = namespace(granted)
        held = xp.where(granted[:, None], state.measurement, state.held)
        age = xp.where(granted, 0.0, state.age)
        return replace(state, held=held, age=age, mean=mean, covariance=covariance)

    def single_deliveries(self, state: CensoredState) -> tuple[Array, Array]:
        """See :class:`System`."""
        prior = state.prior_mean, state.prior_covariance
        return self.centre.single(prior, sensed(state.prediction), state.measurement)

    def read(self, state: CensoredState) -> Mapping[str, SignalArray | Callable[[], SignalArray]]:
        """Return the signals of ``SIGNALS``."""
        expectation, deviation = sensed(state.prediction)[:2]

        @functools.cache
        def variances() -> tuple[Array, Array]:
            prior = state.prior_mean, state.prior_covariance
            return self.centre.variances(prior, sensed(state.prediction), self.state_weights)

        return {
            "measurement": state.measurement,
            "innovation": lambda: state.measurement - expectation.value,
            "censored": lambda: self.centre.sensors.censored(state.measurement),
            "held": state.held,
            "age": state.age,
            "expected_measurement": expectation.value,
            "innovation_deviation": deviation,
            "uncensored_probability": expectation.uncensored_probability,
            "prior_mean": state.prior_mean,
            "prior_covariance": state.prior_covariance,
            "silent_variance": lambda: variances()[0],
            "variance_reduction": lambda: variances()[1],
        }

    def _log_variance(self, state: CensoredState) -> Array:
        variances = (linalg.diagonal(state.prior_covariance), self.reference[:, None])
        now, usual = (
            namespace(values).log(namespace(values).maximum(values, _TINY)) for values in variances
        )
        return now - usual

    def visible(self, state: CensoredState) -> CensoredState:
        """Return the state without the truth and its departure."""
        return replace(state, truth=np.full_like(state.truth, np.nan), departure=None)

    @property
    def imagination_channels(self) -> int:
        """Number of states."""
        return self.plant.size

    def imagine(
        self, state: CensoredState, mean: Array, covariance: Array, noise: Array
    ) -> CensoredState:
        """Return the state with a truth drawn from N(mean, covariance), without departure."""
        return replace(state, truth=linalg.draw_normal(mean, covariance, noise), departure=None)

    def adopt(
        self, state: CensoredState, mean: Array, covariance: Array, runs: NDArray[np.bool_]
    ) -> CensoredState:
        """Replace the estimate of the centre, and by feedback of the nodes, in ``runs`` (N,)."""
        return replace(
            state,
            mean=np.where(runs, mean, state.mean),
            covariance=np.where(runs, covariance, state.covariance),
        )

    def local_means(self, state: CensoredState) -> Array:
        """Return the nodes' posterior means (sensors, n, N) before the feedback."""
        if state.prediction is None:
            return np.broadcast_to(state.mean, (len(state.age), *state.mean.shape))
        prior, granted = (state.prior_mean, state.prior_covariance), state.age == 0.0
        return self.centre.local_means(prior, state.prediction, state.measurement, granted)

    def open_loop(self, horizon: int) -> Array:
        """Return the mean error variance (n,) of predictions over t = 1..horizon."""
        return self.plant.open_loop(horizon)

    def rounding(self, horizon: int) -> tuple[float, float]:
        """See :class:`System`."""
        sensors, size = self.centre.sensors, self.plant.size
        matrix, noise = sensors.measurement_matrix[..., 0], sensors.noise_covariance[..., 0]
        moments = self.plant.second_moments(horizon, self.random_start)
        signal = largest_ratio(moments, matrix / sensors.deviation)
        own = sensors.variance * np.eye(sensors.size)  # of single packets, then of all together
        groups = ((matrix, own), (matrix.reshape(-1, size), noise))
        loss = max(variance_loss(self.plant, horizon, *group) for group in groups)
        return signal, loss


def _whitened(state: CensoredState) -> Array:
    expectation, deviation = sensed(state.prediction)[:2]
    return (state.measurement - expectation.value) / deviation
