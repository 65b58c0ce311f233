"""What makes the bound of silence a bound on coarse lattices, against closed forms."""

import numpy as np
import pytest

from fusion_gym.solvers.silence import SilenceProblem, solve_silence


@pytest.mark.parametrize("variances", [(0.0, 0.4), (0.3, 0.4), (0.3, 0.05, 0.2)])
@pytest.mark.parametrize("step", [0.5, 0.9])
def test_where_packets_are_too_dear_it_is_the_cost_of_silence(
    variances: tuple[float, ...], step: float
) -> None:
    """The mean of Σ e² is known. Linear interpolation of a square lies above it: without the
    corrections for the variance that it adds and for its curvature it would be no bound."""
    coefficient, second, exact = 0.7, 0.0, 0.0
    for variance in variances:
        second = coefficient**2 * second + variance
        exact += second / len(variances)
    noise = np.reshape(variances, (-1, 1, 1))
    problem = SilenceProblem.create([[coefficient]], [1.0], noise, 60.0)
    result = solve_silence(problem, step).lower
    assert result <= exact * (1.0 + 1e-9)
    assert result == pytest.approx(exact, rel=0.05)


def test_the_floor_allows_for_what_lies_between_the_points() -> None:
    """Half the second derivative is at most 1: between points of a lattice the value is less than
    on them by at most n h²/4, but at the last step, where it is known."""
    step, price = 0.3, 4.0
    problem = SilenceProblem.create(
        [[0.8, -0.6], [0.6, 0.8]], [1.0, 1.0], np.tile(np.eye(2), (4, 1, 1)), price
    )
    *stages, last = solve_silence(problem, step).stages
    for stage in stages:
        least = stage.gain.min() + stage.ceiling
        assert least - stage.floor == pytest.approx(2 * step**2 / 4)
        assert stage.ceiling == pytest.approx(price + stage.floor)
    assert last.floor == 0.0
