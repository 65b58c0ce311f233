"""A matrix of weights: reward, values, beliefs, rollout and scale against their definitions."""

import numpy as np
import pytest

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.errors import ConfigurationError
from fusion_gym.evaluation import run_episodes
from fusion_gym.solvers.silence import cost_bound

W = np.array([[2.0, -1.2], [-1.2, 1.0]])
LINEAR = "fusion_gym/LinearFusion-v2"


def task_of(**options):
    return fusion_gym.make_task(LINEAR, **{"reward_scale": None, "state_weights": W} | options)


def run(task, steps=12, runs=5):
    batch, generator = EpisodeBatch.seeded(task, runs, seed=3), np.random.default_rng(0)
    for _ in range(steps):
        beliefs = batch.beliefs()
        yield batch, batch.step(generator.random((task.sensors, runs)) < 0.4), beliefs


@pytest.mark.parametrize("backend", ["numpy", pytest.param("compiled", marks=pytest.mark.slow)])
def test_reward_and_values_are_quadratic_forms(backend):
    task = task_of(memory=True, backend=backend, error_weight=3.0)
    for _, outcome, beliefs in run(task):
        expected = -3.0 * np.einsum("in,ij,jn->n", outcome.error, W, outcome.error)
        np.testing.assert_allclose(outcome.reward_error, expected, rtol=1e-12)
        apart = beliefs.best.mean - beliefs.silent.mean
        loss = np.einsum("kin,ij,kjn->kn", apart, W, apart) / (np.trace(W) / 2.0)
        np.testing.assert_allclose(beliefs.loss, loss, rtol=1e-11, atol=1e-15)


def test_traces_are_of_the_product():
    for batch, outcome, _ in run(task_of(error="trace")):
        covariance = batch.task.estimator.covariance(batch.delivered.estimate)
        expected = np.einsum("ij,jin->n", W, covariance)
        np.testing.assert_allclose(-outcome.reward_error, expected, rtol=1e-12)


@pytest.mark.parametrize("kind", ["squared", "excess", "mismatch"])
def test_training_errors(kind):
    reward, generator = task_of(error_weight=2.0).reward, np.random.default_rng(1)
    error, reference = generator.standard_normal((2, 2, 3, 4))

    def cost(e):
        return np.einsum("iab,ij,jab->ab", e, W, e)

    expected = {
        "squared": cost(error),
        "excess": cost(error) - cost(reference),
        "mismatch": cost(error - reference),
    }[kind]
    found = reward.training_error(kind, error, reference)
    np.testing.assert_allclose(found, -2.0 * expected, rtol=1e-12)


def test_a_diagonal_matrix_is_a_vector_of_weights():
    matrix, vector = task_of(state_weights=np.diag([2.0, 3.0])), task_of(state_weights=[2.0, 3.0])
    assert matrix.reward.state_weights.tolist() == vector.reward.state_weights.tolist()
    fusion_gym.make_task(LINEAR, state_weights=np.diag([2.0, 3.0]), fusion="ci")


def test_a_change_of_basis_changes_no_cost():
    """x = S z with weights Sᵀ W S has the same rewards, values and scale as x with W."""
    basis = np.array([[1.0, 0.4], [-0.3, 2.0]])
    back = np.linalg.inv(basis)
    plain = {
        "transition": np.array([[1.0, 0.1], [0.0, 1.0]]),
        "process_covariance": np.array([[0.02, 0.01], [0.01, 0.1]]),
        "measurement_matrices": [np.array([[1.0, 0.0]]), np.array([[0.0, 1.0]])],
        "initial_covariance": np.eye(2),
        "memory": True,
    }
    moved = plain | {
        "transition": back @ plain["transition"] @ basis,
        "process_covariance": back @ plain["process_covariance"] @ back.T,
        "measurement_matrices": [row @ basis for row in plain["measurement_matrices"]],
        "initial_covariance": back @ back.T,
        "state_weights": basis.T @ W @ basis,
    }
    costs = []
    for options in (plain | {"state_weights": W}, moved):
        task = fusion_gym.make_task(LINEAR, reward_scale=None, horizon=50, **options)
        policy = f"value_of_information:threshold={0.02 / task.error_scale!r}"
        results = run_episodes(task, fusion_gym.make_policy(policy, task), 400, seed=0)
        costs.append((results.error_cost.mean(), results.tokens.mean()))
    np.testing.assert_allclose(costs[0], costs[1], rtol=0.12)


def test_the_scale_makes_an_even_pace_cost_one():
    task = fusion_gym.make_task(LINEAR)
    free = np.array([[1.0, 0.5], [0.5, 2.0]])
    weighed = fusion_gym.make_task(LINEAR, state_weights=free)
    assert weighed.reward.state_weights[..., 0].tolist() == free.tolist()  # explicit: not scaled
    twice = fusion_gym.make_task(LINEAR, state_weights=free, reward_scale=2.0)
    assert twice.reward.state_weights[..., 0].tolist() == (2.0 * free).tolist()
    assert task.reward.state_weights.ndim == 2


@pytest.mark.parametrize(
    ("weights", "allowed"),
    [
        ([[1.0, 0.5], [0.4, 1.0]], "symmetric"),
        ([[1.0, 2.0], [2.0, 1.0]], "positive semi-definite"),
        ([[1.0, 0.0, 0.0]], "(2, 2)"),
        ([1.0, -1.0], ">= 0"),
    ],
)
def test_other_values_are_refused(weights, allowed):
    with pytest.raises(ConfigurationError, match="state_weights") as error:
        task_of(state_weights=weights)
    assert allowed in str(error.value)


REFUSALS = {
    "maximum": lambda: task_of(error="maximum"),
    "a trace of a fusion rule": lambda: task_of(fusion="ci"),
    "a trace among signals": lambda: fusion_gym.make_task(
        "fusion_gym/MarkovJumpTracking-v1", state_weights=W
    ),
    "sources": lambda: fusion_gym.make_task(
        "fusion_gym/RemoteEstimation-v1", sensors=2, state_weights=W
    ),
    "a bound": lambda: cost_bound(task_of(), 1.0),
}


@pytest.mark.parametrize("use", REFUSALS)
def test_what_needs_a_number_for_each_state_refuses_a_matrix(use):
    with pytest.raises(ConfigurationError, match=r"state_weights.*a number for each state"):
        REFUSALS[use]()
