"""The fusion rules by name: what each assumes of the estimates, and why it is refused elsewhere."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.fusion.intersection import (
    SequentialIntersection,
    covariance_intersection,
    inverse_covariance_intersection,
)
from fusion_gym.fusion.rules import FusionRule, InformationFusion, MatrixWeightedFusion
from fusion_gym.fusion.several import CovarianceIntersection
from fusion_gym.validation import ConfigurationError

MOST_TOGETHER = 40  # sensors whose estimates a rule joins at once, at a cost of their cube
Assumption = Literal[
    "nothing",
    "common information",
    "independence",
    "information shares",
    "joint covariance",
    "tracked weights",
]

# Why a rule is refused where its assumption does not hold. The inverse intersections assume common
# information, and they are offered without it, as their papers do: they are then no bound.
REASONS: dict[Assumption, str] = {
    "independence": (
        "the errors of these estimates are correlated ({common}), and adding their information "
        "would count what they share several times"
    ),
    "information shares": (
        "nothing is fed back to the nodes that could share information out among them, and the "
        "errors of these estimates are correlated ({common})"
    ),
    "joint covariance": "the joint covariance of the errors is not known ({common})",
    "tracked weights": "'ci' has the exact weights here",
}


@dataclass(frozen=True)
class FusionRow:
    """A row of the table.

    ``make`` gives the rule, for an ``order`` of arrival where it has one; the docstring of its
    class has the equation, the assumption and the source. ``assumes`` is what it needs to hold for
    its covariance to be a bound, ``pair`` means exactly two estimates, ``ordered`` that the order
    belongs to it, and ``cubic`` that its cost grows with the cube of the number of estimates.
    """

    make: Callable[..., FusionRule]
    assumes: Assumption
    meaning: str
    pair: bool = False
    ordered: bool = False
    cubic: bool = False


_IN_TURN = partial(SequentialIntersection, covariance_intersection)
_INVERSE = partial(SequentialIntersection, inverse_covariance_intersection)
RULES = {
    "federated": FusionRow(
        InformationFusion, "information shares", "Sum of informations, fed back in shares."
    ),
    "information": FusionRow(InformationFusion, "independence", "Sum of informations."),
    "matrix": FusionRow(
        MatrixWeightedFusion, "joint covariance", "Sum with the best matrix weights.", cubic=True
    ),
    "sici": FusionRow(
        _INVERSE, "common information", "Inverse covariance intersection, two by two.", ordered=True
    ),
    "sci": FusionRow(
        _IN_TURN, "nothing", "Covariance intersection, two by two: a bound.", ordered=True
    ),
    "ci": FusionRow(
        CovarianceIntersection,
        "nothing",
        "Covariance intersection of all: a bound. Its weights depend on the states' units.",
        cubic=True,
    ),
    "exact_ci": FusionRow(
        CovarianceIntersection, "tracked weights", "The same with exact weights.", cubic=True
    ),
    "ici": FusionRow(
        _INVERSE, "common information", "Inverse covariance intersection of a pair.", pair=True
    ),
}


@dataclass(frozen=True)
class Structure:
    """What is known of the errors of the estimates that a centre joins.

    ``common`` says in words what makes them correlated, ``holds`` are the assumptions that hold
    all the same, and ``prediction`` says that estimate 0 is the centre's own prediction.
    """

    common: str
    holds: tuple[Assumption, ...] = ()
    prediction: bool = False

    @property
    def offered(self) -> tuple[str, ...]:
        """Names of the rules that are sound for these estimates."""
        return tuple(name for name, rule in RULES.items() if self.refusal(rule) is None)

    def refusal(self, rule: FusionRow) -> str | None:
        """Why the rule is not for these estimates, or ``None``."""
        if rule.assumes in self.holds or rule.assumes not in REASONS:
            return None
        return REASONS[rule.assumes].format(common=self.common)


def choose_rule(
    name: Any, structure: Structure, sensors: int, order: ArrayLike | None = None
) -> FusionRule:
    """The rule of the options ``fusion`` and ``order`` for the estimates of so many sensors.

    ``order`` is the sensors' order of arrival; a prediction comes before all of them.

    Raises:
        ConfigurationError: an unknown rule, one that is unsound for this structure, "ici" for
            other than two estimates, more than 40 sensors for a rule that is cubic in them, an
            order for a rule that has none, or one that is no permutation of the sensors 0 to
            l - 1.
    """
    known = structure.offered
    if isinstance(name, str) and name in RULES and name not in known:
        raise ConfigurationError(
            f"fusion = {name!r} is not allowed: it must be one of "
            f"{', '.join(map(repr, known))}, for {structure.refusal(RULES[name])}"
        )
    rule = RULES[validation.choice("fusion", name, known)]
    if rule.pair and sensors + structure.prediction != 2:
        prediction = " (the centre's prediction is one of them)" if structure.prediction else ""
        raise ConfigurationError(
            f"fusion = {name!r} is not allowed with {sensors} sensors: it joins two "
            f"estimates{prediction}; it must be 'sici' (two at a time) for more"
        )
    if rule.cubic and sensors > MOST_TOGETHER:
        others = [key for key in known if not RULES[key].cubic and not RULES[key].pair]
        instead = f", so it must be {' or '.join(map(repr, others))}" if others else ""
        raise ConfigurationError(
            f"fusion = {name!r} is not allowed with {sensors} sensors: it joins the estimates of "
            f"at most {MOST_TOGETHER}, for its cost grows with the cube of their number{instead}"
        )
    if order is None:
        return rule.make()
    if not rule.ordered:
        raise ConfigurationError(
            f"order = {validation.display(order)} is not allowed with fusion={name!r}: it belongs "
            "to the sequential rules 'sici' and 'sci'"
        )
    arrival = _arrival(order, sensors)
    return rule.make(order=(0, *(i + 1 for i in arrival)) if structure.prediction else arrival)


def _arrival(order: ArrayLike, sensors: int) -> tuple[int, ...]:
    values = validation.array("order", order, (sensors,))
    if sorted(values.tolist()) != list(range(sensors)):
        raise ConfigurationError(
            f"order = {validation.display(order)} is not allowed: it must hold each of the "
            f"sensors 0 to {sensors - 1} once"
        )
    return tuple(int(sensor) for sensor in values)
