"""Rules that use the clock, the order of grants, or covariances, and no measurement."""

from dataclasses import dataclass
from typing import ClassVar, cast

import numpy as np

from fusion_gym import validation
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.namespace import namespace
from fusion_gym.policies.base import (
    INTERVAL,
    SHARED_THRESHOLD,
    THRESHOLD,
    ChanceRule,
    PerSensor,
    Requests,
    Rule,
    SearchRange,
    check_at_most,
    each_number,
    not_negative_parameter,
    parameter,
    shape_of,
    strongest,
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

    Assumes: claimed covariances that are true.

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

    Assumes: claimed covariances that are true.

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
        reduction = signals["variance_reduction"]
        due = namespace(reduction).broadcast_to(
            signals["silent_variance"] >= self.threshold, reduction.shape
        )
        return strongest(reduction, due, self.at_most, signals["age"])


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

    Assumes: claimed covariances that are true, and that only the next step counts.

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
