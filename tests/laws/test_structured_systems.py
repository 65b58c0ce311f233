"""Random systems of every family, with the structure that breaks estimators, stay finite and right.

``-m slow`` runs ten million steps and sixty systems against 50 digits.
"""

import re

import numpy as np
import pytest
from reference_digits import largest_errors
from structured_systems import FAMILIES, Drawn, Survey, draw, draw_linear

import fusion_gym
from fusion_gym import ConfigurationError, make_task
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.errors import DivergenceError

_SHARE = 0.05  # of the drawn systems may be refused


def survey(family: str, systems: int, horizon: int, runs: int, result: Survey) -> None:
    """Run the first systems of a family, without a warning."""
    for number in range(systems):
        result.add(draw(family, number, horizon), runs, f"{family} {number}")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_stays_finite(family: str) -> None:
    result = Survey()
    survey(family, 6, 140, 5, result)
    assert not result.failures, str(result)
    assert result.refused.total() <= 1, str(result)


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_ten_million_steps() -> None:
    result = Survey()
    for family in FAMILIES:
        survey(family, 25, 1000, 80, result)
    print(result)
    assert not result.failures, str(result)
    assert result.run_steps >= 10_000_000
    assert result.refused.total() <= _SHARE * result.drawn, str(result)


def exactly_filtered(number: int, horizon: int) -> tuple[Drawn, bool]:
    """A system whose filter is the joint Kalman or Tobit Kalman filter, and whether it is Tobit."""
    kind = number % 3
    if kind == 0:
        drawn = draw_linear(np.random.default_rng([9, number]), horizon, exact=True)
        return Drawn(f"fusion_gym/{drawn.env_id}-v1", drawn.options, drawn.known), False
    drawn = draw(("TobitOscillator", "BiasedOscillator")[kind - 1], number, horizon)
    name = ("tobit", "paper")[kind - 1] if number % 2 else "kalman"
    own = ("fusion", "stochastic_weight", "bias_aware", "silent")
    options = {key: value for key, value in drawn.options.items() if key not in own}
    ranked = {"silent": drawn.options["silent"]} if "silent" in drawn.options else {}
    return Drawn(drawn.env_id, options | ranked | {"filter": name}, drawn.known), name != "kalman"


@pytest.mark.parametrize(
    "numbers", [range(12), pytest.param(range(12, 72), marks=pytest.mark.slow)], ids=["few", "many"]
)
def test_variances_and_means_are_those_of_fifty_digits(numbers: range) -> None:
    far, refused = [], 0
    for number in numbers:
        drawn, censored = exactly_filtered(number, 220)
        try:
            task = make_task(drawn.env_id, **drawn.options)
        except ConfigurationError:
            refused += 1
            continue
        errors = largest_errors(task, 220, 3, censored=censored)
        if not max(errors) <= 1e-9:
            far.append((number, drawn.options["filter"], *errors))
    assert not far
    assert refused <= max(1, _SHARE * len(numbers))


@pytest.mark.parametrize("growth", [1.02, 1.1, 1.3])
def test_the_longest_horizon_is_named_and_right(growth: float) -> None:
    options = {"transition": [[growth, 0.0], [0.1, 0.5]], "filter": "kalman"}
    with pytest.raises(ConfigurationError, match="horizon = 3000 is not allowed") as error:
        make_task("fusion_gym/LinearFusion-v2", horizon=3000, **options)
    found = re.search(r"at most (\d+)", str(error.value))
    assert found
    longest = int(found[1])
    task = make_task("fusion_gym/LinearFusion-v2", horizon=longest, **options)
    with pytest.raises(ConfigurationError, match="horizon"):
        make_task("fusion_gym/LinearFusion-v2", horizon=longest + 1, **options)
    if longest < 400:
        assert max(largest_errors(task, longest, 3, censored=False)) <= 1e-9


def test_a_growth_that_the_unknown_input_hides_is_refused() -> None:
    drawn = draw("UnknownInput", 15, 1000)
    with pytest.raises(ConfigurationError, match="and sensor 0: the input hides a direction"):
        make_task(drawn.env_id, **drawn.options | {"horizon": 1000})


@pytest.mark.parametrize("family", FAMILIES)
def test_a_step_names_run_step_and_quantity(family: str) -> None:
    task = make_task(f"fusion_gym/{family}-v1", horizon=5)
    batch = EpisodeBatch.seeded(task, 3, seed=0)
    nobody = np.zeros((task.sensors, 3), dtype=np.bool_)
    batch.step(nobody)
    batch.state.truth = batch.state.truth.copy()
    batch.state.truth[0, 1] = np.nan
    with pytest.raises(DivergenceError, match="run 1, step 2: the truth"):
        batch.step(nobody)
    batch.finished[1] = True
    batch.step(nobody)


def test_a_step_names_an_entry_of_the_observation() -> None:
    task = fusion_gym.make_task("fusion_gym/LinearFusion-v2")
    batch = EpisodeBatch.seeded(task, 2, seed=0)
    batch.observe()
    batch.state.prior_covariance = batch.state.prior_covariance.copy()
    batch.state.prior_covariance[0, 0, 1] = np.nan
    with pytest.raises(
        DivergenceError, match=r"run 1, step 0: the observation 'log_variance\[x1\]"
    ):
        batch.observe()
    batch.finished[1] = True
    batch.observe()
