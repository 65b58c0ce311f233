"""Options of environments with feedback of the fused estimate: filters and fusion rule."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fusion_gym.core.plant import Nature
from fusion_gym.core.task import PaperOptions, Scenario
from fusion_gym.declaration import plain_options
from fusion_gym.errors import forbidden, refusal
from fusion_gym.fusion.table import Structure, choose_rule
from fusion_gym.systems.linear_plant import LinearPlant, typical_magnitude
from fusion_gym.systems.tobit import centre as fusion_centre
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
    make: Callable[[Any, CensoredSensors], fusion_centre.Centre]
    own: tuple[str, ...] = ()
    nodes: bool = True


def at_the_nodes(kind: Any) -> Filter:
    """Return the row of a node filter without options of its own."""
    return Filter(kind, lambda options, sensors: feedback_centre(options, kind(sensors)))


def classes(filters: Mapping[str, Filter]) -> dict[str, type]:
    """Return the class of each filter of a table."""
    return {name: row.kind for name, row in filters.items()}


def feedback_scenario(
    options: Any,
    filters: Mapping[str, Filter],
    plant: LinearPlant,
    sensors: CensoredSensors,
    state_names: tuple[str, ...],
    reference_horizon: int,
    *,
    memory_filter: str | None,
    policy_defaults: Mapping[str, dict[str, Any]] | None = None,
    random_start: bool = False,
    model: LinearPlant | None = None,
    known_start: bool = False,
    **others: Any,
) -> Scenario:
    """Return the scenario of a linear plant, its sensors and the option ``filter``.

    Options of the memory's filter are the environment's own where both filters have them, and
    otherwise defaults.

    Args:
        options: options of the environment.
        filters: the table of filters.
        plant: the true plant.
        sensors: the sensors.
        state_names: names of the states.
        reference_horizon: steps without transmissions whose variances scale observed variances.
        memory_filter: name of the memory's filter, or None for the same filter.
        policy_defaults: parameters of policies.
        random_start: whether the initial mean has a random direction.
        model: the plant that the filters assume, by default ``plant``.
        known_start: whether the estimate begins with the first measurement of every sensor.
        **others: other fields of the scenario.

    Raises:
        ConfigurationError: an unknown filter, an option of another filter, or a departure of the
            truth that is not allowed or has no effect.
    """
    kind = choice("filter", options.filter, filters)
    where = f"filter={kind!r}"
    for name, row in filters.items():
        if name != kind:
            _refuse(options, row.own, where, f"filter={name!r}")
    if not filters[kind].nodes:
        belongs = "a filter with nodes (here the centre uses the measurements)"
        _refuse(options, _OF_FUSION, where, belongs)
    centre = filters[kind].make(options, sensors)
    if centre.reads_silence and options.channel != "perfect":
        raise refusal("channel", options.channel, "'perfect', because a loss is no silence", where)
    absent = ("true_threshold_shift",) if sensors.unlimited else ()
    nature = Nature.create(options, (*plant.unmoved, *absent))
    nature.check_growth(plant.true_radius, options.horizon)
    if plant.schedule is None and sensors.schedule is None:
        plant.warn_of_unseen_growth(sensors.stacked_matrix, state_names)
    estimator = CensoredEstimator(
        model=plant if model is None else model,
        centre=centre,
        state_names=state_names,
        scale=typical_magnitude(plant, options.horizon, random_start),
        reference=plant.open_loop(min(options.horizon, reference_horizon)),
        known_start=known_start,
    )
    memory = None
    if memory_filter is not None:
        row = filters[choice("memory_filter", memory_filter, filters)]
        changed: dict[str, Any] = dict.fromkeys(() if row.nodes else _OF_FUSION)
        changed["filter"] = memory_filter
        memory = replace(estimator, centre=row.make(replace(options, **changed), sensors))
    defaults = dict(policy_defaults or {})
    if options.stochastic_weight is not None:
        defaults["stochastic_event"] = {"weight": plain_options(options.stochastic_weight)}
    return Scenario(
        options,
        CensoredPlant(plant, sensors, state_names, random_start, nature),
        estimator,
        policy_defaults=defaults,
        feedback=True,
        memory_estimator=memory,
        **others,
    )


def feedback_centre(options: FeedbackOptions, node: NodeFilter) -> fusion_centre.Centre:
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
        share = fusion_centre.information_shares(options.information_shares, sensors)
        if isinstance(node, KalmanFilter):
            return fusion_centre.FederatedCentre(node, share)
        return fusion_centre.FeedbackCentre(node, share, fusion)
    _refuse(options, ("information_shares",), f"fusion={kind!r}", "fusion='federated'")
    return fusion_centre.FeedbackCentre(node, np.ones((sensors, 1)), fusion)


# What every environment of the family offers; each adds its paper's own.
FILTERS = {
    "kalman": at_the_nodes(KalmanFilter),
    "adf": Filter(
        AssumedDensityFilter,
        lambda _, sensors: fusion_centre.SequentialCentre(AssumedDensityFilter(sensors)),
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
