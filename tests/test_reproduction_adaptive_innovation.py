"""The page of the adaptive innovation paper against a fresh quick run."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from reproduction_checks import check_claims, check_numbers, check_pictures, committed, quick

from fusion_gym.agents.reproduction.adaptive_innovation import PAPER
from fusion_gym.agents.reproduction.adaptive_innovation.errors import _largest, _whitened
from fusion_gym.agents.reproduction.shown import Shown

EPISODES = 12
UNCERTAIN = (  # decided by rare errors, or by intervals that twelve episodes leave wide
    "The rates of the three sensors",
    "The MSE is close",
    "More than 99 %",
    "The actual deviations never exceed",
    "P̄ is the covariance",
    "The trigger saves",
)


@cache
def fresh() -> dict[str, Shown]:
    return quick(PAPER, EPISODES)


def test_numbers_agree_with_the_page() -> None:
    assert check_numbers(committed(PAPER.name), fresh(), EPISODES) > 50


def test_claims_and_their_verdicts() -> None:
    check_claims(committed(PAPER.name), fresh(), PAPER.name, UNCERTAIN)


def test_figures_draw() -> None:
    assert check_pictures(fresh(), PAPER.name) == 7


def test_a_bound_is_told_from_what_is_none() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    claimed = root @ root.T + np.eye(3)
    direction = rng.normal(size=3)
    more = claimed + 0.3 * np.outer(direction, direction)
    ratio = 1.0 + 0.3 * direction @ np.linalg.solve(claimed, direction)
    both = np.stack((0.7 * claimed, more), axis=-1)
    found = _largest(both, np.stack((claimed, claimed), axis=-1))
    assert found == pytest.approx([0.7, ratio])


def test_whitened_errors_sum_to_the_normalised_square() -> None:
    rng = np.random.default_rng(1)
    root, error = rng.normal(size=(3, 3)), rng.normal(size=(3, 1))
    claimed = root @ root.T + np.eye(3)
    square = _whitened(error, claimed[..., None])
    assert np.trace(square[..., 0]) == pytest.approx(
        float(error[:, 0] @ np.linalg.solve(claimed, error[:, 0]))
    )
