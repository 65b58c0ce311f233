"""Censored sensors, local Tobit filters, federated fusion with feedback.

Source: tobit_token_bucket (Chen, Han, Song and Zhang, Complex Eng. Syst. 4:19, 2024).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.filters import Expectation, NodeFilter, Plan
from fusion_gym.fusion import FederatedFusion
from fusion_gym.plants import LinearPlant
from fusion_gym.systems.base import Feature, Signal, SignalArray
from fusion_gym.validation import Array

_WHITE = 5.0  # whitened quantities are clipped at this many standard deviations
_LOG_RANGE = 5.0  # log variance ratios are clipped here: starved bounds grow as 1.25^t


@dataclass(slots=True)
class FederatedTobitState:
    """Everything about N runs at one time; shapes with n states, l sensors, m components.

    ``truth`` (n, N) · ``measurement`` (l, m, N) · ``held`` (l, m, N), the last delivered
    measurement · ``age`` (l, N), steps since then · ``time`` (N,), the step in the episode ·
    ``prior_mean`` (n, N), ``prior_covariance`` (n, n, N), the centre's prediction · the
    expectation and plan of the nodes (see :mod:`fusion_gym.filters.base`) · ``local_mean``
    (l, n, N), ``local_covariance`` (l, n, n, N), the nodes' posterior before the feedback ·
    ``mean`` (n, N), ``covariance`` (n, n, N), the fused posterior.
    """

    truth: Array
    measurement: Array
    held: Array
    age: Array
    time: Array
    prior_mean: Array
    prior_covariance: Array
    expectation: Expectation | None
    plan: Plan | None
    local_mean: Array
    local_covariance: Array
    mean: Array
    covariance: Array


_COMPONENTS = "(sensors, m, N)"
SIGNALS = (
    Signal("measurement", "sensor", _COMPONENTS, "the new censored measurement"),
    Signal("innovation", "sensor", _COMPONENTS, "measurement minus its expectation"),
    Signal("censored", "sensor", _COMPONENTS, "whether the component is at its threshold"),
    Signal("held", "centre", _COMPONENTS, "the last delivered measurement"),
    Signal("age", "centre", "(sensors, N)", "steps since the last delivery"),
    Signal("expected_measurement", "centre", _COMPONENTS, "the measurement's expectation"),
    Signal("innovation_deviation", "centre", _COMPONENTS, "the innovation's predicted deviation"),
    Signal("uncensored_probability", "centre", _COMPONENTS, "predicted, from 0 to 1"),
    Signal("prior_mean", "centre", "(n, N)", "the centre's prediction"),
    Signal("prior_covariance", "centre", "(n, n, N)", "its covariance"),
    Signal("silent_variance", "centre", "(N,)", "fused trace if nobody transmits"),
    Signal(
        "variance_reduction",
        "centre",
        "(sensors, N)",
        "how far that trace falls if this sensor alone transmits, whatever it measured",
    ),
)


@dataclass(frozen=True)
class FederatedTobitSystem:
    """Joins a plant, censored sensors, one node filter for each, and federated fusion.

    ``random_start`` draws the initial mean, known to the filters, in a uniformly random direction
    with the length of the plant's initial mean; for the oscillator that is a random phase.
    ``scale`` (n,) are the magnitudes by which observed state estimates are divided, and
    ``reference`` (n,) the variances against which observed variances are taken.
    """

    plant: LinearPlant
    filter: NodeFilter
    fusion: FederatedFusion
    random_start: bool
    state_names: tuple[str, ...]
    scale: Array
    reference: Array

    @property
    def sensor_count(self) -> int:
        """Number of sensors."""
        return self.filter.sensors.count

    @property
    def noise_channels(self) -> int:
        """Normals of one step: process noise, then the sensors' noises."""
        return self.plant.noise_channels + self.filter.sensors.noise_channels

    @property
    def start_channels(self) -> int:
        """Normals of a start: its direction, its deviation, the noise of the first measurement."""
        return 2 * self.plant.size + self.filter.sensors.noise_channels

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The signals that :meth:`read` offers."""
        return SIGNALS

    @property
    def features(self) -> tuple[tuple[Feature, ...], ...]:
        """Blocks of the observation; see docs/tobit_oscillator.md."""
        sensors, size = self.sensor_count, self.filter.sensors.size

        def block(kind: str, knowledge: str, low: float, high: float) -> tuple[Feature, ...]:
            return tuple(
                Feature(f"{kind}[{s},{c}]", knowledge, low, high)  # type: ignore[arg-type]
                for s in range(sensors)
                for c in range(size)
            )

        return (
            block("whitened_innovation", "sensor", -_WHITE, _WHITE),
            block("censored", "sensor", 0.0, 1.0),
            block("held_difference", "sensor", -_WHITE, _WHITE),
            block("uncensored_probability", "centre", 0.0, 1.0),
            tuple(Feature(f"age[{s}]", "centre", 0.0, 1.0) for s in range(sensors)),
            tuple(
                Feature(f"log_variance[{name}]", "centre", -_LOG_RANGE, _LOG_RANGE)
                for name in self.state_names
            ),
            tuple(
                Feature(f"estimate[{name}]", "centre", -_WHITE, _WHITE) for name in self.state_names
            ),
        )

    def start(self, noise: Array) -> FederatedTobitState:
        """Time 0: the state is drawn and every first measurement is known, free of charge."""
        n, sensors = self.plant.size, self.filter.sensors
        mean = np.broadcast_to(self.plant.initial_mean, (n, noise.shape[-1])).copy()
        if self.random_start:
            direction = noise[:n] / np.sqrt(linalg.dot(noise[:n], noise[:n]))
            mean = np.sqrt(linalg.dot(mean, mean)) * direction
        truth = self.plant.start(mean, noise[n : 2 * n])
        measurement = sensors.measure(truth, noise[2 * n :])
        runs = noise.shape[-1]
        covariance = np.broadcast_to(self.plant.initial_covariance, (n, n, runs)).copy()
        nodes_mean, nodes_covariance = self.fusion.distribute(mean, covariance)
        return FederatedTobitState(
            truth=truth,
            measurement=measurement,
            held=measurement,
            age=np.zeros((sensors.count, runs)),
            time=np.zeros(runs),
            prior_mean=mean,
            prior_covariance=covariance,
            expectation=None,
            plan=None,
            local_mean=nodes_mean.copy(),
            local_covariance=nodes_covariance,
            mean=mean,
            covariance=covariance,
        )

    def sense(self, state: FederatedTobitState, noise: Array) -> FederatedTobitState:
        """The plant moves, the sensors measure, centre and nodes predict.

        Source: tobit_token_bucket, equations (1), (2), (21), (23), (29).
        """
        r = self.plant.noise_channels
        truth = self.plant.advance(state.truth, noise[:r])
        prior_mean, prior_covariance = self.plant.predict(state.mean, state.covariance)
        nodes = self.fusion.distribute(prior_mean, prior_covariance)
        expectation = self.filter.expect(nodes[0])
        time = state.time + 1.0
        return FederatedTobitState(
            truth=truth,
            measurement=self.filter.sensors.measure(truth, noise[r:]),
            held=state.held,
            age=state.age + 1.0,
            time=time,
            prior_mean=prior_mean,
            prior_covariance=prior_covariance,
            expectation=expectation,
            plan=self.filter.plan(*nodes, expectation, state.held, time),
            local_mean=state.local_mean,
            local_covariance=state.local_covariance,
            mean=state.mean,
            covariance=state.covariance,
        )

    def deliver(
        self, state: FederatedTobitState, granted: NDArray[np.bool_]
    ) -> FederatedTobitState:
        """The nodes take the planned outcome of the network's answer, the centre fuses.

        Source: tobit_token_bucket, equations (20), (22), (30), (50).
        """
        expectation, plan = _sensed(state)
        innovation = state.measurement - expectation.value
        update = linalg.matvec(linalg.transpose(plan.correction), innovation)
        grant = granted[:, None]
        local_mean = np.where(grant, state.prior_mean + update, plan.silent_mean)
        local_covariance = np.where(
            grant[:, None], plan.delivered_covariance, plan.silent_covariance
        )
        mean, covariance = self.fusion.fuse(local_mean, local_covariance)
        return FederatedTobitState(
            truth=state.truth,
            measurement=state.measurement,
            held=np.where(grant, state.measurement, state.held),
            age=np.where(granted, 0.0, state.age),
            time=state.time,
            prior_mean=state.prior_mean,
            prior_covariance=state.prior_covariance,
            expectation=expectation,
            plan=plan,
            local_mean=local_mean,
            local_covariance=local_covariance,
            mean=mean,
            covariance=covariance,
        )

    def read(
        self, state: FederatedTobitState
    ) -> Mapping[str, SignalArray | Callable[[], SignalArray]]:
        """The signals named in ``SIGNALS``."""
        expectation, plan = _sensed(state)
        threshold = self.filter.sensors.threshold
        return {
            "measurement": state.measurement,
            "innovation": lambda: state.measurement - expectation.value,
            "censored": lambda: state.measurement <= threshold,
            "held": state.held,
            "age": state.age,
            "expected_measurement": expectation.value,
            "innovation_deviation": lambda: self._deviation(state),
            "uncensored_probability": expectation.uncensored_probability,
            "prior_mean": state.prior_mean,
            "prior_covariance": state.prior_covariance,
            "silent_variance": lambda: linalg.trace(self._silent(plan)[1]),
            "variance_reduction": lambda: self._variance_reduction(plan),
        }

    def observe(self, state: FederatedTobitState) -> Sequence[Array]:
        """The blocks named in :attr:`features`, before clipping to their bounds."""
        expectation, _ = _sensed(state)
        runs = state.truth.shape[-1]
        innovation = (state.measurement - expectation.value) / self._deviation(state)
        sensors = self.filter.sensors
        difference = (state.measurement - state.held) / (2.0 * np.sqrt(sensors.variance))
        variance = linalg.diagonal(state.prior_covariance) / self.reference[:, None]
        return (
            innovation.reshape(-1, runs),
            (state.measurement <= sensors.threshold).reshape(-1, runs).astype(np.float64),
            difference.reshape(-1, runs),
            expectation.uncensored_probability.reshape(-1, runs),
            state.age / (state.age + 10.0),
            np.log(variance),
            state.prior_mean / self.scale[:, None],
        )

    def truth(self, state: FederatedTobitState) -> Array:
        """The plant's state (n, N)."""
        return state.truth

    def fused(self, state: FederatedTobitState) -> tuple[Array, Array]:
        """The centre's mean (n, N) and covariance (n, n, N)."""
        return state.mean, state.covariance

    def local_means(self, state: FederatedTobitState) -> Array:
        """The nodes' posterior means (sensors, n, N) before the feedback."""
        return state.local_mean

    def open_loop(self, horizon: int) -> Array:
        """Mean error variance (n,) over t = 1..horizon of a centre that only predicts."""
        return self.plant.open_loop(horizon)

    def _deviation(self, state: FederatedTobitState) -> Array:
        """Predicted standard deviation of the innovation (sensors, m, N), from the centre's P."""
        expectation, _ = _sensed(state)
        matrix = self.filter.sensors.measurement_matrix
        spread = (matrix * linalg.matmul(matrix, state.prior_covariance)).sum(-2)
        q = expectation.uncensored_probability
        floor = 1e-3 * self.filter.sensors.variance
        return np.sqrt(q * q * spread + expectation.noise_variance + floor)

    def _silent(self, plan: Plan) -> tuple[Array, Array]:
        information = linalg.inverse(plan.silent_covariance)
        return information, linalg.inverse(information.sum(0))

    def _variance_reduction(self, plan: Plan) -> Array:
        information, silent = self._silent(plan)
        gained = linalg.inverse(plan.delivered_covariance) - information
        fused = linalg.inverse(linalg.symmetrise(information.sum(0) + gained))
        return linalg.trace(silent) - linalg.trace(fused)


def _sensed(state: FederatedTobitState) -> tuple[Expectation, Plan]:
    if state.expectation is None or state.plan is None:
        raise RuntimeError("the state has no measurements yet: call sense first")
    return state.expectation, state.plan
