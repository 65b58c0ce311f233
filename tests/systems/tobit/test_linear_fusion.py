"""A linear system of one's own, against plain matrices of an independent filter."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

Array = NDArray[np.float64]
LINEAR = "fusion_gym/LinearFusion-v2"


def system(seed: int, states: int, sizes: list[int]) -> dict[str, Any]:
    """A stable plant of any coupling; sensors of these sizes with full covariances."""
    generator = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(generator.normal(size=(states, states)))
    factor = generator.normal(size=(states, 2))
    covariances = []
    for size in sizes:
        root = generator.normal(size=(size, size + 1))
        covariances.append(0.5 * root @ root.T + 0.1 * np.eye(size))
    return {
        "transition": 0.97 * rotation,
        "process_covariance": 0.1 * factor @ factor.T,
        "initial_mean": generator.normal(size=states),
        "initial_covariance": 0.5 * np.eye(states),
        "measurement_matrices": [generator.normal(size=(size, states)) for size in sizes],
        "measurement_covariances": covariances,
    }


def reference(options: dict[str, Any], granted: list[int], prior: Array) -> Array:
    """The posterior covariance of a centralised filter that takes the granted in full."""
    covariance = prior
    for place in granted:
        matrix, noise = (
            options[f"measurement_{name}"][place] for name in ("matrices", "covariances")
        )
        gain = covariance @ matrix.T @ np.linalg.inv(matrix @ covariance @ matrix.T + noise)
        covariance = covariance - gain @ matrix @ covariance
    return covariance


@pytest.mark.parametrize(("states", "sizes"), [(2, [1, 1]), (3, [2, 1, 3]), (12, [1, 2] * 20)])
def test_the_centre_is_the_optimal_filter(states: int, sizes: list[int]) -> None:
    """Covariances step by step; the squared errors of many runs against their trace."""
    options = system(7, states, sizes)
    task = fusion_gym.make_task(LINEAR, tokens="unlimited", **options)
    batch = EpisodeBatch.seeded(task, 400, 0)
    generator = np.random.default_rng(1)
    covariance = reference(options, list(range(len(sizes))), options["initial_covariance"])
    normalised = []
    for _ in range(25):
        requests = generator.random(len(sizes)) < 0.3
        moved = options["transition"] @ covariance @ options["transition"].T
        prior = moved + options["process_covariance"]
        covariance = reference(options, np.flatnonzero(requests).tolist(), prior)
        outcome = batch.step(np.repeat(requests[:, None], 400, axis=1))
        fused = batch.delivered.estimate.covariance
        np.testing.assert_allclose(fused[..., 0], covariance, atol=1e-8)
        error = outcome.error
        weighted = np.linalg.solve(covariance, error)
        normalised.append((error * weighted).sum(0))
    # Chi-squared with n degrees of freedom; successive errors of a run are correlated.
    mean = np.mean(normalised)
    spread = np.mean(normalised, axis=0).std() / np.sqrt(400)
    assert abs(mean - states) < 5.0 * spread


def test_censored_sensors_get_a_filter_that_knows_it() -> None:
    common = {"measurement_matrices": [[1, 0], [[0, 1], [1, 1]]], "horizon": 50}
    limited = fusion_gym.make_task(LINEAR, censoring_threshold=[0.0, [-np.inf, 1.0]], **common)
    assert limited.settings["filter"] == "adf"
    assert fusion_gym.make_task(LINEAR, **common).settings["filter"] == "kalman"
    batch = EpisodeBatch.seeded(limited, 2000, 0)
    measured = batch.signals()["measurement"]
    assert measured[0, 0].min() == 0.0
    assert measured[1, 0].min() < 0.0
    assert measured[1, 1].min() == 1.0
    assert not measured[0, 1].any()
    names = EpisodeBatch(limited, 1).layout.names
    assert "censored[0,0]" in names
    assert "censored[0,0]" not in EpisodeBatch(fusion_gym.make_task(LINEAR), 1).layout.names


def test_a_plant_that_no_noise_moves() -> None:
    """What is unknown at the start is all that there is: measured often enough, it is known."""
    still = {"transition": [[1, 0.1], [0, 1]], "process_covariance": np.zeros((2, 2))}
    task = fusion_gym.make_task(LINEAR, tokens="unlimited", horizon=200, **still)
    results = run_episodes(task, make_policy("always", task), 200, 0)
    assert results.squared_error[-1].sum() < 0.05 * results.squared_error[0].sum()
    assert results.nees.mean() == pytest.approx(1.0, abs=0.2)


FILE = """\
transition: [[0.99, 0.1], [0.0, 0.95]]
process_covariance: [[0.001, 0.0], [0.0, 0.05]]
measurement_matrices: [[1, 0], [[0, 1], [1, 1]]]
measurement_covariances: [0.2, [[0.1, 0.02], [0.02, 0.3]]]
token_rate: 2
"""


def test_a_system_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(FILE)
    env = gym.make(LINEAR, system=str(path), token_rate=1.5)
    task = env.unwrapped.task  # type: ignore[attr-defined]
    assert task.settings["token_rate"] == 1.5
    assert task.settings["measurement_covariances"] == [0.2, [[0.1, 0.02], [0.02, 0.3]]]
    assert fusion_gym.make_task(LINEAR, system=str(path)).settings["token_rate"] == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("transitions: [[1]]", "transitions"),
        ("- 1", "a mapping"),
        ("transition: [[1", "plant.yaml"),
        ("token_rate: 1\ntoken_rate: 2", "token_rate"),
        ("transition: [[1, 2]]", "transition"),
    ],
)
def test_a_bad_file_is_reported_by_name(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=message):
        fusion_gym.make_task(LINEAR, system=str(path))
    with pytest.raises(ConfigurationError, match=r"absent\.yaml"):
        fusion_gym.make_task(LINEAR, system=str(tmp_path / "absent.yaml"))
