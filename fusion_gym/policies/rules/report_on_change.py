"""Report on change: what devices in buildings, plants and farms run."""

from dataclasses import dataclass
from typing import ClassVar

from fusion_gym import validation
from fusion_gym.core.knowledge import Knowledge, Signals
from fusion_gym.namespace import namespace
from fusion_gym.policies.base import (
    LocalRule,
    PerSensor,
    Requests,
    not_negative_parameter,
    parameter,
)


@dataclass
class ReportOnChange(LocalRule):
    r"""Request when a channel differs from its last delivered value by ``reportable_change``.

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

    reportable_change: PerSensor = parameter(1.0, not_negative_parameter)
    percent: bool = parameter(False, validation.boolean)
    knowledge: ClassVar[Knowledge] = "own"

    def __call__(self, signals: Signals) -> Requests:
        """Return the requests (sensors, N)."""
        measurement, held = signals["measurement"], signals["held"]
        xp = namespace(measurement, held)
        change = self.column("reportable_change", len(measurement))[:, None]
        if self.percent:
            change = change / 100.0 * xp.abs(held)
        return self.limit((xp.abs(measurement - held) >= change).any(1), signals)
