"""Options of environments with feedback of the fused estimate: filters and fusion rule."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym.core.nature import Nature
from fusion_gym.core.options import PaperOptions, plain_options
from fusion_gym.errors import forbidden
from fusion_gym.fusion.table import Structure, choose_rule
from fusion_gym.systems.linear_plant import LinearPlant, typical_magnitude
from fusion_gym.systems.tobit.centre import (
    Centre,
    FederatedCentre,
    FeedbackCentre,
    SequentialCentre,
    information_shares,
)
from fusion_gym.systems.tobit.filters import KalmanFilter, NodeFilter, StochasticEventFilter
from fusion_gym.systems.tobit.sensors import CensoredSensors
from fusion_gym.systems.tobit.system import CensoredEstimator, CensoredPlant
from fusion_gym.systems.tobit.tobit_filter import AssumedDensityFilter
from fusion_gym.validation import choice

_OF_FUSION = ("fusion", "information_shares", "order")
_STRUCTURE = Structure(
    common="all nodes start from the same prediction", holds=("information shares",)
)


@dataclass(frozen=True)
class FeedbackOptions(PaperOptions):
    """Options of the fusion and its feedback; ``None`` is the default of the filter or the rule."""

    structure: ClassVar[Structure | None] = _STRUCTURE
    fusion: Annotated[str | None, _STRUCTURE.offered] = None
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


@dataclass(frozen=True)
class Filter:
    """A row of a table of filters: its class, and the function that makes its centre.

    The docstring of ``kind`` has meaning, equation, assumption and source. ``own`` are options of
    this filter only; for other filters they are ``None``. ``nodes`` says whether the filter has
    nodes; without nodes the options of their fusion are ``None``.
    """

    kind: type
    make: Callable[[Any, CensoredSensors], Centre]
    own: tuple[str, ...] = ()
    nodes: bool = True


def at_the_nodes(kind: Any) -> Filter:
    """Return the row of a node filter without options of its own."""
    return Filter(kind, lambda options, sensors: feedback_centre(options, kind(sensors)))


def classes(filters: Mapping[str, Filter]) -> dict[str, type]:
    """Return the class of each filter of a table."""
    return {name: row.kind for name, row in filters.items()}


def make_centre(
    kind: str, filters: Mapping[str, Filter], options: FeedbackOptions, sensors: CensoredSensors
) -> Centre:
    """Return the centre of the option ``filter``.

    Args:
        kind: the filter's name.
        filters: the table of filters.
        options: options of the environment.
        sensors: the sensors.

    Raises:
        ConfigurationError: an unknown filter, or an option of another filter.
    """
    choice("filter", kind, filters)
    where = f"filter={kind!r}"
    for name, row in filters.items():
        if name != kind:
            _refuse(options, row.own, where, f"filter={name!r}")
    if not filters[kind].nodes:
        belongs = "a filter with nodes (here the centre uses the measurements)"
        _refuse(options, _OF_FUSION, where, belongs)
    return filters[kind].make(options, sensors)


def make_parts(
    options: FeedbackOptions,
    plant: LinearPlant,
    centre: Centre,
    state_names: tuple[str, ...],
    reference_horizon: int,
    model: LinearPlant | None = None,
    random_start: bool = False,
) -> tuple[CensoredPlant, CensoredEstimator]:
    """Return plant and estimator of a linear plant and a centre.

    Args:
        options: options of the environment.
        plant: the true plant.
        centre: nodes and centre.
        state_names: names of the states.
        reference_horizon: steps without transmissions whose variances scale observed variances.
        model: the plant that the filters assume, by default ``plant``.
        random_start: whether the initial mean has a random direction.

    Raises:
        ConfigurationError: a departure of the truth that is not allowed, or has no effect.
    """
    absent = ("true_threshold_shift",) if centre.sensors.unlimited else ()
    nature = Nature.create(options, (*plant.unmoved, *absent))
    nature.check_growth(plant.true_radius, options.horizon)
    plant.warn_of_unseen_growth(centre.sensors.stacked_matrix, state_names)
    estimator = CensoredEstimator(
        model=plant if model is None else model,
        centre=centre,
        state_names=state_names,
        scale=typical_magnitude(plant, options.horizon, random_start),
        reference=plant.open_loop(min(options.horizon, reference_horizon)),
    )
    return CensoredPlant(plant, centre.sensors, state_names, random_start, nature), estimator


def memory_filter_estimator(
    estimator: CensoredEstimator,
    kind: str | None,
    filters: Mapping[str, Filter],
    options: FeedbackOptions,
) -> CensoredEstimator | None:
    """Return the estimator with the filter of the option ``memory_filter``, or ``None``.

    Its options are the environment's own where both filters have them, and otherwise defaults.

    Args:
        estimator: the estimator.
        kind: name of the memory's filter, or None.
        filters: the table of filters.
        options: options of the environment.

    Raises:
        ConfigurationError: an unknown filter, or a missing option.
    """
    if kind is None:
        return None
    row = filters[choice("memory_filter", kind, filters)]
    changed: dict[str, Any] = {"filter": kind}
    if not row.nodes:
        changed |= dict.fromkeys(_OF_FUSION)
    made = row.make(replace(options, **changed), estimator.centre.sensors)
    return replace(estimator, centre=made)


def feedback_centre(options: FeedbackOptions, node: NodeFilter) -> Centre:
    """Return nodes with this filter and the options' fusion.

    Args:
        options: options of the environment.
        node: the nodes' filter.

    Raises:
        ConfigurationError: a rule that does not fit, or an option of another rule.
    """
    sensors = node.sensors.count
    kind = "federated" if options.fusion is None else options.fusion
    weights = options.own_weights(node.sensors.measurement_matrix.shape[2])
    fusion = choose_rule(kind, _STRUCTURE, sensors, options.order, weights)
    if kind == "federated":
        share = information_shares(options.information_shares, sensors)
        if isinstance(node, KalmanFilter):
            return FederatedCentre(node, share)
        return FeedbackCentre(node, share, fusion)
    _refuse(options, ("information_shares",), f"fusion={kind!r}", "fusion='federated'")
    return FeedbackCentre(node, np.ones((sensors, 1)), fusion)


def stochastic_defaults(options: FeedbackOptions) -> dict[str, dict[str, Any]]:
    """Return the parameters of the policy ``stochastic_event``, if the filter uses it."""
    if options.stochastic_weight is None:
        return {}
    return {"stochastic_event": {"weight": plain_options(options.stochastic_weight)}}


# What every environment of the family offers; each adds its paper's own.
FILTERS = {
    "kalman": at_the_nodes(KalmanFilter),
    "adf": Filter(
        AssumedDensityFilter,
        lambda _, sensors: SequentialCentre(AssumedDensityFilter(sensors)),
        nodes=False,
    ),
    "stochastic": Filter(
        StochasticEventFilter,
        lambda options, sensors: feedback_centre(
            options, StochasticEventFilter.create(sensors, options.stochastic_weight)
        ),
        own=("stochastic_weight",),
    ),
}


def _refuse(options: FeedbackOptions, names: tuple[str, ...], where: str, belongs: str) -> None:
    for name in names:
        value = getattr(options, name)
        if value is not None:
            raise forbidden(name, value, f"it belongs to {belongs}", f"with {where}")
