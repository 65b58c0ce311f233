"""The fusion rules by name, their assumptions, and the reasons for a refusal."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.errors import forbidden
from fusion_gym.fusion import intersection
from fusion_gym.fusion.rules import FusionRule, InformationFusion, MatrixWeightedFusion
from fusion_gym.fusion.several import CovarianceIntersection

MOST_TOGETHER = 40  # sensors of a rule with cubic cost
Assumption = Literal[
    "nothing",
    "common information",
    "independence",
    "information shares",
    "joint covariance",
    "tracked weights",
]

# Reasons for the refusal of a rule. Without common information the inverse intersections are no
# bound, but they are offered, as in their papers.
REASONS: dict[Assumption, str] = {
    "independence": (
        "the errors of these estimates are correlated ({common}), but this rule assumes "
        "independent errors"
    ),
    "information shares": (
        "the centre feeds no shares of information back to the nodes, and the errors of these "
        "estimates are correlated ({common})"
    ),
    "joint covariance": "the joint covariance of the errors is not known ({common})",
    "tracked weights": "'ci' has the exact weights here",
}


@dataclass(frozen=True)
class FusionRow:
    """A row of the table of fusion rules.

    Args:
        make: Function that returns the rule, for an ``order`` of arrival if it has one.
        assumes: Assumption under which its covariance is a bound.
        meaning: Short description.
        pair: Whether it joins exactly two estimates.
        ordered: Whether it has an order of arrival.
        cubic: Whether its cost grows with the cube of the number of estimates.
    """

    make: Callable[..., FusionRule]
    assumes: Assumption
    meaning: str
    pair: bool = False
    ordered: bool = False
    cubic: bool = False


_IN_TURN = intersection.SequentialIntersection
_INVERSE = partial(_IN_TURN, intersection.inverse_covariance_intersection)
RULES = {
    "federated": FusionRow(
        InformationFusion, "information shares", "Sum of information, fed back in shares."
    ),
    "information": FusionRow(InformationFusion, "independence", "Sum of information."),
    "matrix": FusionRow(
        MatrixWeightedFusion, "joint covariance", "Sum with optimal matrix weights.", cubic=True
    ),
    "sici": FusionRow(
        _INVERSE, "common information", "Sequential inverse covariance intersection.", ordered=True
    ),
    "sci": FusionRow(
        _IN_TURN, "nothing", "Sequential covariance intersection: a bound.", ordered=True
    ),
    "ci": FusionRow(
        CovarianceIntersection,
        "nothing",
        "Covariance intersection of all: a bound. Explicit ``state_weights`` weigh its trace.",
        cubic=True,
    ),
    "exact_ci": FusionRow(
        CovarianceIntersection,
        "tracked weights",
        "Covariance intersection of all with exact weights: a bound.",
        cubic=True,
    ),
    "ici": FusionRow(
        _INVERSE, "common information", "Inverse covariance intersection of a pair.", pair=True
    ),
}


@dataclass(frozen=True)
class Structure:
    """The correlation structure of the errors of the estimates that a centre joins.

    Args:
        common: Cause of the correlation, in words.
        holds: Assumptions that hold nevertheless.
        prediction: Whether estimate 0 is the centre's own prediction.
    """

    common: str
    holds: tuple[Assumption, ...] = ()
    prediction: bool = False

    @property
    def offered(self) -> tuple[str, ...]:
        """Names of the rules whose assumption holds for these estimates."""
        return tuple(name for name, rule in RULES.items() if self.refusal(rule) is None)

    def refusal(self, rule: FusionRow) -> str | None:
        """Return the reason why the rule is refused for these estimates, or ``None``."""
        if rule.assumes in self.holds or rule.assumes not in REASONS:
            return None
        return REASONS[rule.assumes].format(common=self.common)


def choose_rule(
    name: Any,
    structure: Structure,
    sensors: int,
    order: ArrayLike | None = None,
    state_weights: Array | None = None,
) -> FusionRule:
    """Return the rule of the options ``fusion`` and ``order``.

    Args:
        name: Name of a rule.
        structure: Structure of the estimates' errors.
        sensors: Number of sensors.
        order: Order of arrival of the sensors; the centre's prediction precedes them.
        state_weights: Weights (n,) of the trace that the rule minimises; by default all 1.

    Raises:
        ConfigurationError: The rule is unknown, refused for this structure or this number of
            estimates, or ``order`` is no permutation or does not belong to the rule.
    """
    known = structure.offered
    if isinstance(name, str) and name in RULES and name not in known:
        allowed = f"one of {', '.join(map(repr, known))}, because {structure.refusal(RULES[name])}"
        raise validation.refusal("fusion", name, allowed)
    rule = RULES[validation.choice("fusion", name, known)]
    if rule.pair and sensors + structure.prediction != 2:
        prediction = " (the centre's prediction is one of them)" if structure.prediction else ""
        raise validation.ConfigurationError(
            f"fusion = {name!r} is not allowed with {sensors} sensors: it joins two "
            f"estimates{prediction}; for more it must be 'sici', which joins two at a time"
        )
    if rule.cubic and sensors > MOST_TOGETHER:
        others = [key for key in known if not RULES[key].cubic and not RULES[key].pair]
        instead = f", so it must be {' or '.join(map(repr, others))}" if others else ""
        raise validation.ConfigurationError(
            f"fusion = {name!r} is not allowed with {sensors} sensors: it joins the estimates of "
            f"at most {MOST_TOGETHER}, because its cost grows with the cube of their "
            f"number{instead}"
        )
    if order is None:
        return rule.make().with_weights(state_weights)
    if not rule.ordered:
        reason = "it belongs to the sequential rules 'sici' and 'sci'"
        raise forbidden("order", order, reason, f"with fusion={name!r}")
    arrival = _arrival(order, sensors)
    if structure.prediction:
        arrival = (0, *(i + 1 for i in arrival))
    return rule.make(order=arrival).with_weights(state_weights)


def _arrival(order: ArrayLike, sensors: int) -> tuple[int, ...]:
    values = validation.array("order", order, (sensors,))
    if sorted(values.tolist()) != list(range(sensors)):
        raise forbidden("order", order, f"it must hold each of the sensors 0 to {sensors - 1} once")
    return tuple(int(sensor) for sensor in values)
