"""Markov jump tracking with fading, asynchronous sensors: numbers, options, environment.

Source: markov_jump (event-triggered distributed fusion estimation for asynchronous Markov jump
systems with correlated noises and fading measurements), Section 6.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from fusion_gym import validation
from fusion_gym.core.options import CommonOptions, choose, finish
from fusion_gym.core.task import Task
from fusion_gym.envs.registered import RegisteredEnv, RegisteredVectorEnv
from fusion_gym.fusion.matrix_weighted import IntersectionOfCopies, MatrixWeightedFusion
from fusion_gym.fusion.sequential import SequentialFusion
from fusion_gym.systems.markov_jump.central_system import MarkovJumpCentralSystem
from fusion_gym.systems.markov_jump.plant import MarkovJumpPlant
from fusion_gym.systems.markov_jump.sensors import FadingSensors
from fusion_gym.systems.markov_jump.system import MarkovJumpSystem
from fusion_gym.validation import ConfigurationError

_T = 0.5  # the paper's sampling time in seconds


@dataclass(frozen=True)
class MarkovJumpTrackingOptions(CommonOptions):
    """Every option of the environment; the defaults are the paper's Section 6.

    Not given in the paper, our choice: ``horizon``, the token bucket (the paper has none, hence
    ``tokens="unlimited"``) and the reward.
    """

    # Plant, equation (1): position, velocity; one Φ and Γ a mode
    transitions: ArrayLike = (((0.8, 0.2 * _T), (0.0, 0.6)), ((1.0, _T), (0.0, _T)))
    process_gains: ArrayLike = (((1.5,), (0.6,)), ((0.5 * _T * _T,), (_T,)))
    process_covariance: ArrayLike = 0.64
    mode_transition: ArrayLike = ((0.65, 0.35), (0.35, 0.65))
    initial_probabilities: ArrayLike = (0.5, 0.5)
    initial_mean: ArrayLike = (0.0, 0.0)
    initial_covariance: ArrayLike = ((0.1, 0.0), (0.0, 0.1))
    # Sensors, equation (2): one H a sensor and mode, fading, noise α w + η
    measurement_matrices: ArrayLike = (
        ((1.0, 1.0), (0.4, 1.0)),
        ((1.0, 0.6), (1.0, 0.2)),
        ((0.5, 1.0), (2.0, 0.5)),
    )
    sampling_periods: ArrayLike = (1, 2, 3)
    fading_values: ArrayLike = ((0.25, 0.5, 1.0), (0.2, 0.4, 0.8), (0.3, 0.6, 0.9))
    fading_probabilities: ArrayLike = ((0.2, 0.4, 0.4), (0.45, 0.35, 0.2), (0.7, 0.1, 0.2))
    noise_coupling: ArrayLike = (0.2, 0.4, 0.3)
    measurement_variance: ArrayLike = (0.49, 0.36, 0.9)
    # Network
    tokens: str = "unlimited"
    token_rate: float = 3.0
    # Filters at the nodes, equations (12)-(22), and fusion, (55)-(57); or references at the centre
    filter: str = "local"
    fusion: str | None = None
    # Episode and reward
    horizon: int = 100
    cost_weight: float = 0.01


def build(**options: Any) -> Task:
    """The task for these options, checked before anything runs.

    Raises:
        ConfigurationError: an unknown option, or a value that is not allowed.
    """
    chosen, limit = choose(MarkovJumpTrackingOptions, "fusion_gym/MarkovJumpTracking-v0", options)
    horizon = validation.integer("horizon", chosen.horizon, at_least=1)
    where = validation.choice("filter", chosen.filter, ("local", "centralised", "imm"))
    fusion = _fusion(chosen.fusion, where)
    plant = MarkovJumpPlant.create(
        chosen.transitions,
        chosen.process_gains,
        chosen.process_covariance,
        chosen.mode_transition,
        chosen.initial_probabilities,
        chosen.initial_mean,
        chosen.initial_covariance,
    )
    sensors = FadingSensors.create(
        chosen.measurement_matrices,
        chosen.sampling_periods,
        chosen.fading_values,
        chosen.fading_probabilities,
        chosen.noise_coupling,
        chosen.measurement_variance,
        plant,
    )
    weights = (
        None
        if chosen.state_weights is None
        else validation.not_negative("state_weights", chosen.state_weights, (plant.size,))
    )
    names = _state_names(plant.size)
    if fusion is None:
        central = MarkovJumpCentralSystem.create(
            plant, sensors, where == "imm", names, weights, horizon
        )
        return finish(chosen, central, limit, central.state_weights)
    system = MarkovJumpSystem.create(plant, sensors, fusion, names, weights, horizon)
    reference = float(system.full_rate_traces().mean())
    return finish(
        chosen,
        system,
        limit,
        system.state_weights,
        policy_defaults={"local_variance": {"reference": reference}},
    )


def _fusion(kind: str | None, where: str) -> MatrixWeightedFusion | IntersectionOfCopies | None:
    """The rule that joins the nodes' estimates; None where the centre takes the measurements."""
    if where != "local":
        if kind is not None:
            raise ConfigurationError(
                f"fusion = {kind!r} is not allowed with filter={where!r}: it must be left out, for "
                "the centre takes the measurements themselves and has no estimates to fuse; it "
                "belongs to filter='local'"
            )
        return None
    kind = "matrix" if kind is None else kind
    if kind in ("information", "federated"):
        why = (
            "the errors of the centre's copies are correlated (all contain the same process noise)"
            if kind == "information"
            else "nothing is fed back to the nodes, and their errors are correlated"
        )
        raise ConfigurationError(
            f"fusion = {kind!r} is not allowed: it must be one of 'matrix', 'ci', 'sci', 'sici', "
            f"for {why}"
        )
    kind = validation.choice("fusion", kind, ("matrix", "ci", "sci", "sici"))
    if kind == "matrix":
        return MatrixWeightedFusion()
    if kind == "ci":
        return IntersectionOfCopies()
    return IntersectionOfCopies(SequentialFusion("ici" if kind == "sici" else "ci"))


def _state_names(size: int) -> tuple[str, ...]:
    if size == 2:
        return ("position", "velocity")
    return tuple(f"x{i + 1}" for i in range(size))


_PAGE = """
    A target that jumps between two motions, seen by three sensors with different sampling periods
    and fading measurements: which node should send its estimate to the centre, and when?

    ## Description
    Position and velocity follow one of two linear motions, chosen by a Markov chain that nobody
    sees. Sensor 0 measures at every step, sensor 1 at every second, sensor 2 at every third; a
    measurement is multiplied by a random number between 0 and 1, and its noise is correlated with
    the others' and with the noise that moves the target next. Each node runs its own
    linear-minimum-variance filter at every step, so the link is between node and centre: a packet
    carries the node's estimate. The centre keeps a copy of each node's estimate, replaces it when
    a packet arrives, predicts it otherwise, and fuses its copies with matrix weights, knowing the
    exact joint covariance of their errors. Nothing is fed back.

    With ``filter="centralised"`` or ``"imm"`` packets carry measurements, and one filter at the
    centre takes those that are granted: the best linear one, or interacting multiple models. A
    request of a sensor that does not sample then delivers nothing and costs its tokens all the
    same.

    ## Action space
    ``MultiBinary(sensors)``: 1 requests a transmission of that node's estimate. With
    ``action="discrete"`` it is ``Discrete(2**sensors)``, the bits as one number, sensor 0 lowest.

    ## Observation space
    A ``Box`` of float32; ``env.unwrapped.observation_names`` names every entry. Entries marked *
    are missing with ``information="centre"``.

    | entries | meaning | range |
    |---|---|---|
    | whitened_difference[sensor,state] * | node's estimate minus the centre's copy, over its deviation | -5..5 |
    | whitened_innovation[sensor] * | node's innovation over its deviation, 0 without a sample | -5..5 |
    | sampled[sensor] | 1 if the sensor samples at this step | 0..1 |
    | phase[sensor] | steps since its last sampling time over its period | 0..1 |
    | age[sensor] | a/(a + 10), a steps since the last delivery | 0..1 |
    | local_log_deviation[sensor] | ln of the root of the node's trace over the open-loop trace | -5..5 |
    | copy_log_deviation[sensor,state] | ln of the copy's predicted over open-loop deviation | -5..5 |
    | log_deviation[state] | the same of the fused estimate if nobody transmits | -5..5 |
    | estimate[state] | that estimate over the state's root mean square | -5..5 |
    | tokens | over the capacity | 0..1 |

    With a filter at the centre the differences, the local and the copies' deviations give way to
    others; docs/markov_jump.md lists them.

    ## Reward
    -(error_weight · Σ wᵢ eᵢ² + cost_weight · tokens spent), e the fused estimate's error at the
    time of the request. By default wᵢ is 1/n over the state's open-loop error variance, so that
    never transmitting costs about 1 a step. With ``error="trace"`` the fused covariance stands for
    the squared errors. ``info["rewards"]`` has the two terms.

    ## Starting state
    x₀ ~ N(0, 0.1 I), the mode 1 or 2 with probability 1/2 each. Nodes and centre know these
    distributions; nothing has been measured.

    ## Episode end
    Truncation after ``horizon`` steps, never termination.

    ## Info
    ``cost`` = ``cost_tokens`` (tokens spent, >= 0), ``rewards`` (``error``, ``cost``),
    ``granted`` and ``denied`` (one a sensor), ``squared_error`` (one a state), ``diverged``.

    ## Arguments
    The fields of :class:`MarkovJumpTrackingOptions`; docs/markov_jump.md explains each, and what
    the paper's text gets wrong.

    ## Version history
    - v0: first version.
"""  # noqa: E501


class MarkovJumpTrackingEnv(RegisteredEnv):
    __doc__ = _PAGE
    build = staticmethod(build)


class MarkovJumpTrackingVectorEnv(RegisteredVectorEnv):
    __doc__ = _PAGE
    build = staticmethod(build)
