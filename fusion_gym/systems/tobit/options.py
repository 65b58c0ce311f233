"""Options of environments whose nodes get the fused estimate back: fusion rule and centre."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from fusion_gym.core.options import CommonOptions, plain
from fusion_gym.fusion.table import Structure, choose_rule
from fusion_gym.systems.tobit.centre import Feedback, FeedbackCentre, SequentialCentre
from fusion_gym.systems.tobit.filters import NodeFilter, StochasticEventFilter
from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.systems.tobit.tobit_filter import AssumedDensityFilter
from fusion_gym.validation import ConfigurationError

_STRUCTURE = Structure(
    common="all nodes start from the same prediction", holds=("information shares",)
)


@dataclass(frozen=True)
class FeedbackOptions(CommonOptions):
    """How the nodes are joined; ``None`` is the default of the filter and the rule.

    ``fusion`` is "federated" (with ``information_shares``, equal by default) or a form of
    covariance intersection, the sequential ones with an ``order`` of arrival.
    ``stochastic_weight`` belongs to ``filter="stochastic"`` and its policy.
    """

    fusion: str | None = None
    information_shares: ArrayLike | None = None
    order: ArrayLike | None = None
    stochastic_weight: ArrayLike | None = None


def feedback_centre(chosen: FeedbackOptions, node: NodeFilter) -> FeedbackCentre:
    """Nodes with this filter and the options' fusion.

    Raises:
        ConfigurationError: a rule that does not fit, or an option that is not the rule's.
    """
    sensors = node.sensors.count
    kind = "federated" if chosen.fusion is None else chosen.fusion
    fusion = choose_rule(kind, _STRUCTURE, sensors, chosen.order)
    if kind == "federated":
        return FeedbackCentre(node, fusion, Feedback.in_shares(chosen.information_shares, sensors))
    _refuse(chosen, ("information_shares",), f"fusion={kind!r}", "fusion='federated'")
    return FeedbackCentre(node, fusion, Feedback(sensors))


def stochastic_centre(chosen: FeedbackOptions, sensors: CensoredSensors) -> FeedbackCentre:
    """The centre of ``filter="stochastic"``.

    Raises:
        ConfigurationError: no weight or one that is not allowed, or an option that does not fit.
    """
    return feedback_centre(chosen, StochasticEventFilter.create(sensors, chosen.stochastic_weight))


def stochastic_defaults(chosen: FeedbackOptions, kind: str) -> dict[str, dict[str, Any]]:
    """The scenario's parameters of the policy ``stochastic_event``, if the filter knows it.

    Raises:
        ConfigurationError: a weight for another filter.
    """
    if kind == "stochastic":
        return {"stochastic_event": {"weight": plain(chosen.stochastic_weight)}}
    _refuse(chosen, ("stochastic_weight",), f"filter={kind!r}", "filter='stochastic'")
    return {}


def assumed_density_centre(chosen: FeedbackOptions, sensors: CensoredSensors) -> SequentialCentre:
    """The centre of ``filter="adf"``.

    Raises:
        ConfigurationError: an option of the nodes' fusion, for there are no nodes.
    """
    _refuse(
        chosen,
        ("fusion", "information_shares", "order"),
        "filter='adf'",
        "a filter with nodes (here the centre takes the measurements itself)",
    )
    return SequentialCentre(AssumedDensityFilter(sensors))


def _refuse(chosen: FeedbackOptions, names: tuple[str, ...], where: str, belongs: str) -> None:
    for name in names:
        value = getattr(chosen, name)
        if value is not None:
            raise ConfigurationError(
                f"{name} = {value!r} is not allowed with {where}: it belongs to {belongs}"
            )
