"""Measures of errors on the adaptive innovation paper's page."""

import numpy as np
import pytest

from fusion_gym.agents.papers.adaptive_innovation_runs import _largest, _whitened


def test_a_bound_is_reported_from_what_is_none() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    claimed = root @ root.T + np.eye(3)
    direction = rng.normal(size=3)
    more = claimed + 0.3 * np.outer(direction, direction)
    ratio = 1.0 + 0.3 * direction @ np.linalg.solve(claimed, direction)
    both = np.stack((0.7 * claimed, more), axis=-1)
    values = _largest(both, np.stack((claimed, claimed), axis=-1))
    assert values == pytest.approx([0.7, ratio])


def test_whitened_errors_sum_to_the_normalised_square() -> None:
    rng = np.random.default_rng(1)
    root, error = rng.normal(size=(3, 3)), rng.normal(size=(3, 1))
    claimed = root @ root.T + np.eye(3)
    square = _whitened(error, claimed[..., None])
    assert np.trace(square[..., 0]) == pytest.approx(
        float(error[:, 0] @ np.linalg.solve(claimed, error[:, 0]))
    )
