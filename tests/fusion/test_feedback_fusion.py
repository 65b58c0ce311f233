"""Covariance intersection of nodes with feedback, and fusion rules in every environment."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.fusion.table import Structure, choose_rule
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

Array = NDArray[np.float64]
TOBIT = "fusion_gym/TobitOscillator-v1"
BIASED = "fusion_gym/BiasedOscillator-v2"
TRACKING = "fusion_gym/BiasedTracking-v1"
CORRELATED = "fusion_gym/CorrelatedTracking-v1"
STRUCTURE = Structure("all nodes start from the same prediction", ("information shares",))


def positive_definite(generator: np.random.Generator, size: int) -> Array:
    factor = generator.normal(size=(size, size + 1))
    return factor @ factor.T * 10.0 ** generator.uniform(-2, 2)


@pytest.mark.parametrize("rule", ["federated", "ci", "ici", "sci", "sici"])
def test_deliveries_of_each_node_alone(rule: str) -> None:
    """``fuse_single`` against ``fuse`` of the covariances that it stands for."""
    fusion = choose_rule(rule, STRUCTURE, 2)
    generator = np.random.default_rng(3)
    silent = np.stack([positive_definite(generator, 3) for _ in range(2)])[..., None]
    delivered = 0.3 * silent
    nobody, single = fusion.fuse_single(silent, delivered)
    zero = np.zeros((2, 3, 1))
    np.testing.assert_allclose(nobody, fusion.fuse(zero, silent).covariance, rtol=1e-9)
    for node in range(2):
        selected = silent.copy()
        selected[node] = delivered[node]
        np.testing.assert_allclose(single[node], fusion.fuse(zero, selected).covariance, rtol=1e-9)


def results(env_id: str, policy: str, **options: Any) -> EpisodeResults:
    task = fusion_gym.make_task(env_id, **options)
    return run_episodes(task, make_policy(policy, task), 300, seed=0)


def test_intersection_is_conservative_where_federation_is_exact() -> None:
    """The target is linear and uncensored: NEES is 1 with federated fusion, below it with CI."""
    settings_ = {"access": "any", "tokens": "unlimited"}
    exact = results(TRACKING, "always", **settings_)
    assert exact.nees.mean() == pytest.approx(1.0, abs=0.03)
    for rule in ("ci", "ici"):
        result = results(TRACKING, "always", fusion=rule, **settings_)
        assert result.nees.mean() < 0.9
        assert exact.mse.mean() < result.mse.mean() < 1.15 * exact.mse.mean()


@pytest.mark.parametrize("env_id", [TOBIT, BIASED, TRACKING])
@pytest.mark.parametrize("rule", ["ci", "sci", "sici"])
def test_rules_agree_where_one_node_delivers(env_id: str, rule: str) -> None:
    """With one sensor a step every rule returns that node's filter, as federated fusion does."""
    options = {"access": "single", "tokens": "unlimited", "horizon": 20}
    if env_id == TOBIT:
        options["filter"] = "tobit"
    other = results(env_id, "round_robin", fusion=rule, **options)
    federated = results(env_id, "round_robin", **options)
    np.testing.assert_allclose(other.mse.mean(), federated.mse.mean(), rtol=0.02)


def test_order_of_arrival_matters_to_the_sequential_rules() -> None:
    first = results(TOBIT, "always", filter="tobit", fusion="sci")
    same = results(TOBIT, "always", filter="tobit", fusion="sci", order=(0, 1, 2))
    assert np.array_equal(first.mse, same.mse)
    matrices = (((1.0, 0.0),), ((0.3, 1.0),), ((0.0, 1.0),))
    options: dict[str, Any] = {"filter": "tobit", "measurement_matrices": matrices}
    forward = results(TOBIT, "always", fusion="sci", **options)
    backward = results(TOBIT, "always", fusion="sci", order=(2, 1, 0), **options)
    assert not np.allclose(forward.bound_trace, backward.bound_trace, rtol=1e-5)


@pytest.mark.parametrize(
    ("env_id", "options", "parts"),
    [
        (TOBIT, {"fusion": "information"}, ("'information'", "same prediction", "'federated'")),
        (TOBIT, {"fusion": "ici"}, ("'ici'", "3 sensors", "'sici'")),
        (TOBIT, {"fusion": "ci", "information_shares": (0.5, 0.3, 0.2)}, ("(0.5, 0.3, 0.2)", "ci")),
        (TOBIT, {"fusion": "ci", "order": (0, 1, 2)}, ("(0, 1, 2)", "'ci'", "'sci'")),
        (TOBIT, {"filter": "adf", "fusion": "ci"}, ("'ci'", "filter='adf'", "nodes")),
        (CORRELATED, {"fusion": "federated"}, ("'federated'", "'sici'", "correlated")),
        (CORRELATED, {"fusion": "ici"}, ("'ici'", "3 sensors", "prediction", "'sici'")),
    ],
)
def test_what_does_not_fit_is_refused(
    env_id: str, options: dict[str, Any], parts: tuple[str, ...]
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        fusion_gym.make_task(env_id, **options)
    assert [part for part in parts if part not in str(caught.value)] == []
