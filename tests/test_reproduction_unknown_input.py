"""The unknown-input paper's bound and its printed gains."""

import numpy as np
import pytest

from fusion_gym.agents.papers.unknown_input import CARTS, leading, make_example
from fusion_gym.agents.papers.unknown_input_recursion import gains, models


def test_errors_of_the_bound_itself_fill_it() -> None:
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(2, 2, 40))
    bounds = np.einsum("ijh,kjh->ikh", roots, roots) + np.eye(2)[..., None]
    draws = rng.standard_normal((40, 2, 2000))
    errors = np.linalg.cholesky(np.moveaxis(bounds, -1, 0)) @ draws
    # 80,000 squares of standard normals have a mean within 0.03 of 1, the larger of two too.
    assert leading(errors, bounds).mean() == pytest.approx(1.0, abs=0.03)
    assert leading(0.5 * errors, bounds).mean() == pytest.approx(0.25, abs=0.01)


def test_no_gain_that_hides_the_input_has_a_smaller_bound() -> None:
    """(18) under random gains that meet (14), against the best one and the printed one."""
    _, system = make_example(example=CARTS, filter="paper")
    model = models(system, 0.2, 0.09)[0]
    values = gains(model, model.covariance[None], np.array([False]), 0.5)
    a, b, c = model.transition, model.inputs, model.matrix
    phi = 1.2 * a @ model.covariance @ a.T + model.process
    noise = model.noise + 6.0 * 0.09 * np.eye(2)
    free = np.linalg.svd(c @ b)[0][:, 1:]

    def trace(gain: np.ndarray) -> float:
        retention = np.eye(4) - gain @ c
        return float(np.trace(retention @ phi @ retention.T + gain @ noise @ gain.T))

    best = values["best"][0]
    assert trace(best) == pytest.approx(float(np.trace(values["best_bound"][0])))
    assert best @ c @ b == pytest.approx(b)
    assert values["gain"][0] @ c @ b == pytest.approx(b)
    rng = np.random.default_rng(1)
    for _ in range(200):
        other = best + 0.3 * rng.normal(size=(4, 1)) @ free.T
        assert trace(other) >= trace(best)
    assert trace(values["gain"][0]) > trace(best)
