"""A linear plant with censored sensors, its estimator, and the scenario of their options.

Source: tobit_token_bucket (Chen, Han, Song and Zhang, Complex Eng. Syst. 4:19, 2024);
round_robin_tobit (Geng, Wang, Alsaadi, Alharbi and Cheng, 2020).
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, ClassVar, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core.estimator import Reception, SignalValues
from fusion_gym.core.knowledge import Block, Signal, age_block, common_signals, numbered, sensed
from fusion_gym.core.plant import AS_ASSUMED, Nature, Plant, true_noise
from fusion_gym.core.task import PaperOptions, Scenario
from fusion_gym.declaration import plain_options
from fusion_gym.errors import ConfigurationError, forbidden, refusal
from fusion_gym.fusion.table import Structure
from fusion_gym.namespace import namespace
from fusion_gym.systems import bases, linear_plant
from fusion_gym.systems.linear_control import ControlOptions, close_loop
from fusion_gym.systems.solvable import LinearEstimator, LinearProblem, ParametricEstimator
from fusion_gym.systems.tobit.centres import (
    STRUCTURE,
    Centre,
    Filter,
    HoldCentre,
    LocalCentre,
    NodeCentre,
    Prediction,
)
from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.validation import choice

_TINY = float(np.finfo(float).tiny)  # stands for a variance of zero
_OF_FUSION = ("fusion", "information_shares", "order")


@dataclass(frozen=True)
class CensoredPlant(bases.SensorPlant[bases.Truth], bases.NormalPlant):
    """A linear plant and censored sensors.

    ``random_start`` draws the direction of the initial mean uniformly and announces it. For the
    oscillator that is a random phase. ``nature`` is the departure of the truth from this model.
    """

    dynamics: linear_plant.LinearPlant
    sensors: CensoredSensors
    state_names: tuple[str, ...]
    random_start: bool = False
    nature: Nature = AS_ASSUMED

    @property
    def start_channels(self) -> int:
        """Normals of a start: direction, deviation, noise of the first measurement, nature's."""
        return 2 * self.dynamics.size + self.sensors.noise_channels + self.nature.channels

    @functools.cached_property
    def censored_beyond(self) -> dict[int, tuple[float, float]]:  # type: ignore[override]
        """Lowest and highest uncensored value of states, by their number, for pictures.

        It covers states that a sensor measures separately; the widest interval where sensors
        differ. It is empty for sensors with a schedule.
        """
        result: dict[int, tuple[float, float]] = {}
        sensors = self.sensors
        if sensors.schedule is not None:
            return result
        rows = sensors.measurement_matrix[..., 0].reshape(-1, self.dynamics.size)
        limits = zip(sensors.threshold.ravel(), sensors.upper.ravel(), strict=True)
        for row, (low, high) in zip(rows, limits, strict=True):
            (states,) = np.nonzero(row)
            if len(states) == 1:
                state = int(states[0])
                ends = sorted((low / row[state], high / row[state]))
                before = result.get(state, (np.inf, -np.inf))
                result[state] = (min(before[0], ends[0]), max(before[1], ends[1]))
        return result

    def start(self, noise: Array) -> tuple[bases.Truth, Any]:
        """Draw the initial state, and announce its mean (n, N)."""
        n = self.dynamics.size
        noise, departure = self.nature.begin(noise)
        xp, runs = namespace(noise), noise.shape[-1]
        mean = xp.array(np.broadcast_to(self.dynamics.initial_mean, (n, runs)))
        if self.random_start:
            direction = noise[:n] / linalg.dot(noise[:n], noise[:n]) ** 0.5
            mean = xp.sqrt(linalg.dot(mean, mean)) * direction
        truth = self.dynamics.start(mean, noise[n : 2 * n])
        own = true_noise(departure, noise[:0], noise[2 * n :])[1]
        time = xp.zeros(runs)
        measurement = self.sensors.at(time).measure(truth, own, departure)
        return bases.Truth(truth, measurement, departure, time), mean

    def sense(self, state: bases.Truth, noise: Array, control: Array | None = None) -> bases.Truth:
        """Move the plant, and measure.

        Source: tobit_token_bucket, equations (1) and (2).
        """
        r, departure, time = self.dynamics.noise_channels, state.departure, state.time + 1.0
        process, own = true_noise(departure, noise[:r], noise[r:])
        truth = self.dynamics.at(state.time).advance(state.truth, process, departure, control)
        measurement = self.sensors.at(time).measure(truth, own, departure)
        return bases.Truth(truth, measurement, departure, time)

    def rounding(self, horizon: int) -> tuple[float, float]:
        """See :class:`Plant`."""
        every = self.sensors.each_step
        rows = np.moveaxis(every.measurement_matrix / every.deviation[:, :, None], -1, 0)
        moments = self.dynamics.second_moments(horizon, self.random_start)
        loss = linear_plant.variance_loss(self.dynamics, horizon, self._packets)
        return linear_plant.largest_ratio(moments, rows), loss

    def _packets(self, time: int) -> Iterator[tuple[Array, Array]]:
        """Yield matrices and noises of the single packets of a time, then of all together."""
        sensors = self.sensors.at(np.full(1, time))
        yield sensors.measurement_matrix[..., 0], sensors.variance * np.eye(sensors.size)
        yield sensors.stacked_matrix[..., 0], sensors.noise_covariance[..., 0]


class Announcement(NamedTuple):
    """What a recording announces of its start: the mean (n, N), and the time of day (N,)."""

    mean: Array
    day: Array


@dataclass(frozen=True)
class DailyLevel:
    """What readings have beside the plant's deviations.

    ``waves`` (l, 5) has each sensor's constant, sine and cosine of one and of two periods a day;
    ``step`` is a step in days. Readings are multiples of ``quantum`` (l, 1, 1).
    """

    waves: Array
    step: float
    quantum: Array

    def at(self, day: Array, time: Array) -> Array:
        """Return the level (l, 1, N) after steps ``time`` (N,) from the times of day (N,)."""
        turn = 2.0 * np.pi * (day + self.step * time)
        waves = [np.ones_like(turn), np.sin(turn), np.cos(turn), np.sin(2 * turn), np.cos(2 * turn)]
        return (self.waves @ np.array(waves))[:, None]

    def reading(self, deviation: Array, level: Array) -> Array:
        """Return the reading (l, 1, N) without rounding errors, which would count as changes."""
        return np.round((deviation + level) / self.quantum) * self.quantum


@dataclass(slots=True)
class CensoredEstimate(bases.Deliveries):
    """The estimate of N runs at one time; n states.

    ``time`` (N,), the step in the episode · ``prior_mean`` (n, N), ``prior_covariance`` (n, n, N),
    the centre's prediction · ``prediction`` of the measurements · ``mean`` (n, N), ``covariance``
    (n, n, N), the fused posterior · of a recording the time of day ``day`` (N,) at the start and
    the sensors ``available`` (l, N) with a reading.
    """

    time: Array
    prior_mean: Array
    prior_covariance: Array
    prediction: Prediction | None
    mean: Array
    covariance: Array
    day: Array | None = None
    available: NDArray[np.bool_] | None = None


_OF_CENSORING = ("censored", "uncensored_probability")
_COMPONENTS = "(sensors, m, N)"
SIGNALS = (
    *common_signals(_COMPONENTS, measurement="the new censored measurement"),
    Signal("censored", "own", _COMPONENTS, "whether the component is at its threshold"),
    Signal("uncensored_probability", "centre", _COMPONENTS, "predicted P(uncensored)", "own"),
)


@dataclass(frozen=True)
class CensoredEstimator(
    bases.AdoptingEstimator[CensoredEstimate],
    LinearEstimator[CensoredEstimate],
    ParametricEstimator[CensoredEstimate],
):
    """A centre with or without nodes.

    ``model`` is the plant that the filters assume. ``scale`` (n,) divides observed state estimates
    and ``reference`` (n,) observed variances. With ``known_start`` the estimate begins with the
    first measurement of every sensor. With ``level`` the measurements are deviations of readings
    from it, and a measurement of NaN is a gap.
    """

    model: linear_plant.LinearPlant
    centre: Centre
    state_names: tuple[str, ...]
    scale: Array
    reference: Array
    known_start: bool = False
    level: DailyLevel | None = None

    @property
    def signals(self) -> tuple[Signal, ...]:  # type: ignore[override]
        """See :class:`Estimator`."""
        return SIGNALS if self.level is None else (*SIGNALS, bases.SAMPLED)

    @property
    def traceable(self) -> bool:  # type: ignore[override]
        """See :class:`Estimator`."""
        return self.centre.traceable

    @property
    def independent_nodes(self) -> bool:  # type: ignore[override]
        """See :class:`Estimator`."""
        return isinstance(self.centre, LocalCentre)

    @property
    def reads_silence(self) -> bool:  # type: ignore[override]
        """See :class:`Estimator`."""
        return self.centre.reads_silence

    @property
    def covariance_cycle(self) -> int | None:  # type: ignore[override]
        """See :class:`Estimator`; Kalman filters without censoring have one.

        With federated fusion, or one filter at the centre, the covariances are then the actual ones
        if ``model`` is the plant; with covariance intersection they are bounds. Gaps have none.
        """
        if not self.centre.predictable or self.level is not None:
            return None
        return max(self.model.period, self.centre.sensors.period)

    @property
    def state_weights(self) -> Array:
        """Weights (n,) of the traces among the signals: all 1, a plain trace as in the papers."""
        return np.ones(self.model.size)

    def linear_problem(self, plant: Plant[Any], where: str) -> LinearProblem | None:
        """See :class:`LinearEstimator`."""
        if type(plant) is not CensoredPlant:
            return None
        dynamics, sensors = plant.dynamics, plant.sensors
        if self.model is not dynamics:
            reason = "the filters must predict with the plant's own matrix"
            raise forbidden("bias_aware", False, reason, where)
        plant.nature.refuse(where)
        for part in (dynamics, sensors):
            part.refuse_schedule(where)
        if not self.centre.predicts or self.reads_silence:
            raise ConfigurationError(
                f"filter is not allowed {where}: in silence the centre must predict, so neither "
                "hold the last value (filter='hold', or 'paper' with silent='hold') nor use the "
                "information of silence (filter='stochastic' or 'truncated')"
            )
        motion = dynamics.transition, dynamics.process_covariance, dynamics.initial_covariance
        both = sensors.stacked_matrix, sensors.noise_covariance
        return LinearProblem(*(array[..., 0] for array in (*motion, *both)))

    @property
    def parameters(self) -> dict[str, Array]:
        """W (n, n), R (sensors, m) and the shares (sensors,) of the feedback, where it has them."""
        model, sensors = self.model, self.centre.sensors
        result: dict[str, Array] = {}
        if model.schedule is None:
            result["process_covariance"] = model.process_covariance[..., 0]
        if sensors.schedule is None:
            result["measurement_variance"] = sensors.variance[..., 0]
        if isinstance(self.centre, NodeCentre):
            result["information_shares"] = self.centre.share[:, 0]
        return result

    def with_parameters(self, **parameters: Array) -> CensoredEstimator:
        """See :class:`ParametricEstimator`."""
        model, centre = self.model, cast(Any, self.centre)
        if (covariance := parameters.get("process_covariance")) is not None:
            model.refuse_schedule("with another process covariance")
            model = replace(model, process_covariance=covariance[..., None])
        if (variance := parameters.get("measurement_variance")) is not None:
            centre.sensors.refuse_schedule("with another measurement variance")
            variance = variance[..., None]
            deviation = namespace(variance).sqrt(variance)
            sensors = replace(centre.sensors, variance=variance, deviation=deviation)
            centre = replace(centre, filter=replace(centre.filter, sensors=sensors))
        if (shares := parameters.get("information_shares")) is not None:
            centre = replace(centre, share=shares[:, None])
        return replace(self, model=model, centre=centre)

    @property
    def observation(self) -> tuple[Block, ...]:
        """Blocks of the observation, without the censoring blocks if nothing is censored."""
        sensors = self.centre.sensors
        nodes = numbered(sensors.count)
        own = partial(Block, labels=(nodes, numbered(sensors.size)), node="own")
        new = partial(own, knowledge="own", limit=bases.RANGE)
        at_threshold = "whether the component is at its threshold"
        uncensored = "predicted probability that the component is not censored"
        divisor, unit = 2.0 * sensors.deviation, "two noise deviations"
        level: dict[str, Any] = {}
        if self.level is not None:  # exact readings
            level = {"level": self.level.waves, "days a step": self.level.step}
            divisor, unit = self.scale[: sensors.count, None, None], "the state's root mean square"
        moved = f"new minus last delivered measurement, over {unit}"
        blocks = [
            new(
                "whitened_innovation",
                "innovation over its predicted deviation",
                _whitened,
                constants=level,
            ),
            new("censored", at_threshold, lambda s: sensors.censored(s.measurement), limit=None),
            new(
                "held_difference",
                moved,
                lambda s: (s.measurement - s.held) / divisor,
                constants={unit: divisor[..., 0]},
            ),
            own(
                "uncensored_probability",
                uncensored,
                lambda s: sensed(s.prediction).expectation.uncensored_probability,
            ),
            age_block(nodes),
            bases.variance_block(self._log_variance, self.state_names, self.reference),
            bases.prior_block(self.state_names, self.scale),
        ]
        if sensors.unlimited:  # these two would say nothing
            blocks = [block for block in blocks if block.name not in _OF_CENSORING]
        if self.independent_nodes:
            blocks = blocks[:-2] + [replace(block, node="hidden") for block in blocks[-2:]]
        return tuple(blocks)

    def start(self, measurement: Array, announcement: Any) -> CensoredEstimate:
        """Return the estimate of the announced mean (n, N)."""
        mean, day = announcement, None
        if isinstance(announcement, Announcement):
            mean, day = announcement
        (n, runs), sensors, xp = mean.shape, self.centre.sensors, namespace(mean)
        covariance = xp.array(np.broadcast_to(self.model.initial_covariance, (n, n, runs)))
        first = CensoredEstimate.begin(
            measurement, np.zeros(runs), mean, covariance, None, mean, covariance, day
        )
        if not self.known_start:
            return first
        if self.level is not None:
            filled = np.nan_to_num(measurement)
            first.prediction = self.centre.predict((mean, covariance), filled, first.time)
            first = self.observe(first, measurement)
            first.held = first.measurement
        centre = self.centre.at(first.time)
        prediction = centre.predict((mean, covariance), first.held, first.time)
        everyone = xp.ones((sensors.count, runs), dtype=np.bool_)
        result = self.update(replace(first, prediction=prediction), Reception(everyone))
        return replace(result, prediction=None, age=first.age)

    def predict(self, state: CensoredEstimate, control: Array | None = None) -> CensoredEstimate:
        """Predict at centre and nodes; held readings stay while the level moves.

        Source: tobit_token_bucket, equations (21), (23), (29).
        """
        time, held = state.time + 1.0, state.held
        if self.level is not None:
            held = held - (self._level(state, time) - self._level(state, state.time))
            state = replace(state, held=held)
        model, centre = self.model.at(state.time), self.centre.at(time)
        prediction = centre.advance(model, state, control)
        mean, covariance = prediction.prior
        state = replace(state, prior_mean=mean, prior_covariance=covariance, prediction=prediction)
        return state.later(time=time)

    def observe(self, state: CensoredEstimate, measurement: Array) -> CensoredEstimate:
        """See :class:`Estimator`; a sensor without a reading has the expectation."""
        if self.level is None:
            return super().observe(state, measurement)
        available = np.isfinite(measurement[:, 0])
        if (wrong := np.isinf(measurement)).any():
            allowed = "finite numbers, or NaN where no packet arrives"
            raise refusal("measurement", float(measurement[wrong][0]), allowed)
        expected = sensed(state.prediction).own[0]
        filled = np.where(available[:, None], measurement, expected)
        return replace(state, measurement=filled, available=available)

    def update(self, state: CensoredEstimate, reception: Reception) -> CensoredEstimate:
        """Update nodes and centre with the measurements that arrive.

        Source: tobit_token_bucket, equations (20), (22), (30), (50).
        """
        prediction = sensed(state.prediction)
        if self.reads_silence:
            prediction = prediction._replace(possible=reception.possible)
        arrived = reception.arrived
        if state.available is not None:
            arrived = arrived & state.available
        centre = self.centre.at(state.time)
        mean, covariance = centre.update(prediction, state.measurement, arrived)
        return state.after(arrived, prediction=prediction, mean=mean, covariance=covariance)

    def single_deliveries(self, state: CensoredEstimate) -> tuple[Array, Array] | None:
        """See :class:`Estimator`."""
        centre = self.centre.at(state.time)
        if not centre.separable:
            return None
        means, covariances = centre.single(sensed(state.prediction), state.measurement)
        if state.available is not None:
            silent = self.update(state, Reception(np.zeros_like(state.available))).covariance
            covariances = np.where(state.available[:, None, None], covariances, silent)
        return means, covariances

    def read(self, state: CensoredEstimate, failure: Array | None = None) -> SignalValues:
        """Return the signals of ``SIGNALS``."""
        expectation = sensed(state.prediction).expectation
        expected, deviation = sensed(state.prediction).own

        @functools.cache
        def variances() -> tuple[Array, Array]:
            centre = self.centre.at(state.time)
            return centre.variances(sensed(state.prediction), self.state_weights)

        values: dict[str, Any] = {
            **super().read(state, failure),
            "innovation": lambda: state.measurement - expected,
            "censored": lambda: self.centre.sensors.censored(state.measurement),
            "expected_measurement": expected,
            "innovation_deviation": deviation,
            "uncensored_probability": expectation.uncensored_probability,
            "silent_variance": lambda: variances()[0],
            "variance_reduction": lambda: variances()[1],
        }
        if self.level is None:
            return values
        level, available = self._level(state, state.time), cast(Any, state.available)
        return {
            **values,
            "measurement": self.level.reading(state.measurement, level),
            "held": self.level.reading(state.held, level),
            "expected_measurement": expected + level,
            "sampled": available,
            "variance_reduction": lambda: np.where(available, variances()[1], 0.0),
        }

    def _level(self, state: CensoredEstimate, time: Array) -> Array:
        level: Any = self.level
        return level.at(state.day, time)

    def _log_variance(self, state: CensoredEstimate) -> Array:
        variances = (linalg.diagonal(state.prior_covariance), self.reference[:, None])
        now, usual = (
            namespace(values).log(namespace(values).maximum(values, _TINY)) for values in variances
        )
        return now - usual

    def local_means(self, state: CensoredEstimate) -> Array:
        """Return the nodes' posterior means (sensors, n, N) before the feedback."""
        if state.prediction is None:
            return super().local_means(state)
        centre, arrived = self.centre.at(state.time), state.age == 0.0
        return centre.local_means(state.prediction, state.measurement, arrived)


def _whitened(state: CensoredEstimate) -> Array:
    expected, deviation = sensed(state.prediction).own
    return (state.measurement - expected) / deviation


@dataclass(frozen=True)
class FeedbackOptions(ControlOptions, PaperOptions):
    """Options of the fusion and its feedback; ``None`` is the default of the filter or the rule."""

    structure: ClassVar[Structure | None] = STRUCTURE
    fusion: Annotated[str | None, STRUCTURE.offered] = None
    """Rule that joins the nodes' estimates, by default ``"federated"`` (tobit_token_bucket,
    equations (50) and (51)). ``"ci"`` is covariance intersection, ``"ici"`` its inverse form for
    two sensors. ``"sci"`` and ``"sici"`` join two estimates at a time."""
    information_shares: ArrayLike | None = None
    """Shares w of the information that each node gets back under ``"federated"``, with the sum 1.
    Equal by default (tobit_token_bucket, equation (51))."""
    order: ArrayLike | None = None
    """Order of arrival under ``"sci"`` and ``"sici"``: a permutation of the sensors."""
    stochastic_weight: ArrayLike | None = None
    """Weight Z of the policy ``stochastic_event``: one number > 0, or one per sensor, in the
    inverse squared unit of the measurement. ``filter="stochastic"`` needs it."""


def feedback_scenario(
    options: Any,
    filters: Mapping[str, Filter],
    truth: CensoredPlant,
    reference_horizon: int,
    *,
    memory_filter: str | None = None,
    policy_defaults: Mapping[str, dict[str, Any]] | None = None,
    model: linear_plant.LinearPlant | None = None,
    known_start: bool = False,
    **others: Any,
) -> Scenario:
    """Return the scenario of a linear plant, its sensors and the option ``filter``.

    Options of the memory's filter are the environment's own where both filters have them, and
    otherwise defaults.

    Args:
        options: options of the environment.
        filters: the table of filters.
        truth: the true plant and its sensors, without a departure from the model.
        reference_horizon: steps without transmissions whose variances scale observed variances.
        memory_filter: default of the option ``memory_filter``, or None for the same filter.
        policy_defaults: parameters of policies.
        model: the plant that the filters assume, by default the true one.
        known_start: whether the estimate begins with the first measurement of every sensor.
        **others: other fields of the scenario.

    Raises:
        ConfigurationError: an unknown filter, an option of another filter, or a departure of the
            truth that is not allowed or has no effect.
    """
    plant, sensors, names = truth.dynamics, truth.sensors, truth.state_names
    kind = choice("filter", options.filter, filters)
    where = f"filter={kind!r}"
    for name, row in filters.items():
        if name != kind:
            _refuse(options, row.own, where, f"filter={name!r}")
    if not filters[kind].nodes:
        belongs = "a filter with nodes (here the centre uses the measurements)"
        _refuse(options, _OF_FUSION, where, belongs)
    controller, closed = close_loop(options, plant)
    model = closed if model is None else close_loop(options, model)[1]
    plant = closed
    centre = filters[kind].make(options, sensors)
    _refuse_held(options, centre, f"with {where}")
    if centre.reads_silence and options.channel != "perfect":
        raise refusal("channel", options.channel, "'perfect', because a loss is no silence", where)
    absent = ("true_threshold_shift",) if sensors.unlimited else ()
    nature = Nature.create(options, (*plant.unmoved, *absent))
    nature.check_growth(plant.true_radius, options.horizon)
    if plant.schedule is None and sensors.schedule is None:
        plant.warn_of_unseen_growth(sensors.stacked_matrix, names)
    estimator = CensoredEstimator(
        model=model,
        centre=centre,
        state_names=names,
        scale=linear_plant.typical_magnitude(plant, options.horizon, truth.random_start),
        reference=plant.open_loop(min(options.horizon, reference_horizon)),
        known_start=known_start,
    )
    memory, own = None, options.memory_filter
    if (other := memory_filter if own is None else own) is not None:
        row = filters[choice("memory_filter", other, filters)]
        changed: dict[str, Any] = dict.fromkeys(() if row.nodes else _OF_FUSION)
        changed["filter"] = other
        memory = replace(estimator, centre=row.make(replace(options, **changed), sensors))
        _refuse_held(options, memory.centre, f"with memory_filter={other!r}")
    defaults: dict[str, Any] = dict(policy_defaults or {})
    if options.stochastic_weight is not None:
        defaults["stochastic_event"] = {"weight": plain_options(options.stochastic_weight)}
    return Scenario(
        options,
        replace(truth, dynamics=plant, nature=nature),
        estimator,
        controller=controller,
        policy_defaults=defaults,
        feedback=not estimator.independent_nodes,
        memory_estimator=memory,
        **others,
    )


def _refuse_held(options: FeedbackOptions, centre: Centre, where: str) -> None:
    holds = isinstance(centre, HoldCentre) or getattr(centre.filter, "hold", False)
    if options.input_matrix is not None and holds:
        why = "a held value does not follow the input"
        raise forbidden("input_matrix", options.input_matrix, why, where)


def _refuse(options: FeedbackOptions, names: tuple[str, ...], where: str, belongs: str) -> None:
    for name in names:
        value = getattr(options, name)
        if value is not None:
            raise forbidden(name, value, f"it belongs to {belongs}", f"with {where}")
