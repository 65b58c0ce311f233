"""The stochastic event trigger, and the filter for which its silence is a measurement."""

from typing import Any

import numpy as np
import pytest
from filter_problems import Problem, outcomes
from numpy.typing import NDArray
from rules import make_rule

from fusion_gym import ConfigurationError, make_task
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.rules import StochasticEvent
from fusion_gym.systems.tobit.filters import StochasticEventFilter
from fusion_gym.systems.tobit.sensors import CensoredSensors

OSCILLATOR = "fusion_gym/TobitOscillator-v1"
TRACKING = "fusion_gym/BiasedTracking-v1"
INFINITY = float("inf")
DEVIATIONS = 4.5  # tolerance of a Monte Carlo mean, in its standard errors

Array = NDArray[np.float64]

# Uncensored systems in which every request is granted, by environment and options.
TARGET: dict[str, Any] = {
    "env_id": TRACKING,
    "access": "any",
    "censoring_threshold": -INFINITY,
    "censoring_upper": INFINITY,
}
ROTATION: dict[str, Any] = {  # three sensors that differ in everything, of two components each
    "env_id": OSCILLATOR,
    "tokens": "unlimited",
    "process_noise": "full",
    "censoring_threshold": -INFINITY,
    "information_shares": (0.5, 0.3, 0.2),
    "measurement_variance": ((0.5, 0.3), (0.4, 1.0), (0.2, 0.6)),
    "measurement_matrices": (((1, 0), (0, 1)), ((1, 1), (0, 1)), ((1, 0), (-1, 1))),
}
SCALAR: dict[str, Any] = {
    "env_id": OSCILLATOR,
    "tokens": "unlimited",
    "transition": ((0.95,),),
    "process_gain": (1.0,),
    "process_variance": 0.3,
    "initial_mean": (2.0,),
    "initial_covariance": ((0.5,),),
    "measurement_matrices": (((1.0,),),),
    "measurement_variance": 0.4,
    "censoring_threshold": -INFINITY,
}
SYSTEMS = [
    pytest.param(TARGET, (2.0, 0.5), id="target"),
    pytest.param(ROTATION, (1.0, 0.3, 3.0), id="three sensors"),
    pytest.param(SCALAR, 1.5, id="scalar"),
]


def task_of(system: dict[str, Any], weight: Any, **options: Any) -> Task:
    selection = {"filter": "stochastic", "stochastic_weight": weight} | system | options
    return make_task(selection.pop("env_id"), **selection)


def evaluate(task: Task, policy: str = "stochastic_event", episodes: int = 2000) -> EpisodeResults:
    return run_episodes(task, make_policy(policy, task), episodes, seed=0)


def deviations(values: Array) -> float:
    """The mean of independent values in its standard errors."""
    return float(values.mean() / (values.std() / np.sqrt(len(values))))


# --- exactness ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("system", "weight"), SYSTEMS)
def test_the_filter_is_exact_for_its_trigger(system: dict[str, Any], weight: Any) -> None:
    results = evaluate(task_of(system, weight))
    assert 0.1 < results.rate.mean() < 0.6
    assert abs(deviations(results.nees - 1.0)) < DEVIATIONS
    assert abs(deviations(results.bound_trace - results.mse)) < DEVIATIONS
    assert results.nees.mean() == pytest.approx(1.0, abs=0.03)
    assert results.bound_trace.mean() == pytest.approx(results.mse.mean(), rel=0.03)


# --- the update ---------------------------------------------------------------------------------


def test_silence_against_quadrature() -> None:
    """One state: prior times the probability of silence, integrated over state and measurement."""
    prior_mean, prior, gain, noise, weight = 0.7, 1.3, 0.8, 0.5, 0.9
    sensors = CensoredSensors.create([[[gain]]], noise, -INFINITY, 1)
    node = StochasticEventFilter.create(sensors, weight)
    mean, covariance = np.array([[[prior_mean]]]), np.array([[[[prior]]]])
    nothing = np.zeros((1, 1, 1))
    result = outcomes(node, Problem(sensors, mean, covariance, nothing, nothing))
    x = (prior_mean + np.sqrt(prior) * np.linspace(-9, 9, 1501))[:, None]
    y = (gain * prior_mean + np.linspace(-14, 14, 2001))[None]
    density = np.exp(-((x - prior_mean) ** 2) / (2 * prior) - (y - gain * x) ** 2 / (2 * noise))
    density *= np.exp(-weight * (y - gain * prior_mean) ** 2 / 2)
    posterior = density.sum(1) / density.sum()
    centre = (posterior * x[:, 0]).sum()
    assert result[2][0, 0, 0] == pytest.approx(centre, abs=1e-10)
    spread = (posterior * (x[:, 0] - centre) ** 2).sum()
    assert result[3][0, 0, 0, 0] == pytest.approx(spread, rel=1e-9)


# --- the trigger --------------------------------------------------------------------------------


def signals_of(innovation: Array, deviation: Array | None = None) -> Any:
    runs = innovation.shape[-1]
    return {
        "tokens": np.ones(runs),
        "token_cost": np.ones((len(innovation), 1)),
        "innovation": innovation,
        "innovation_deviation": np.ones_like(innovation) if deviation is None else deviation,
    }


@pytest.mark.parametrize("whitened", [False, True])
def test_the_probability_of_silence(whitened: bool) -> None:
    """Runs that all see the same innovation; every sensor has its own weight."""
    runs, steps, weights = 500, 130, np.array([0.3, 1.0, 2.5])
    innovation = np.array([[1.0, -0.5], [0.4, 0.9], [0.0, 0.6]])
    scale = np.array([[2.0, 0.5], [1.0, 1.5], [0.3, 0.7]])
    policy = make_rule(f"stochastic_event:weight=0.3/1/2.5,whitened={whitened}")
    policy.reset(runs, 7)
    repeat = np.ones(runs)
    signals = signals_of(innovation[..., None] * repeat, scale[..., None] * repeat)
    taken = np.array([policy(signals) for _ in range(steps)])
    observed = innovation / scale if whitened else innovation
    expected = np.exp(-weights * (observed**2).sum(1) / 2)
    tolerance = DEVIATIONS * np.sqrt(expected * (1 - expected) / (runs * steps))
    assert np.all(np.abs(1 - taken.mean((0, 2)) - expected) < tolerance)
    # Draws of other sensors, of other steps and of other runs have nothing to do with each other.
    excess = taken - (1 - expected)[:, None]
    others = (
        excess[:, 0] * excess[:, 1],
        excess[1:, :2] * excess[:-1, :2],
        excess[:, :2, 1:] * excess[:, :2, :-1],
    )
    for product in others:
        assert abs(deviations(product.ravel())) < DEVIATIONS


def test_no_weight_never_requests_and_all_weight_always() -> None:
    innovation = np.random.default_rng(0).normal(size=(3, 2, 200))
    for weight, answer in ((0, False), (1e12, True)):
        policy = make_rule(f"stochastic_event:weight={weight}")
        assert all((policy(signals_of(innovation)) == answer).all() for _ in range(70))
    for weight, rate in ((1e-14, 0.0), (1e14, 1.0)):
        assert evaluate(task_of(ROTATION, weight), episodes=20).rate.mean() == rate


def test_a_larger_weight_requests_wherever_a_smaller_one_does() -> None:
    """The draws do not depend on the parameters: policies are compared on common numbers."""
    generator = np.random.default_rng(1)
    small, large = StochasticEvent(0.4), StochasticEvent(1.1)
    small.reset(50, 3)
    large.reset(50, 3)
    differ = 0
    for _ in range(100):
        signals = signals_of(generator.normal(size=(2, 1, 50)))
        fewer, more = small(signals), large(signals)
        assert not (fewer & ~more).any()
        differ += (more & ~fewer).sum()
    assert differ > 0


def test_a_run_decides_alone() -> None:
    """Run i of a batch with seed s is the only run of one with seed s + i, over several blocks."""
    generator, runs, steps = np.random.default_rng(4), 5, 150
    innovation = generator.normal(size=(steps, 3, 2, runs))

    def decide(seed: int, selected: slice) -> NDArray[np.bool_]:
        policy = StochasticEvent((0.5, 1.0, 2.0))
        policy.reset(len(range(runs)[selected]), seed)
        return np.array([policy(signals_of(part[..., selected])) for part in innovation])

    together = decide(11, slice(None))
    for run in range(runs):
        np.testing.assert_array_equal(
            decide(11 + run, slice(run, run + 1))[..., 0], together[..., run]
        )
    np.testing.assert_array_equal(decide(11, slice(None)), together)
    assert not np.array_equal(decide(12, slice(None)), together)


# --- options ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("system", "weight"), SYSTEMS)
def test_the_policys_weight_comes_from_the_scenario(system: dict[str, Any], weight: Any) -> None:
    task = task_of(system, weight)
    same: Any = make_policy("stochastic_event", task)
    np.testing.assert_array_equal(np.atleast_1d(same.weight), np.atleast_1d(weight))
    own: Any = make_policy("stochastic_event:weight=0.25,whitened=true", task)
    assert (own.weight, own.whitened) == (0.25, True)
    other: Any = make_policy("stochastic_event", task_of(system, None, filter="kalman"))
    assert other.weight == StochasticEvent().weight


@pytest.mark.parametrize("env_id", [OSCILLATOR, TRACKING])
@pytest.mark.parametrize(
    ("options", "parts"),
    [
        ({"filter": "stochastic"}, ("stochastic_weight = None", "filter='stochastic'", "> 0")),
        ({"filter": "stochastic", "stochastic_weight": 0.0}, ("stochastic_weight = 0.0", "> 0")),
        ({"stochastic_weight": 1.0}, ("stochastic_weight = 1.0", "filter='paper'", "'stochastic'")),
    ],
)
def test_weights_that_do_not_fit_are_refused(
    env_id: str, options: dict[str, Any], parts: tuple[str, ...]
) -> None:
    with pytest.raises(ConfigurationError, match="is not allowed") as caught:
        make_task(env_id, **options)
    assert [part for part in parts if part not in str(caught.value)] == []
