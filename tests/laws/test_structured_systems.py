"""Random systems of every family, with the structure that breaks estimators, stay finite and right.

``-m slow`` runs five million steps and sixty systems against 50 digits.
"""

import re
import warnings
from typing import Any

import numpy as np
import pytest
from reference_digits import largest_errors
from structured_systems import FAMILIES, Drawn, Survey, draw, draw_linear, request

import fusion_gym
from fusion_gym import ConfigurationError, make_task
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.envs.registration import present_id
from fusion_gym.errors import DivergenceError
from fusion_gym.systems.linear_plant import LinearPlant
from fusion_gym.systems.markov_jump.environment import MarkovJumpTrackingOptions
from fusion_gym.systems.markov_jump.linear_minimum_variance import AugmentedModel
from fusion_gym.systems.markov_jump.plant import MarkovJumpPlant

_SHARE = 0.05  # of the drawn systems may be refused


def survey(family: str, systems: int, horizon: int, runs: int, result: Survey) -> None:
    """Run the first systems of a family, without a warning."""
    for number in range(systems):
        result.add(draw(family, number, horizon), runs, f"{family} {number}")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("systems", [3, pytest.param(6, marks=pytest.mark.slow)])
def test_every_family_stays_finite(family: str, systems: int) -> None:
    result = Survey()
    survey(family, systems, 140, 5, result)
    assert not result.failures, str(result)
    assert result.refused.total() <= 1, str(result)


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_five_million_steps() -> None:
    result = Survey()
    for family in FAMILIES:
        survey(family, 12, 1000, 80, result)
    print(result)
    assert not result.failures, str(result)
    assert result.run_steps >= 5_000_000
    assert result.refused.total() <= _SHARE * result.drawn, str(result)


def exactly_filtered(number: int, horizon: int) -> tuple[Drawn, bool]:
    """A system whose filter is the joint Kalman or Tobit Kalman filter, and whether it is Tobit."""
    kind = number % 3
    if kind == 0:
        drawn = draw_linear(np.random.default_rng([9, number]), horizon, exact=True)
        return Drawn(present_id(drawn.env_id), drawn.options, drawn.known), False
    drawn = draw(("TobitOscillator", "BiasedOscillator")[kind - 1], number, horizon)
    name = ("tobit", "paper")[kind - 1] if number % 2 else "kalman"
    own = ("fusion", "stochastic_weight", "bias_aware", "silent")
    options = {key: value for key, value in drawn.options.items() if key not in own}
    ranked = {"silent": drawn.options["silent"]} if "silent" in drawn.options else {}
    return Drawn(drawn.env_id, options | ranked | {"filter": name}, drawn.known), name != "kalman"


@pytest.mark.parametrize(
    "numbers", [range(3), pytest.param(range(3, 72), marks=pytest.mark.slow)], ids=["few", "many"]
)
def test_variances_and_means_are_those_of_fifty_digits(numbers: range) -> None:
    far, refused = [], 0
    for number in numbers:
        drawn, censored = exactly_filtered(number, 220)
        try:
            with warnings.catch_warnings(record=True) as warned:
                task = make_task(drawn.env_id, **drawn.options)
        except ConfigurationError:
            refused += 1
            continue
        errors = largest_errors(task, 220, 3, censored=censored)
        if not max(errors) <= max(1e-9, 10.0 * accuracy(warned)):
            far.append((number, drawn.options["filter"], *errors))
    assert not far
    assert refused <= max(1, _SHARE * len(numbers))


def course(drawn: Drawn, share: float, memory: bool) -> tuple[np.ndarray, ...]:
    """Observations, means and covariances over an episode, in units of the drawn start.

    All states, or with ``memory`` the last half, start with this ``share`` of their variance.
    """
    options, scale = drawn.options | {"memory": memory}, np.ones(0)
    for name in ("initial_covariance", "bias_initial_covariance"):
        if name in options:
            start = np.diagonal(options[name]).copy()
            start[start == 0.0] = 1.0
            scale = np.append(scale, np.sqrt(start))
            start[len(start) // 2 if memory and name[0] == "i" else 0 :] *= share
            options[name] = np.diag(start)
    if "bias_noise_covariance" in options:
        options["bias_noise_covariance"] = 0.01 * np.eye(len(options["bias_noise_covariance"]))
    task = make_task(drawn.env_id, **options)
    batch, random = EpisodeBatch.seeded(task, 5, seed=0), np.random.default_rng(0)
    result = []
    for step in range(task.horizon):
        observed = batch.observe()
        batch.step(request(random, step, task.sensors, 5))
        estimate = batch.delivered.estimate
        mean, covariance = task.estimator.mean(estimate), task.estimator.covariance(estimate)
        whole = np.append(scale, np.ones(len(mean) - len(scale)))[:, None]
        result.append((observed, mean / whole, covariance / whole[:, None] / whole))
    return tuple(map(np.array, zip(*result, strict=True)))


@pytest.mark.parametrize("systems", [3, pytest.param(6, marks=pytest.mark.slow)])
@pytest.mark.parametrize("memory", [False, True])
@pytest.mark.parametrize("family", [name for name in FAMILIES if name != "RemoteEstimation"])
def test_a_known_start_is_the_limit_of_uncertain_ones(
    family: str, memory: bool, systems: int
) -> None:
    compared = 0
    for number in range(systems):
        drawn = draw(family, number, 30)
        try:
            known, nearly = (course(drawn, share, memory) for share in (0.0, 1e-12))
        except ConfigurationError:
            continue
        compared += 1
        for name, one, other, tolerance in zip(
            ("observation", "mean", "covariance"), known, nearly, (1e-2, 1e-3, 1e-4), strict=True
        ):
            np.testing.assert_allclose(one, other, tolerance, tolerance, err_msg=f"{number} {name}")
    assert compared >= systems // 3


def accuracy(warned: list[warnings.WarningMessage]) -> float:
    """What the one warning of rounding says; 0 of none."""
    text = [str(warning.message) for warning in warned if "rounding" in str(warning.message)]
    found = re.findall(r"(?:reach|and) (\S+) of", " ".join(text))
    assert len(set(found)) == len(text) <= 1
    return float(found[0]) if found else 0.0


PAIR = {"transition": [[1.2, 0.0], [0.1, 0.5]]}
SLOW = {"transition": [[1.05, 0.0], [0.1, 0.5]]}
CASES: list[tuple[dict[str, Any], bool]] = [  # and whether 1e-9 is left
    *(({"initial_mean": [place, 0.0]}, place < 1e6) for place in (1e5, 6.4e6, 1e9, 1e12)),
    *((PAIR | {"horizon": steps}, steps < 40) for steps in (30, 60, 80, 100)),
    *((SLOW | {"horizon": steps}, steps < 120) for steps in (100, 200, 300)),
    ({"transition": [[1.3]], "horizon": 100, "measurement_matrices": [[1.0]]}, False),
]


@pytest.mark.parametrize(("options", "right"), CASES)
def test_a_warning_says_what_accuracy_is_left(options: dict[str, Any], right: bool) -> None:
    size = len(options.get("transition", "ab"))
    plant = {"process_covariance": 0.1 * np.eye(size)} | options
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        task = make_task("fusion_gym/LinearFusion-v2", filter="kalman", **plant)
    left = accuracy(warned)
    assert (left == 0.0) == right
    for silent in (False, True):
        errors = largest_errors(task, task.horizon, 5, censored=False, silent=silent)
        assert max(errors) <= max(1e-9, 10.0 * left)


@pytest.mark.parametrize("growth", [1.02, 1.1, 1.3])
def test_the_longest_horizon_is_named_and_right(growth: float) -> None:
    options = {"transition": [[growth, 0.0], [0.1, 0.5]], "filter": "kalman"}
    with pytest.raises(ConfigurationError, match="horizon = 9000 is not allowed") as error:
        make_task("fusion_gym/LinearFusion-v2", horizon=9000, **options)
    found = re.search(r"at most (\d+)", str(error.value))
    assert found
    longest = int(found[1])
    with pytest.warns(UserWarning, match="rounding errors may reach"):
        make_task("fusion_gym/LinearFusion-v2", horizon=longest, **options)
    with pytest.raises(ConfigurationError, match="horizon"):
        make_task("fusion_gym/LinearFusion-v2", horizon=longest + 1, **options)


@pytest.mark.parametrize("place", [1e3, 1e9, 1e15])
@pytest.mark.parametrize("share", [0.0, 1e-9, 1.0])
def test_no_error_without_transmissions_is_negative(place: float, share: float) -> None:
    """A Markov jump plant whose modes move alike has the variances of a plant without modes."""
    start, noise = share * np.eye(2), np.diag([0.0, 0.3])
    transition, mean = np.array([[0.9, 0.1], [0.0, 0.5]]), [place, place]
    options = MarkovJumpTrackingOptions(
        transitions=[transition] * 2,
        process_gains=[np.eye(2)] * 2,
        process_covariance=noise,
        mode_transition=[[0.7, 0.3], [0.1, 0.9]],
        initial_probabilities=[0.2, 0.8],
        initial_mean=mean,
        initial_covariance=start,
    )
    plant = MarkovJumpPlant.create(options)
    sensors = make_task("fusion_gym/MarkovJumpTracking-v1").plant.sensors
    expected = LinearPlant.create(transition, noise, mean, start).open_loop(50)
    result = AugmentedModel.create(plant, sensors).scales(50)[0]
    np.testing.assert_allclose(result, expected, rtol=1e-6 + 1e-30 * place**2)


def test_a_growth_that_the_unknown_input_hides_is_refused() -> None:
    drawn = draw("UnknownInput", 15, 1000)
    with pytest.raises(ConfigurationError, match="and sensor 0: the input hides a direction"):
        make_task(drawn.env_id, **drawn.options | {"horizon": 1000})


@pytest.mark.parametrize("family", FAMILIES)
def test_a_step_names_run_step_and_quantity(family: str) -> None:
    task = make_task(present_id(family), horizon=5)
    batch = EpisodeBatch.seeded(task, 3, seed=0)
    nobody = np.zeros((task.sensors, 3), dtype=np.bool_)
    batch.step(nobody)
    state = batch.state.plant
    state.truth = state.truth.copy()
    state.truth[0, 1] = np.nan
    with pytest.raises(DivergenceError, match="run 1, step 2: the truth"):
        batch.step(nobody)
    batch.finished[1] = True
    batch.step(nobody)


def test_a_step_names_an_entry_of_the_observation() -> None:
    task = fusion_gym.make_task("fusion_gym/LinearFusion-v2")
    batch = EpisodeBatch.seeded(task, 2, seed=0)
    batch.observe()
    estimate = batch.state.estimate
    estimate.prior_covariance = estimate.prior_covariance.copy()
    estimate.prior_covariance[0, 0, 1] = np.nan
    with pytest.raises(
        DivergenceError, match=r"run 1, step 0: the observation 'log_variance\[x1\]"
    ):
        batch.observe()
    batch.finished[1] = True
    batch.observe()
