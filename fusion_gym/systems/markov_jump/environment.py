"""Markov jump tracking with fading, asynchronous sensors: numbers, options, environment.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements), Section 6.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.arrays import Array
from fusion_gym.core.plant import Nature
from fusion_gym.core.reward import equal_weights
from fusion_gym.core.task import PaperOptions, Scenario
from fusion_gym.core.token_bucket import Tokens
from fusion_gym.fusion.rules import FusionRule
from fusion_gym.fusion.table import Structure, choose_rule
from fusion_gym.systems.bases import numbered_states
from fusion_gym.systems.markov_jump import centralised
from fusion_gym.systems.markov_jump.linear_minimum_variance import (
    AugmentedModel,
    LagRecursion,
    LocalFilters,
)
from fusion_gym.systems.markov_jump.plant import FadingSensors, MarkovJumpPlant
from fusion_gym.systems.markov_jump.system import FadingPlant, MarkovJumpEstimator

_T = 0.5  # the paper's sampling time in seconds
FILTERS: dict[str, type] = {
    "local": LocalFilters,
    "centralised": centralised.CentralisedLinearFilter,
    "imm": centralised.InteractingModels,
}
_ESTIMATES_ALREADY = "packets already carry the nodes' estimates of all measurements"
_STRUCTURE = Structure(common="all contain the same process noise", holds=("joint covariance",))


@dataclass(frozen=True)
class MarkovJumpTrackingOptions(PaperOptions):
    """A target that jumps between two motions, measured by three fading, asynchronous sensors.

    Position and velocity follow one of two linear motions, which a hidden Markov chain selects.
    Sensor 0 measures at every step, sensor 1 at every second, sensor 2 at every third. A
    measurement is multiplied by a random number between 0 and 1. Its noise is correlated with the
    others' and with the noise that moves the target next. Each node runs a linear minimum-variance
    filter at every step, and a packet carries the node's estimate. The centre keeps a copy of each
    node's estimate, replaces it when a packet arrives, and predicts it otherwise. It fuses its
    copies with matrix weights from the exact joint covariance of their errors. Nothing is fed back.

    With ``filter="centralised"`` or ``"imm"`` packets carry measurements, and one filter at the
    centre processes the granted ones: the best linear filter, or interacting multiple models. A
    request of a sensor that does not sample then delivers nothing and still costs its tokens. The
    observation has other entries: ``print(env.unwrapped.__doc__)`` of such an environment shows
    them.

    Starting state: x₀ ~ N(0, 0.1 I), the mode 1 or 2 with probability 1/2 each. Nodes and centre
    know these distributions; nothing has been measured.

    The defaults are the paper's Section 6. The paper does not give, and we chose: ``horizon``, the
    token bucket (the paper has none, hence ``tokens="unlimited"``) and the reward.

    Example:
        >>> import fusion_gym
        >>> from fusion_gym.systems.markov_jump.environment import MarkovJumpTrackingOptions
        >>> options = MarkovJumpTrackingOptions(filter="imm", sampling_periods=(1, 1, 2))
        >>> task = fusion_gym.make_task(options)
        >>> task.sensors, task.plant.state_names
        (3, ('position', 'velocity'))
    """

    filters: ClassVar[Mapping[str, type]] = FILTERS
    structure: ClassVar[Structure | None] = _STRUCTURE
    transitions: ArrayLike = (((0.8, 0.2 * _T), (0.0, 0.6)), ((1.0, _T), (0.0, _T)))
    """Φ of each mode, equation (1), (modes, n, n). The plant must be mean-square stable."""
    process_gains: ArrayLike = (((1.5,), (0.6,)), ((0.5 * _T * _T,), (_T,)))
    """Γ of each mode, equation (1), (modes, n, r)."""
    process_covariance: ArrayLike = 0.64
    """Covariance Q_w of the process noise w, equation (1): (r, r) or one number."""
    mode_transition: ArrayLike = ((0.65, 0.35), (0.35, 0.65))
    """Probabilities p of a mode (row) followed by a mode (column), (modes, modes)."""
    initial_probabilities: ArrayLike = (0.5, 0.5)
    """Probabilities of the modes at time 0, (modes,)."""
    initial_mean: ArrayLike = (0.0, 0.0)
    """Mean of x₀, (n,)."""
    initial_covariance: ArrayLike = ((0.1, 0.0), (0.0, 0.1))
    """Covariance of x₀, (n, n)."""
    measurement_matrices: ArrayLike = (
        ((1.0, 1.0), (0.4, 1.0)),
        ((1.0, 0.6), (1.0, 0.2)),
        ((0.5, 1.0), (2.0, 0.5)),
    )
    """H of the scalar measurement of each sensor and mode, equation (2), (sensors, modes, n)."""
    sampling_periods: ArrayLike = (1, 2, 3)
    """Steps n_i between two samples of each sensor, whole numbers."""
    fading_values: ArrayLike = ((0.25, 0.5, 1.0), (0.2, 0.4, 0.8), (0.3, 0.6, 0.9))
    """Values from 0 to 1 of the fading β_i of each sensor, equation (2), (sensors, values)."""
    fading_probabilities: ArrayLike = ((0.2, 0.4, 0.4), (0.45, 0.35, 0.2), (0.7, 0.1, 0.2))
    """Probabilities of these values, (sensors, values)."""
    noise_coupling: ArrayLike = (0.2, 0.4, 0.3)
    """α of the measurement noise α w + η, Section 6: one per sensor, or (sensors, r)."""
    measurement_variance: ArrayLike = (0.49, 0.36, 0.9)
    """Variance R_η of η, Section 6: one number, or one per sensor."""
    tokens: Tokens = "unlimited"
    token_rate: ArrayLike = 3.0
    filter: Annotated[str, FILTERS] = "local"
    """``"local"`` is the paper's filter at each node, equations (12)-(22): packets carry estimates.
    ``"centralised"`` and ``"imm"`` are one filter at the centre: packets carry measurements."""
    memory_filter: Annotated[str | None, FILTERS] = None
    fusion: Annotated[str | None, _STRUCTURE.offered] = None
    """Rule that joins the copies, with ``filter="local"`` only. The default ``"matrix"`` has matrix
    weights (55)-(57). ``"ci"`` is covariance intersection, ``"ici"`` its inverse form for two
    sensors. ``"sci"`` and ``"sici"`` join two copies at a time."""


def build_markov(options: MarkovJumpTrackingOptions) -> Scenario:
    """Return the scenario of these options."""
    horizon = validation.horizon(options.horizon)
    dynamics = MarkovJumpPlant.create(options)
    sensors = FadingSensors.create(options, dynamics)
    weights = options.own_weights(dynamics.size)
    nature = Nature.create(options, (*dynamics.unmoved, "true_threshold_shift"))
    nature.check_growth(dynamics.true_radius, horizon)
    model = AugmentedModel.create(dynamics, sensors)
    names = numbered_states(dynamics.size, ("position", "velocity"))
    plant = FadingPlant(dynamics, sensors, model, names, nature)
    estimator = _estimator(options.filter, options.fusion, plant, weights, horizon)
    memory = None
    if (kind := options.memory_filter) is not None:
        fusion = options.fusion if kind == options.filter else None
        memory = _estimator(kind, fusion, plant, weights, horizon)
    defaults, refusal = {}, None
    if isinstance(estimator, MarkovJumpEstimator):
        defaults = {"local_variance": {"reference": float(estimator.full_rate_traces().mean())}}
        refusal = _ESTIMATES_ALREADY
    return Scenario(
        options,
        plant,
        estimator,
        estimator.state_weights,
        defaults,
        memory_estimator=memory,
        nodes_have_memory=refusal is not None,
        no_estimates=refusal,
    )


def _estimator(
    where: str, kind: str | None, plant: FadingPlant, weights: Array | None, horizon: int
) -> MarkovJumpEstimator | centralised.MarkovJumpCentralEstimator:
    """Return the estimator of a filter and a fusion rule."""
    model = plant.model
    fusion = _fusion(kind, where, plant.sensor_count, weights)
    reference, magnitude = model.scales(horizon)
    weights = equal_weights(reference) if weights is None else weights
    scales = plant.state_names, weights, magnitude, reference
    if fusion is not None:
        filters = LocalFilters.create(model, horizon)
        recursion = LagRecursion.create(filters, model.plant.size)
        return MarkovJumpEstimator(*scales, model, filters, recursion, fusion)
    linear = centralised.CentralisedLinearFilter.create(model, horizon)
    chosen = centralised.InteractingModels.create(model) if where == "imm" else linear
    return centralised.MarkovJumpCentralEstimator(*scales, model, chosen, linear.measured(horizon))


def _fusion(kind: str | None, where: str, sensors: int, weights: Array | None) -> FusionRule | None:
    """Return the rule that joins the nodes' estimates, or None for a filter at the centre."""
    if where != "local":
        if kind is not None:
            why = "because the centre fuses no estimates; it belongs to filter='local'"
            raise validation.refusal("fusion", kind, f"left out, {why}", f"with filter={where!r}")
        return None
    kind = "matrix" if kind is None else kind
    return choose_rule(kind, _STRUCTURE, sensors, state_weights=weights)
