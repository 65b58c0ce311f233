"""What tests of several systems do with batches of episodes."""

from __future__ import annotations

import numpy as np
import pytest

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task


def assert_a_run_is_the_same_beside_others(task: Task, delivered: tuple[str, ...] = ()) -> None:
    """A run begun late beside four others (three sensors, 30 steps) is what it is alone.

    ``delivered`` names fields of the delivered state that are compared too.
    """
    alone, together = EpisodeBatch(task, 1), EpisodeBatch(task, 5)
    alone.seed(np.arange(1), [3])
    alone.reset()
    together.seed(np.arange(5), [9, 8, 7, 6, 5])
    together.reset()
    draw = np.random.default_rng(0)
    for _ in range(11):
        together.step(draw.random((3, 5)) < 0.3)
    together.seed(np.array([2]), [3])
    together.reset(np.array([2]))
    for _ in range(30):
        requests = draw.random((3, 5)) < 0.3
        np.testing.assert_allclose(together.observe()[2], alone.observe()[0], rtol=1e-6, atol=1e-7)
        one, many = alone.step(requests[:, 2:3]), together.step(requests)
        assert many.reward[2] == pytest.approx(one.reward[0], rel=1e-10)
        for name in delivered:
            single = getattr(alone.delivered, name)[..., 0]
            beside = getattr(together.delivered, name)[..., 2]
            np.testing.assert_allclose(beside, single, rtol=1e-10, atol=1e-13)
        together.finished[:] = False
