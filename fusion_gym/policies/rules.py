"""Trigger rules.

The first use the clock, the order of grants, or covariances, and no measurement. The next use each
sensor's own measurement, the last the beliefs of the scheduler or of each sensor.
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, cast, get_args

import numpy as np

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.core.memory import Beliefs, Estimate, Owner
from fusion_gym.core.task import Task
from fusion_gym.envs.views import SensorView
from fusion_gym.errors import forbidden
from fusion_gym.namespace import namespace
from fusion_gym.policies.base import (
    INTERVAL,
    SHARED_THRESHOLD,
    THRESHOLD,
    ChanceRule,
    LocalRule,
    PerSensor,
    Requests,
    Rule,
    SearchRange,
    check_at_most,
    check_price,
    each_number,
    not_negative_parameter,
    optional,
    parameter,
    shape_of,
    strongest,
    surprise,
)

RATE = SearchRange(1e-3, 1.0)
AGE = SearchRange(1.0, 1e3, per_sensor=False)


def check_period(name: str, value: int) -> None:
    """Check a number of steps >= 1."""
    validation.integer(name, value, at_least=1, at_most=validation.MOST_PERIOD)


@dataclass
class Always(Rule):
    r"""Request every sensor at every step.

    Equation:
        $$
        \delta_i(t)=1
        $$

    Assumes: nothing.

    Source: none; the highest rate that the tokens allow.

    Example: ``always`` in ``fusion_gym/TobitOscillator-v1 filter=tobit random_start=True
    tokens=unlimited``.
    """

    knowledge: ClassVar[Knowledge] = "clock"
    stateless: ClassVar[bool] = True

    def __call__(self, signals: Signals) -> Requests:
        """Return requests of all sensors (sensors, N)."""
        return np.ones(shape_of(signals), dtype=np.bool_)


@dataclass
class Never(Rule):
    r"""Request no sensor.

    Equation:
        $$
        \delta_i(t)=0
        $$

    Assumes: nothing.

    Source: none; the rate 0, at which the centre only predicts.

    Example: ``never`` in ``fusion_gym/TobitOscillator-v1 filter=tobit random_start=True
    token_rate=2``.
    """

    knowledge: ClassVar[Knowledge] = "clock"
    stateless: ClassVar[bool] = True

    def __call__(self, signals: Signals) -> Requests:
        """Return no requests (sensors, N)."""
        return np.zeros(shape_of(signals), dtype=np.bool_)


@dataclass
class Periodic(Rule):
    r"""Request every sensor once in ``period`` steps.

    Args:
        period: steps between two requests of a sensor, >= 1.
        staggered: spread the sensors over the period; otherwise all sensors request together.

    Equation:
        $$
        \delta_i(t)=1\iff t\equiv\varphi_i\ (\mathrm{mod}\ p),\qquad \varphi_i=\lfloor
        i\,p/l\rfloor
        $$

        p is ``period``, l the number of sensors, i counts from 0; all φ are 0 without
        ``staggered``.

    Assumes: nothing; it uses only the clock.

    Source: none; the usual baseline of an event trigger.

    Example: ``periodic:period=15`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    period: int = parameter(4, check_period, INTERVAL)
    staggered: bool = parameter(True, validation.boolean)
    knowledge: ClassVar[Knowledge] = "clock"
    stateless: ClassVar[bool] = True

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        sensors, _ = shape_of(signals)
        phase = np.arange(sensors) * self.period // sensors if self.staggered else np.zeros(sensors)
        return (signals["step"] - phase[:, None]) % self.period == 0


@dataclass
class RoundRobin(Rule):
    r"""Request one sensor every ``period`` steps, and the next sensor after a grant.

    Args:
        period: steps between two requests, >= 1.

    Equation:
        $$
        \delta_i(t)=1\iff t\equiv 0\ (\mathrm{mod}\ p)\ \ \text{and}\ \ k(t)\equiv i\ (\mathrm{mod}\
        l)
        $$

        p is ``period``, k(t) the number of grants before step t, l the number of sensors, i counts
        from 0.

    Assumes: nothing; it uses the clock and the network's answers to its requests.

    Source: round_robin_tobit, equation (4), a protocol in which one sensor per step may transmit.

    Example: ``round_robin:period=5`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    period: int = parameter(1, check_period, INTERVAL)
    knowledge: ClassVar[Knowledge] = "clock"
    stateless: ClassVar[bool] = True

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        return (signals["queue"] == 0) & (signals["step"] % self.period == 0)


@dataclass
class Random(ChanceRule):
    r"""Request each sensor with probability ``rate``, independently at every step.

    Args:
        rate: r in [0, 1].

    Equation:
        $$
        \Pr\{\delta_i(t)=1\}=r_i
        $$

        r is ``rate``; all draws are independent.

    Assumes: nothing; requests are independent of everything.

    Source: none; a usual baseline of an event trigger.

    Example: ``random:rate=0.07`` in ``fusion_gym/TobitOscillator-v1 filter=tobit random_start=True
    token_rate=2``.
    """

    rate: PerSensor = parameter(0.2, each_number, RATE, at_least=0.0, at_most=1.0)
    knowledge: ClassVar[Knowledge] = "clock"
    stream: ClassVar[int] = 0x72616E646F6D  # independent of the noise of the same seed

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        sensors, runs = shape_of(signals)
        return self.draw(sensors, runs) < self.column("rate", sensors)


# Rounding may delay a request by a step: 49 · (1/49) < 1.
_ROUNDING = 1e-9


@dataclass
class Paced(Rule):
    r"""Request each sensor at ``rate``, with its requests spread as evenly as possible.

    A sensor of rate r requests at the steps t = 0, 1, … with ⌊(t + 1) r + φ⌋ > ⌊t r + φ⌋. Its
    number of requests in n successive steps differs from n r by less than one. The phase φ of
    sensor i is i/sensors if ``staggered``, and 0 otherwise.

    For r = 1/period the rule equals ``periodic`` up to the phase. It is the baseline for an event
    trigger of the same rate.

    Args:
        rate: r in [0, 1], any real number.
        staggered: spread the phases of the sensors evenly.

    Equation:
        $$
        \delta_i(t)=1\iff \lfloor (t+1)\,r_i+\varphi_i\rfloor>\lfloor
        t\,r_i+\varphi_i\rfloor,\qquad \varphi_i=i/l
        $$

        r is ``rate``, l the number of sensors, i counts from 0; all φ are 0 without ``staggered``.

    Assumes: nothing; it uses only the clock.

    Source: none; the balanced sequence of a rate r, ⌊(t + 1) r + φ⌋ - ⌊t r + φ⌋.

    Example: ``paced:rate=0.07`` in ``fusion_gym/TobitOscillator-v1 filter=tobit random_start=True
    token_rate=2``.
    """

    rate: PerSensor = parameter(0.2, each_number, RATE, at_least=0.0, at_most=1.0)
    staggered: bool = parameter(True, validation.boolean)
    knowledge: ClassVar[Knowledge] = "clock"
    stateless: ClassVar[bool] = True

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        sensors, _ = shape_of(signals)
        rate, step = self.column("rate", sensors), signals["step"]
        phase = np.full((sensors, 1), _ROUNDING)
        if self.staggered:
            phase += np.arange(sensors)[:, None] / sensors
        floor = namespace(step, rate).floor
        return cast(Requests, floor((step + 1) * rate + phase) > floor(step * rate + phase))


@dataclass
class LocalVariance(Rule):
    r"""Request where the trace of the node's error covariance is at least ``reference`` + ``m``.

    The traces depend only on time and deliveries, so the rule is a schedule that becomes periodic.
    It prefers the nodes of the largest trace.

    Args:
        m: distance to the reference, in squared units of the state, of any sign.
        reference: trace of the fusion of all nodes at full rate, by default from
            MarkovJumpTracking, and 0 elsewhere.

    Equation:
        $$
        \delta_i(t)=1\iff \mathrm{tr}\,P_i(t)\ge P_{\mathrm{ref}}+m_i
        $$

        Pᵢ is the node's error covariance, P_ref ``reference``.

    Assumes: node covariances that do not depend on the data, as with linear filters, so centre and
    node both know them.

    Source: markov_jump, equation (33).

    Example: ``local_variance:m=0.9`` in ``fusion_gym/MarkovJumpTracking-v1``.
    """

    m: PerSensor = parameter(0.9, each_number, THRESHOLD)
    reference: float = parameter(0.0, validation.number, at_least=0.0)
    knowledge: ClassVar[Knowledge] = "centre"
    stateless: ClassVar[bool] = True

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        variance = signals["local_variance"]
        return variance >= self.reference + self.column("m", len(variance))


@dataclass
class CentreVariance(Rule):
    r"""Request the fewest sensors, by greedy choice, that bring the fused trace below a threshold.

    The trace is the trace of the fused covariance after the step, in squared units of the state.
    While it is at least θ, the rule adds the sensor that lowers it most. The rule uses no
    measurement, so without a token limit it is a schedule.

    Unlike the rule ``variance_threshold`` it uses the unweighted trace and the joint effect of
    several packets.

    Args:
        threshold: θ >= 0, in squared units of the state.
        at_most: most sensors requested in a step; None for no limit.

    Equation:
        $$
        S_0=\varnothing,\qquad
        S_{k+1}=S_k\cup\{\arg\min_{s}\ \mathrm{tr}\,P_{S_k\cup\{s\}}\}\quad\text{while}\quad
        \mathrm{tr}\,P_{S_k}\ge\theta
        $$

        The rule requests the last of these sets. P_S is the fused covariance of this step after the
        packets of S, θ is ``threshold``; at most ``at_most`` sensors are added.

    Assumes: correct covariances of the estimators.

    Source: the threshold is from S. Trimpe and R. D'Andrea, "Event-based state estimation with
    variance-based triggering", IEEE Trans. Automatic Control 59, 2014; the greedy choice is from
    this library.

    Example: ``centre_variance:threshold=2.5`` in ``fusion_gym/MarkovJumpTracking-v1``.
    """

    threshold: float = parameter(1.6, validation.number, SHARED_THRESHOLD, at_least=0.0)
    at_most: int | None = parameter(None, check_at_most)
    knowledge: ClassVar[Knowledge] = "centre"
    stateless: ClassVar[bool] = True

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        before = signals["greedy_variance"]
        return strongest(before, before >= self.threshold, self.at_most, signals["age"])


@dataclass
class VarianceThreshold(Rule):
    r"""Request when the trace of the fused covariance without transmissions reaches ``threshold``.

    The rule uses no measurement.

    Args:
        threshold: θ >= 0, in squared units of the state.
        at_most: most requests in a step, by the largest reduction of the trace; None for no limit.

    Equation:
        $$
        \mathrm{tr}(W P_\varnothing)\ge\theta\ \Rightarrow\ \delta_i(t)=1\ \text{for the sensors
        of the largest}\ \ \mathrm{tr}(W P_\varnothing)-\mathrm{tr}(W P_{\{i\}})
        $$

        P_∅ is the fused covariance of this step without transmissions, P_{i} with a transmission
        of sensor i only, W the reward's weights of the states, θ ``threshold``; ``at_most`` sensors
        are requested.

    Assumes: correct covariances of the estimators.

    Source: after S. Trimpe and R. D'Andrea, "Event-based state estimation with variance-based
    triggering", IEEE Trans. Automatic Control 59, 2014.

    Example: ``variance_threshold:threshold=0.25`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    threshold: float = parameter(0.1, validation.number, SHARED_THRESHOLD, at_least=0.0)
    at_most: int | None = parameter(1, check_at_most)
    knowledge: ClassVar[Knowledge] = "centre"
    stateless: ClassVar[bool] = True

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        order = signals["variance_order"]
        due = namespace(order).broadcast_to(
            signals["silent_variance"] >= self.threshold, order.shape
        )
        return strongest(order, due, self.at_most, signals["age"])


@dataclass
class MaximumAge(Rule):
    r"""Request the sensors whose last delivery is oldest.

    Args:
        at_most: most requests in a step; None for no limit.
        least: least age of a request, in steps, >= 1.

    Equation:
        $$
        a_i(t)\ge a_{\min}\ \text{and}\ i\ \text{among the largest}\ a_i\ \Rightarrow\ \delta_i(t)=1
        $$

        a are the steps since the last delivery of a sensor, a_min is ``least``; ``at_most`` sensors
        are requested.

    Assumes: sources that are alike.

    Source: A. M. Bedewy, Y. Sun and N. B. Shroff, "Minimizing the age of information through
    queues", IEEE Trans. Information Theory 65, 2019, for maximum age first.

    Example: ``maximum_age:at_most=2`` in ``fusion_gym/RemoteEstimation-v1 sensors=6 access=slots
    slots=2``.
    """

    at_most: int | None = parameter(1, check_at_most)
    least: float = parameter(1.0, validation.number, AGE, at_least=1.0)
    knowledge: ClassVar[Knowledge] = "centre"
    stateless: ClassVar[bool] = True

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        age = signals["age"]
        return strongest(age, age >= self.least, self.at_most, age)


@dataclass
class InformationGain(Rule):
    r"""Request where the relative reduction of the fused trace per token is >= ``threshold``.

    The reduction is the effect of a single delivery from this sensor, relative to the trace without
    deliveries. It does not depend on the measurement.

    Args:
        threshold: θ >= 0, the least relative reduction per token, for all sensors or for each.
        at_most: most requests in a step, by the highest gain; None for no limit.

    Equation:
        $$
        g_i=\frac{\mathrm{tr}(W P_\varnothing)-\mathrm{tr}(W P_{\{i\}})}{c_i\ \mathrm{tr}(W
        P_\varnothing)},\qquad \delta_i(t)=1\Rightarrow g_i\ge\theta
        $$

        The rule requests the ``at_most`` sensors of the highest gain that reach θ (``threshold``).
        P_∅ is the fused covariance of this step without transmissions, P_{i} with a transmission
        of sensor i only, W the reward's weights of the states, c the tokens of a transmission.

    Assumes: correct covariances of the estimators, and that only the next step counts.

    Source: none; the greedy choice of sensors by predicted variance, here per token.

    Example: ``information_gain:threshold=0.2`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    threshold: PerSensor = parameter(0.05, not_negative_parameter, THRESHOLD)
    at_most: int | None = parameter(1, check_at_most)
    knowledge: ClassVar[Knowledge] = "centre"
    stateless: ClassVar[bool] = True

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        relative = signals["variance_reduction"] / signals["silent_variance"]
        gain = relative / signals["token_cost"]
        due = gain >= self.column("threshold", len(gain))
        return strongest(gain, due, self.at_most, signals["age"])


@dataclass
class InnovationThreshold(LocalRule):
    r"""Request when the Euclidean norm of the innovation is at least ``threshold``.

    Args:
        threshold: θ >= 0, in the unit of the measurement, or without a unit.
        whitened: take the innovation in predicted standard deviations.
        at_most: most requests in a step, by the largest norm; None for no limit.
        min_interval: least steps between two deliveries of a sensor, >= 1.
        max_interval: most steps between two deliveries of a sensor; None for no limit.

    Equation:
        $$
        \delta_i(t)=1\iff \lVert z_i(t)\rVert\ge\theta_i,\qquad z_i=y_i-\hat y_i
        $$

        ŷᵢ is the predicted measurement, θ is ``threshold``; with ``whitened`` each component of z
        is divided by its predicted standard deviation. With ``at_most``, the sensors of the largest
        norms are requested.

    Assumes: a prediction of the measurement at the sensor; with ``whitened`` also that its
    predicted deviation is true. The filters treat silence as no information.

    Source: after J. Wu, Q.-S. Jia, K. H. Johansson and L. Shi, "Event-based sensor data
    scheduling: trade-off between communication rate and estimation quality", IEEE Trans.
    Automatic Control 58, 2013 (there with the maximum norm of the whitened innovation).

    Example: ``innovation_threshold:threshold=1.2`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    threshold: PerSensor = parameter(1.0, not_negative_parameter, THRESHOLD)
    whitened: bool = parameter(False, validation.boolean)
    at_most: int | None = parameter(None, check_at_most)

    stateless: ClassVar[bool] = True

    @property
    def knowledge(self) -> Knowledge:
        """A sensor's knowledge class, or a scheduler's with ``at_most``, which compares sensors."""
        return "own" if self.at_most is None else "scheduler"

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        norm = surprise(signals, self.whitened) ** 0.5
        requests = self.limit(norm >= self.column("threshold", len(norm)), signals)
        return strongest(norm, requests, self.at_most, signals["age"])


@dataclass
class AdaptiveInnovation(LocalRule):
    r"""Request when |ε|² >= a exp(-(b + c |ε at the last request|)), with ε the innovation.

    A large innovation lowers the threshold. Before the first request of an episode the stored
    innovation is zero.

    The rule decides at the sensor, so a request changes the threshold even if the network denies
    it. In the paper every request is granted. The printed exponent -b + c |ε| contradicts the
    paper's text, which requires a decreasing function.

    Args:
        threshold: a >= 0, in squared units of the measurement; 0 always requests.
        offset: b >= 0, without unit.
        sensitivity: c >= 0, in the inverse unit of the measurement; 0 is a fixed threshold.
        min_interval: least steps between two deliveries of a sensor, >= 1.
        max_interval: most steps between two deliveries of a sensor; None for no limit.

    Equation:
        $$
        \delta_i(t)=1\iff |\varepsilon_i(t)|^2\ge
        a_i\exp\left(-b_i-c_i\,|\varepsilon_i(l_i)|\right)
        $$

        ε is the innovation, lᵢ the step of the sensor's last request; before the first request
        ε(lᵢ) is 0. a is ``threshold``, b ``offset``, c ``sensitivity``.

    Assumes: a prediction of the measurement at the sensor, and a network that grants all requests.

    Source: adaptive_innovation, equations (9)-(11), defaults of Section 6.

    Example: ``adaptive_innovation`` in ``fusion_gym/CorrelatedTracking-v1``.
    """

    threshold: PerSensor = parameter(0.6, not_negative_parameter, THRESHOLD)
    offset: PerSensor = parameter(0.2, not_negative_parameter)
    sensitivity: PerSensor = parameter(0.9, not_negative_parameter, SearchRange(1e-4, 10.0))

    @property
    def knowledge(self) -> Knowledge:
        """A sensor's measurement, with memory of its last request unless the sensitivity is 0."""
        return "own_memory" if np.any(np.asarray(self.sensitivity) > 0.0) else "own"

    def reset(self, runs: int, seed: int = 0) -> None:
        """Clear the last requested innovations."""
        self._last: Array | None = None

    def threshold_after(self, last: Array) -> Array:
        """Return the threshold on |ε|² after requests at innovations of size ``last``.

        Source: adaptive_innovation, equation (10), with the sign of the paper's text.

        Args:
            last: size of the innovation at the last request (sensors, N).
        """
        sensors = len(last)
        exponent = self.column("sensitivity", sensors) * last
        exponent += self.column("offset", sensors)
        return self.column("threshold", sensors) * np.exp(-exponent)

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        squared = surprise(signals)
        if self._last is None:
            self._last = np.zeros(squared.shape)
        last = np.where(signals["start"], 0.0, self._last)
        threshold = self.threshold_after(last)
        request = self.limit(squared >= threshold, signals)
        self._last = np.where(request, np.sqrt(squared), last)
        return request


@dataclass
class AdaptiveThreshold(LocalRule):
    r"""Request when |σ|² > ρ, with σ the measurement minus the last delivered measurement.

    The threshold follows ρ' = ρ̄ + |σ|²/(λ + |σ|²) (ρ - ρ̄) in every step, with σ before the
    transmission. It rises from ρ₀ at an episode's start towards ρ̄.

    While every request is granted, |σ|² <= ρ̄ at every step without a transmission. σ refers to the
    last delivery, not to the last request, so the bound holds again after the grant of a repeated
    request. The measurement at time 0 counts as delivered.

    Args:
        rho_bar: ρ̄, the limit of the threshold, in squared units of the measurement.
        rho_initial: ρ₀ <= ρ̄, the threshold at an episode's start.
        adaptation: λ > 0, in squared units of the measurement.
        scale: factor of ρ̄ and ρ₀, for sweeps.
        min_interval: least steps between two deliveries of a sensor, >= 1.
        max_interval: most steps between two deliveries of a sensor; None for no limit.

    Raises:
        ConfigurationError: not 0 <= ρ₀ <= ρ̄ <= 1, or λ <= 0, or a negative scale.

    Equation:
        $$
        \delta_i(t)=1\iff |\sigma_i(t)|^2>\rho_i(t),\qquad \sigma_i=y_i-\bar y_i
        $$

        $$
        \rho_i(t+1)=\bar\rho_i+\frac{|\sigma_i|^2}{\lambda_i+|\sigma_i|^2}
        \,(\rho_i(t)-\bar\rho_i),\qquad
        \rho_i(0)=\rho_{0,i}
        $$

        ȳᵢ is the last delivered measurement. ρ̄ is ``rho_bar``, ρ₀ ``rho_initial``, λ
        ``adaptation``; ``scale`` multiplies ρ̄ and ρ₀.

    Assumes: a centre that holds the last delivered value, and for the bound ρ̄ a network that
    grants every request.

    Source: unknown_input, equations (5)-(7), defaults of Section 4.

    Example: ``adaptive_threshold`` in ``fusion_gym/UnknownInput-v1``.
    """

    rho_bar: PerSensor = parameter(0.05, not_negative_parameter, SearchRange(1e-7, 1.0))
    rho_initial: PerSensor = parameter(0.01, not_negative_parameter, SearchRange(1e-7, 1.0))
    adaptation: PerSensor = parameter(0.01, each_number, THRESHOLD, above=0.0)
    # A factor of the largest errors, because the paper's thresholds are at most 1.
    scale: float = parameter(1.0, validation.number, SearchRange(1e4, 1e4), at_least=0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        validation.adaptive_thresholds(self.rho_bar, self.rho_initial, self.adaptation)

    def admissible(self, values: dict[str, Array]) -> dict[str, Array]:
        """Return parameters with ρ₀ at most ρ̄."""
        if "rho_initial" in values:
            limit = values.get("rho_bar", np.array(self.rho_bar, ndmin=1)[:, None])
            values |= {"rho_initial": np.minimum(values["rho_initial"], limit)}
        return super().admissible(values)

    @property
    def knowledge(self) -> Knowledge:
        """A sensor's measurement, with memory unless the threshold is constant."""
        initial, limit = np.asarray(self.rho_initial), np.asarray(self.rho_bar)
        return "own" if self.scale == 0.0 or bool(np.all(initial == limit)) else "own_memory"

    def reset(self, runs: int, seed: int = 0) -> None:
        """Clear the thresholds."""
        self._rho: Array | None = None

    def threshold_after(self, rho: Array, squared: Array) -> Array:
        """Return the next threshold (sensors, N).

        Source: unknown_input, equation (7).

        Args:
            rho: present threshold ρ (sensors, N).
            squared: |σ|² before the transmission (sensors, N).
        """
        limit = self.scale * self.column("rho_bar", len(rho))
        share = squared / (self.column("adaptation", len(rho)) + squared)
        return limit + share * (rho - limit)

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        sensors, runs = shape_of(signals)
        initial = self.scale * self.column("rho_initial", sensors)
        start = signals["start"]
        if self._rho is None:
            self._rho, start = np.empty((sensors, runs)), np.ones(runs, dtype=np.bool_)
        rho = np.where(start, initial, self._rho)
        difference = signals["measurement"] - signals["held"]
        squared = linalg.dot(difference, difference)
        request = self.limit(squared > rho, signals)
        self._rho = self.threshold_after(rho, squared)
        return request


@dataclass
class DynamicEvent(LocalRule):
    r"""Request when |ε| >= η/χ + σ, with ε the last requested minus the current measurement.

    The dynamic variable follows η' = λ η + σ - |ε|, where ε is zero after a request. It is clipped
    at zero, because the paper's numbers violate the condition λ χ > 1 for a positive η. η depends
    on measurements without a request, and ε on requests that the network denied.

    Args:
        threshold: σ >= 0, in the unit of the measurement.
        decay: λ >= 0, without unit.
        divisor: χ > 0, without unit.
        initial: η₀ >= 0, in the unit of the measurement.
        scale: factor of σ and η₀, for sweeps.
        min_interval: least steps between two deliveries of a sensor, >= 1.
        max_interval: most steps between two deliveries of a sensor; None for no limit.

    Equation:
        $$
        \delta_i(t)=1\iff |\varepsilon_i|\ge\frac{\eta_i(t)}{\chi_i}+\sigma_i
        $$

        $$
        \eta_i(t+1)=\max\left(0,\ \lambda_i\,\eta_i(t)+\sigma_i
        -(1-\delta_i(t))\,|\varepsilon_i|\right),\qquad
        \eta_i(0)=\eta_{0,i}
        $$

        εᵢ is the last requested measurement minus the present measurement. σ is ``threshold``, λ
        ``decay``, χ ``divisor``, η₀ ``initial``; ``scale`` multiplies σ and η₀.

    Assumes: a centre that holds the last delivered value, and a network that grants all requests,
    since ε refers to the last request.

    Source: tobit_token_bucket, equations (11)-(15).

    Example: ``dynamic_event:scale=3`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    threshold: PerSensor = parameter(0.2, not_negative_parameter, THRESHOLD)
    decay: PerSensor = parameter(0.1, not_negative_parameter, SearchRange(1e-4, 10.0))
    divisor: PerSensor = parameter(5.0, each_number, SearchRange(1e-2, 1e4), above=0.0)
    initial: PerSensor = parameter(1.5, not_negative_parameter, THRESHOLD)
    scale: float = parameter(1.0, validation.number, at_least=0.0)
    knowledge: ClassVar[Knowledge] = "own_memory"

    def reset(self, runs: int, seed: int = 0) -> None:
        """Clear the dynamic variable and the last requested measurements."""
        self._eta: Array | None = None
        self._requested: Array | None = None

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        sensors, runs = shape_of(signals)
        sigma = self.scale * self.column("threshold", sensors)
        initial = self.scale * self.column("initial", sensors)
        measurement, start = signals["measurement"], signals["start"]
        if self._eta is None or self._requested is None:
            self._eta, self._requested = np.empty((sensors, runs)), signals["held"]
            start = np.ones(runs, dtype=np.bool_)
        eta = np.where(start, initial, self._eta)
        requested = np.where(start, signals["held"], self._requested)
        difference = requested - measurement
        size = np.sqrt(linalg.dot(difference, difference))
        request = self.limit(size >= eta / self.column("divisor", sensors) + sigma, signals)
        error = np.where(request, 0.0, size)
        decay = self.column("decay", sensors)
        self._eta = np.maximum(decay * eta + sigma - error, 0.0)
        self._requested = np.where(request[:, None], measurement, requested)
        return request


@dataclass
class SendOnDelta(LocalRule):
    r"""Request when the measurement differs from the last delivered one by ``threshold`` or more.

    A difference of ``threshold`` counts up to a millionth, so rounding does not decide. Equal
    measurements never request.

    Args:
        threshold: θ >= 0, in the unit of the measurement.
        min_interval: least steps between two deliveries of a sensor, >= 1.
        max_interval: most steps between two deliveries of a sensor; None for no limit.

    Equation:
        $$
        \delta_i(t)=1\iff \lVert y_i(t)-\bar y_i\rVert\ge\theta_i\ \text{and}\ y_i(t)\ne\bar y_i
        $$

        ȳᵢ is the last delivered measurement of sensor i, θ is ``threshold``.

    Assumes: a centre that holds the last delivered value. The threshold then bounds the error of
    the held value.

    Source: M. Miskowicz, "Send-on-delta concept: an event-based data reporting strategy",
    Sensors 6, 2006.

    Example: ``send_on_delta:threshold=3`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    threshold: PerSensor = parameter(1.0, not_negative_parameter, THRESHOLD)
    knowledge: ClassVar[Knowledge] = "own"
    stateless: ClassVar[bool] = True

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        moved = signals["measurement"] - signals["held"]
        threshold = self.column("threshold", shape_of(signals)[0])
        return self.limit(linalg.reaches(linalg.dot(moved, moved) ** 0.5, threshold), signals)


@dataclass
class ReportOnChange(LocalRule):
    r"""Request when a channel differs from its last delivered value by ``reportable_change``.

    A difference of ``reportable_change`` counts up to a millionth, so rounding does not decide.
    Equal values are never reported before ``max_interval``.

    Args:
        reportable_change: Δ >= 0, in the unit of the measurement, or in percent.
        percent: take Δ in percent of the last delivered value.
        min_interval: least steps between two deliveries of a sensor, >= 1.
        max_interval: most steps between two deliveries of a sensor; None for no limit.

    Equation:
        $$
        \delta_i(t)=1\iff a_i(t)\ge a_{\min}\ \text{and}\ \left(\max_j\,
        \lvert y_{ij}(t)-\bar y_{ij}\rvert\ge\Delta_i\ \text{or}\ a_i(t)\ge a_{\max}\right)
        $$

        ȳᵢⱼ is the last delivered value of channel j of sensor i, aᵢ the steps since then, Δ
        ``reportable_change`` (with ``percent`` Δ |ȳᵢⱼ|/100), a_min ``min_interval``, a_max
        ``max_interval``.

    Assumes: a centre that holds the last delivered values.

    Source: ZigBee Cluster Library Specification, attribute reporting: minimum and maximum
    reporting interval, reportable change.

    Example: ``report_on_change:reportable_change=2,max_interval=20`` in
    ``fusion_gym/LinearFusion-v2 filter=hold``.
    """

    reportable_change: PerSensor = parameter(1.0, not_negative_parameter, THRESHOLD)
    percent: bool = parameter(False, validation.boolean)
    knowledge: ClassVar[Knowledge] = "own"
    stateless: ClassVar[bool] = True

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        measurement, held = signals["measurement"], signals["held"]
        xp = namespace(measurement, held)
        change = self.column("reportable_change", len(measurement))[:, None]
        if self.percent:
            change = change / 100.0 * xp.abs(held)
        return self.limit(linalg.reaches(xp.abs(measurement - held), change).any(1), signals)


@dataclass
class StochasticEvent(ChanceRule, LocalRule):
    r"""Keep each sensor silent with probability exp(-w |z|² / 2), with z its innovation.

    The weight w is the paper's Z, here a multiple of the identity for each sensor. Given silence
    the posterior stays Gaussian. ``filter="stochastic"`` is the exact filter, for the innovation
    without ``whitened``.

    Args:
        weight: w >= 0, in the inverse squared unit of the measurement, or without a unit; 0 never
            requests.
        whitened: take the innovation in predicted standard deviations.
        min_interval: least steps between two deliveries of a sensor, >= 1.
        max_interval: most steps between two deliveries of a sensor; None for no limit.

    Equation:
        $$
        \Pr\{\delta_i(t)=0\}=\exp\left(-\frac{1}{2}\,w_i\,\lVert z_i(t)\rVert^2\right),\qquad
        z_i=y_i-\hat y_i
        $$

        w is ``weight``; with ``whitened`` each component of z is divided by its predicted standard
        deviation.

    Assumes: a prediction of the measurement at the sensor; for the exact posterior a linear
    Gaussian system, uncensored sensors and a network that grants all requests.

    Source: D. Han, Y. Mo, J. Wu, S. Weerakkody, B. Sinopoli and L. Shi, "Stochastic
    event-triggered sensor schedule for remote state estimation", IEEE Trans. Automatic Control
    60(10), 2015, the closed-loop schedule.

    Example: ``stochastic_event:weight=0.3`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2``.
    """

    weight: PerSensor = parameter(1.0, not_negative_parameter, THRESHOLD)
    whitened: bool = parameter(False, validation.boolean)
    knowledge: ClassVar[Knowledge] = "own"
    stream: ClassVar[int] = 0x73746F6368  # independent of the noise of the same seed

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        squared = surprise(signals, self.whitened)
        silence = np.exp(-0.5 * self.column("weight", len(squared)) * squared)
        return self.limit(self.draw(*squared.shape) >= silence, signals)


@dataclass
class BeliefRule(Rule):
    """A rule on the beliefs of the scheduler, or with ``own`` on the beliefs of each sensor.

    ``together`` names the parameters that compare sensors, which ``own`` excludes.
    """

    task: Task = field(repr=False)
    own: bool = parameter(False, validation.boolean)
    together: ClassVar[tuple[str, ...]] = ("at_most",)

    def __post_init__(self) -> None:
        super().__post_init__()
        only = {name: getattr(self, name) for name in self.together}
        check_owner(self.task, self.own, **only)
        self.memory_owner: Owner | None = "own" if self.own else "scheduler"

    @property
    def knowledge(self) -> Knowledge:
        """Depends on the task's memory and on ``own``."""
        return knows(self.task, self.own)

    def beliefs(self, signals: Signals) -> Beliefs:
        """Return the beliefs of the scheduler, or of each sensor."""
        return beliefs_of(signals, self.own)


def knows(task: Task, own: bool) -> Knowledge:
    """Return the knowledge class of a rule on beliefs, in a task with or without memory."""
    if task.options.memory:
        return "own_memory" if own else "scheduler_memory"
    return "own" if own else "scheduler"


def check_owner(task: Task, own: bool, **only_together: Any) -> None:
    """Check that a task shows the measurements, and with ``own`` allows local decisions."""
    if task.options.information != "sensors":
        allowed = "'sensors', because it reads new measurements"
        raise validation.refusal("information", task.options.information, allowed, "with this rule")
    if not own:
        return
    SensorView(task)  # refuses tasks without local decisions
    for name, value in only_together.items():
        if value not in (None, 0, 1):
            raise validation.refusal(
                name, value, "left out with own=True, because sensors decide locally"
            )


def beliefs_of(signals: Signals, own: bool) -> Beliefs:
    """Return the beliefs of the scheduler, or of each sensor."""
    result: Any = signals["own_beliefs" if own else "beliefs"]
    return result


@dataclass
class ValueOfInformation(BeliefRule):
    r"""Request the sensors whose packet has a value of at least ``threshold``, or of its price.

    The value is v(s) = ‖x* - x̂‖² - E‖x* - x̂(s)‖². x* is the best estimate, x̂ the centre's estimate
    without transmissions and x̂(s) its estimate after the packet of s only
    (:mod:`fusion_gym.core.memory`). With memory x* uses all unsent measurements, without memory
    the measurements of this step. The norm has the weights of the reward, scaled to a mean of 1. In
    most settings this is the strongest rule, above all with memory.

    Args:
        own: every sensor decides locally, by its memory and the broadcasts.
        threshold: θ >= 0, for all sensors or for each, in squared units of the states; 0.03 without
            a price.
        price: price of a token in the reward's units, instead of the threshold.
        at_most: most requests in a step, by the highest value; None for no limit.

    Raises:
        ConfigurationError: both thresholds, a value that is not allowed, ``at_most`` with
            ``own``, or a task whose policies do not see the sensors.

    Equation:
        $$
        v(s)=\lVert x^\star-\hat x\rVert_W^2-\mathrm{E}\,\lVert x^\star-\hat x(s)\rVert_W^2,\qquad
        \delta_s(t)=1\Rightarrow v(s)\ge\theta
        $$

        x* is the best estimate, x̂ the centre's estimate without transmissions, x̂(s) its estimate
        after a transmission of s only; the expectation is over the packet's arrival. W are the
        reward's weights with mean 1, θ is ``threshold``. With ``price`` p instead, v in the
        reward's units must reach p times the tokens of the transmission. With ``at_most``, the
        sensors of the highest value are requested.

    Assumes: x* is the conditional mean given the knowledge of its owner, and only this step counts.

    Sources: :mod:`fusion_gym.core.memory` lists them.

    Example: ``value_of_information:threshold=0.03,at_most=1`` in ``fusion_gym/TobitOscillator-v1
    filter=tobit random_start=True token_rate=2 memory=True``.
    """

    threshold: PerSensor | None = parameter(None, optional(not_negative_parameter), THRESHOLD)
    price: float | None = parameter(None, check_price)
    at_most: int | None = parameter(None, check_at_most)
    stateless: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.threshold is not None and self.price is not None:
            reason = "leave one of them out"
            raise forbidden("price", self.price, reason, f"with threshold = {self.threshold}")

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        value = self.beliefs(signals).value
        if self.price is None:
            least: Any = 0.03 if self.threshold is None else self.column("threshold", len(value))
        else:
            value = self.task.error_scale * value
            least = self.price * signals["token_cost"]
        return strongest(value, value >= least, self.at_most, signals["age"])


@dataclass
class EstimateDifference(BeliefRule):
    r"""Request the sensors of the highest value when ‖x* - x̂‖ >= ``threshold``.

    x* is the best estimate and x̂ the centre's estimate without transmissions
    (:mod:`fusion_gym.core.memory`). The norm has the weights of the reward, scaled to a mean of 1,
    and the unit of the states. With ``own`` and without memory it is the change of the estimate by
    the sensor's own measurement.

    Args:
        own: every sensor decides locally, by its memory and the broadcasts.
        threshold: θ >= 0, for all sensors or for each, in the unit of the states or without one.
        whitened: weigh by the inverse of the centre's estimated covariance.
        at_most: most requests in a step, by the highest value; None for no limit.

    Raises:
        ConfigurationError: a value that is not allowed, ``at_most`` with ``own``, or a task whose
            policies do not see the sensors.

    Equation:
        $$
        \lVert x^\star-\hat x\rVert_W\ge\theta\ \Rightarrow\ \text{request the sensors of the
        highest value}\ v(s)
        $$

        x* is the best estimate, x̂ the centre's estimate without transmissions, W the reward's
        weights with mean 1 (with ``whitened`` P⁻¹, P the centre's covariance of x̂), θ
        ``threshold``, v as in
        :class:`ValueOfInformation`; ``at_most`` sensors are requested. With ``own`` every sensor
        compares its own x* and x̂.

    Assumes: x* is the conditional mean given the knowledge of its owner. The squared error is then
    the squared error of x*, which no decision changes, plus the squared difference.

    Sources: Y. Xu and J. P. Hespanha, "Optimal communication logics in networked control systems",
    IEEE CDC 2004; G. M. Lipsa and N. C. Martins, "Remote state estimation with communication costs
    for first-order LTI systems", IEEE Trans. Automatic Control 56, 2011.

    Example: ``estimate_difference:threshold=0.25`` in ``fusion_gym/TobitOscillator-v1 filter=tobit
    random_start=True token_rate=2 memory=True``.
    """

    threshold: PerSensor = parameter(0.2, not_negative_parameter, THRESHOLD)
    whitened: bool = parameter(False, validation.boolean)
    at_most: int | None = parameter(1, check_at_most)
    stateless: ClassVar[bool] = True

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        beliefs, age = self.beliefs(signals), signals["age"]
        squared = beliefs.loss
        if self.whitened:
            difference, covariance = beliefs.difference, beliefs.silent.covariance
            squared = linalg.dot(difference, linalg.solve_vector(covariance, difference))
        due = squared >= self.column("threshold", len(age)) ** 2
        requests = namespace(due).broadcast_to(due, age.shape)
        if self.own or self.at_most is None:
            return requests.copy()
        return strongest(beliefs.value, requests, self.at_most, age)


@dataclass
class KullbackLeibler(BeliefRule):
    r"""Request where a packet changes the centre's density by at least ``threshold`` nats.

    D(s) = ½ (tr P⁻¹ P_s - n + δᵀ P⁻¹ δ + ln det P - ln det P_s), with δ = x̂(s) - x̂, is the
    divergence from N(x̂(s), P_s) to N(x̂, P). The former is the centre's density after the packet of
    s only, the latter its prediction. With ``own`` the best estimate x*, which has the sensor's
    memory, replaces x̂(s). D counts a reduction of the variance even if the mean does not change.

    Args:
        own: every sensor decides locally, by its memory and the broadcasts.
        threshold: θ >= 0, for all sensors or for each, in nats.
        at_most: most requests in a step, by the highest divergence; None for no limit.

    Raises:
        ConfigurationError: a value that is not allowed, ``at_most`` with ``own``, or a task whose
            policies do not see the sensors.

    Equation:
        $$
        D(s)=\frac{1}{2}\left(\mathrm{tr}(P^{-1}P_s)-n+\delta^{\mathsf
        T}P^{-1}\delta+\ln\frac{\det P}{\det P_s}\right)\ge\theta,\qquad \delta=\hat x(s)-\hat x
        $$

        N(x̂, P) is the centre's density without transmissions, N(x̂(s), P_s) after the packet of s
        only, n the number of states, θ ``threshold`` in nats.

    Assumes: Gaussian densities, and correct covariances of the estimators.

    Source: J. W. Marck and J. Sijs, "Relevant sampling applied to event-based state-estimation",
    SENSORCOMM 2010.

    Example: ``kullback_leibler:threshold=0.8,at_most=1`` in ``fusion_gym/TobitOscillator-v1
    filter=tobit random_start=True token_rate=2 memory=True``.
    """

    threshold: PerSensor = parameter(0.5, not_negative_parameter, THRESHOLD)
    at_most: int | None = parameter(None, check_at_most)
    stateless: ClassVar[bool] = True

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        beliefs = self.beliefs(signals)
        divergence = _divergence(beliefs.best if self.own else beliefs.sent, beliefs.silent)
        due = divergence >= self.column("threshold", len(divergence))
        return strongest(divergence, due, self.at_most, signals["age"])


def _divergence(estimate: Estimate, silent: Estimate) -> Array:
    """Return the divergence from one Gaussian to another, in nats (sensors, N)."""
    difference = estimate.mean - silent.mean
    size = difference.shape[-2]
    spread = linalg.trace(linalg.solve(silent.covariance, estimate.covariance))
    distance = linalg.dot(difference, linalg.solve_vector(silent.covariance, difference))
    volume = _log_determinant(silent.covariance) - _log_determinant(estimate.covariance)
    return 0.5 * (spread - size + distance + volume)


def _log_determinant(covariance: Array) -> Array:
    root = linalg.diagonal(linalg.cholesky(covariance))
    return 2.0 * linalg.total(namespace(root).log(root))


Score = Literal["value", "innovation", "variance"]


def _power(
    deviation: float, low: float = -3.0, high: float = 3.0, per_sensor: bool = False
) -> SearchRange:
    return SearchRange(low, high, per_sensor, logarithmic=False, deviation=deviation)


_SHARE = _power(0.1, 0.0, 1.0)
_PRICED = SearchRange(0.0, np.inf, deviation=0.15)
_MARGIN = SearchRange(1.0, float(np.exp(4.0)), per_sensor=False, deviation=0.15)


@dataclass
class PricedThreshold(BeliefRule):
    r"""Request where a mixture of value and loss reaches a threshold that depends on the price.

    A search (:mod:`fusion_gym.evaluation.rule_search`) sets its dozen parameters for all prices at
    once, instead of one threshold for each price.

    Args:
        own: every sensor decides locally, by its memory and the broadcasts.
        score: v and l. ``"value"``: the expected value of a packet and the squared norm of x* - x̂
            (:mod:`fusion_gym.core.memory`). ``"innovation"``: the squared norm of the innovation,
            v in predicted standard deviations, l in the unit of the measurement. ``"variance"``:
            the reduction of the fused trace by a packet, and the trace without packets, both
            predicted by the centre.
        threshold: θ >= 0 at the reference price, for all sensors or for each, in the unit of the
            score.
        price_exponent: β, for all sensors or for each; 1 is proportional to the price.
        price: price of a token; None for the price in the reward, which an episode may draw.
        reference_price: p₀ > 0.
        mixture: m, from 0 (v only) to 1 (l only).
        token_exponent: κ; above 0 few tokens lower the threshold, below 0 they raise it.
        age_exponent: α; above 0 a long silence raises the threshold, below 0 it lowers it.
        margin: s >= 1, the factor by which each further sensor in the same step must exceed its
            threshold at the reference price; 1 for no margin.
        margin_exponent: μ; above 0 the margin grows with the price, and is never below 1.

    Raises:
        ConfigurationError: a value that is not allowed, a margin with ``own``, ``own`` with the
            variance, or, except with the variance, a task whose policies do not see the sensors.

    Equation:
        $$
        r_i=\frac{v_i^{1-m}\,l^m}{\theta_i}\left(\frac{p}{p_0}\right)^{-\beta_i}
        \left(\frac{b+1}{\bar b+1}\right)^{-\kappa}\left(\frac{a_i+1}{6}\right)^{-\alpha},\qquad
        \delta_i(t)=1\iff v_i>0,\ r_i\ge\max\{1,s\,(p/p_0)^\mu\}^{k_i}
        $$

        vᵢ and l are the ``score``, p is the price of a token, b the tokens and b̄ their capacity
        (the ratio is 1 where tokens are unlimited). aᵢ are the steps since the last delivery, kᵢ is
        the number of sensors with a larger r in this step. θ is ``threshold``, β
        ``price_exponent``, p₀ ``reference_price``, m ``mixture``, κ ``token_exponent``, α
        ``age_exponent``, s ``margin``, μ ``margin_exponent``.

    Assumes: the assumptions of the rule of its score, ``value_of_information``,
    ``innovation_threshold`` or ``variance_threshold``; numbers that were searched for this task.

    Source: none; the scores are from these three rules, the powers from this library.

    Example: ``priced_threshold:threshold=0.03,reference_price=0.02`` in
    ``fusion_gym/TobitOscillator-v1 filter=tobit random_start=True token_rate=2 cost_weight=0.01
    memory=True``.
    """

    score: Score = parameter("value", validation.choice, options=get_args(Score))
    threshold: PerSensor = parameter(0.03, not_negative_parameter, _PRICED)
    price_exponent: PerSensor = parameter(1.0, each_number, _power(0.075, -1.0, 4.0, True))
    price: float | None = parameter(None, check_price)
    reference_price: float = parameter(1.0, validation.number, above=0.0)
    mixture: float = parameter(0.0, validation.number, _SHARE, at_least=0.0, at_most=1.0)
    token_exponent: float = parameter(0.0, validation.number, _power(0.15))
    age_exponent: float = parameter(0.0, validation.number, _power(0.1))
    margin: float = parameter(1.0, validation.number, _MARGIN, at_least=1.0)
    margin_exponent: float = parameter(0.0, validation.number, _power(0.075))
    together: ClassVar[tuple[str, ...]] = ("margin", "margin_exponent")
    stateless: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.score == "variance":
            Rule.__post_init__(self)
            if self.own:
                raise validation.refusal("own", self.own, "false with score='variance'")
        else:
            super().__post_init__()
        if self.score != "value":
            self.memory_owner = None

    @property
    def knowledge(self) -> Knowledge:
        """Depends on the score, the task's memory and the comparison of sensors."""
        if self.score == "innovation":
            return "scheduler" if self.margin != 1.0 or self.margin_exponent else "own"
        return "centre" if self.score == "variance" else super().knowledge

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        return self.log_ratio(signals) >= 0.0

    def log_ratio(self, signals: Signals) -> Array:
        """Return ln r - k ln max{1, s (p/p0)^μ} (sensors, N); a request is at least 0."""
        value, loss = self._scores(signals)
        bucket, sensors = self.task.network.bucket, len(value)
        xp = namespace(value)
        age = xp.maximum(signals["age"], 0.0)
        price = signals["price"] if self.price is None else np.asarray(self.price)
        level = signals["energy" if bucket.per_sensor else "tokens"]
        tokens = (level + 1.0) / (bucket.capacity + 1.0)
        log_price = _log(price / self.reference_price)
        least = _log(self.column("threshold", sensors))
        least = least + self.column("price_exponent", sensors) * log_price
        if not bucket.unlimited:
            least = least + self.token_exponent * xp.log(tokens)
        least = least + self.age_exponent * xp.log((age + 1.0) / 6.0)
        score = (1.0 - self.mixture) * _log(value) + self.mixture * _log(loss)
        ratio = xp.where(value > 0.0, score - least, -np.inf)
        margin = xp.maximum(_log(self.margin) + self.margin_exponent * log_price, 0.0)
        if xp is not np or margin.any():
            rank = xp.argsort(xp.lexsort((-age, -ratio), axis=0), axis=0)
            ratio = ratio - rank * margin
        return cast(Array, ratio)

    def _scores(self, signals: Signals) -> tuple[Array, Array]:
        """Return the two scores v (sensors, N) and l (…, N)."""
        if self.score == "innovation":
            return surprise(signals, whitened=True), surprise(signals)
        if self.score == "variance":
            return signals["variance_reduction"], signals["silent_variance"]
        beliefs = self.beliefs(signals)
        return beliefs.value, beliefs.loss


def _log(values: Any) -> Array:
    """Return ln of values >= 0, finite at 0."""
    xp = namespace(values)
    result: Array = xp.log(xp.maximum(values, 1e-300))
    return result
