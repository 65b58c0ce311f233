"""One source on NumPy and JAX: equal results, and no code that JAX cannot trace."""

import ast
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from parts import Parts

import fusion_gym.jax
from fusion_gym import gaussian, linalg, namespace
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.jax import FunctionalEnv

PACKAGE = Path(namespace.__file__).parent
# Modules whose functions take JAX's arrays.
MODULES = ("linalg", "gaussian", "core/access", "core/channel", "core/token_bucket", "core/runs")
MODULES += tuple(f"systems/tobit/{name}" for name in ("centres", "filters", "sensors", "system"))
MODULES += ("systems/remote/system", "systems/linear_plant")
MODULES += tuple(f"fusion/{name}" for name in ("diagonal", "intersection", "rules", "several"))
MODULES += tuple(f"systems/correlated/{name}" for name in ("filters", "system"))
MODULES += tuple(
    f"systems/markov_jump/{name}"
    for name in ("centralised", "linear_minimum_variance", "plant", "system")
)
MODULES += tuple(
    f"systems/unknown_input/{name}" for name in ("filters", "nodes", "plant", "system")
)
NOT_TRACED = ("censored_beyond", "create", "draw", "_advance", "_diagonal_blocks")
RUNS = 5


def definite(size: int) -> Any:
    """Positive definite matrices, and in the last run an indefinite one."""
    root = np.random.default_rng(size).normal(size=(2, RUNS, size, size))
    matrix = root @ root.swapaxes(-1, -2) + 0.1 * np.eye(size)
    matrix[:, -1] *= -1.0
    return np.moveaxis(matrix, 1, -1)


def singular(size: int) -> Any:
    root = np.random.default_rng(size).normal(size=(RUNS, size, max(size - 1, 1)))
    return np.moveaxis(root @ root.swapaxes(-1, -2), 0, -1)


def vectors(size: int) -> Any:
    return np.random.default_rng(1).normal(size=(2, size, RUNS))


ENDS = np.concatenate([np.linspace(-40.0, 80.0, 241), [6.9, 7.0, 7.1, 37.0, 37.6, 38.0]])
LOW, WIDTH = (x.ravel() for x in np.meshgrid(np.linspace(-50.0, 50.0, 31), [0.01, 1.0, 2.9, 9.0]))
CASES: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
    "tobit_moments": (gaussian.tobit_moments, (ENDS,)),
    "interval_moments": (gaussian.interval_moments, (LOW, LOW + WIDTH)),
    "density": (gaussian.density, (ENDS,)),
    "upper_tail": (gaussian.upper_tail, (ENDS,)),
    "erfcx": (namespace.erfcx, (ENDS[ENDS > -30.0],)),
}
for n in (1, 2, 4, 9):
    matrix, vector = definite(n), vectors(n)
    for function in (linalg.cholesky, linalg.inverse, linalg.symmetrise, linalg.trace, linalg.gram):
        CASES[f"{function.__name__}-{n}"] = function, (matrix,)
    CASES[f"root-{n}"] = linalg.root, (singular(n),)
    for function in (linalg.matvec, linalg.solve_vector, linalg.add_diagonal):
        CASES[f"{function.__name__}-{n}"] = function, (matrix, vector)
    for function in (linalg.solve, linalg.whiten, linalg.congruence, linalg.matmul):
        CASES[f"{function.__name__}-{n}"] = function, (matrix, definite(n)[..., ::-1, :])


@pytest.mark.parametrize("name", CASES)
def test_jax_equals_numpy(name: str) -> None:
    function, arguments = CASES[name]
    before = [argument.copy() for argument in arguments]
    with np.errstate(all="ignore"):
        expected, result = function(*arguments), jax.jit(function)(*arguments)
    for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(result), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-11, atol=1e-13)
    for argument, copy in zip(arguments, before, strict=True):
        np.testing.assert_array_equal(argument, copy)  # arguments are not updated in place


@pytest.mark.parametrize(
    "index", [(1,), (slice(None), -1), (slice(1, 3), 0), (slice(2), slice(1, None))]
)
def test_updates_equal_assignment(index: tuple[Any, ...]) -> None:
    array = np.random.default_rng(0).normal(size=(2, 4, 3))[..., : len(index) * 3]
    array = array if len(index) == 2 else array[..., 0]
    expected = array.copy()
    index = (..., *index)
    expected[index] = 7.0
    other = array.copy()
    other[index] += 2.0
    for start in (array.copy, lambda: jax.numpy.asarray(array)):
        np.testing.assert_array_equal(namespace.set_at(start(), index, 7.0), expected)
        np.testing.assert_array_equal(namespace.update_at(np.add, start(), index, 2.0), other)


def test_functions_change_selected_runs_and_lanes_only() -> None:
    array = np.random.default_rng(0).normal(size=(3, RUNS))
    for mask in (array > 0.5, np.zeros_like(array, dtype=np.bool_)):
        expected = np.where(mask, -array, array), np.where(mask.any(0), -array, array)
        for to in (np.copy, jax.numpy.asarray):
            values, selected = to(array), to(mask)
            (lanes,) = namespace.in_lanes(selected, lambda x: [-x], [values], [to(array)], [9.0])
            (runs,) = namespace.in_runs(selected, lambda x: [-x], [values], [to(array)])
            np.testing.assert_array_equal(lanes, expected[0])
            np.testing.assert_array_equal(runs, expected[1])


@pytest.mark.parametrize("module", MODULES)
def test_functions_can_be_traced(module: str) -> None:
    """Index writes stand only where JAX never calls, and in dictionaries."""
    tree = ast.parse((PACKAGE / f"{module}.py").read_text())
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    plain = {
        inner
        for node in classes
        if "traceable = False" in map(ast.unparse, node.body)
        for inner in node.body
    }
    every = (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))
    functions = [node for node in every if node not in plain]
    for function in functions:
        if function.name.endswith("_of_stack") or function.name in NOT_TRACED:
            continue
        blocks = {ast.unparse(n.target) for n in ast.walk(function) if isinstance(n, ast.AnnAssign)}
        for node in ast.walk(function):
            targets = node.targets if isinstance(node, ast.Assign) else []
            targets = [node.target] if isinstance(node, ast.AugAssign) else targets
            writes = [t.value for t in targets if isinstance(t, ast.Subscript)]
            assert not [array for array in writes if ast.unparse(array) not in blocks], (
                function.name
            )


TASKS: list[tuple[str, dict[str, Any]]] = [
    *(("TobitOscillator-v1", {"filter": name}) for name in ("paper", "tobit", "kalman", "adf")),
    ("TobitOscillator-v1", {"filter": "paper", "silent": "predict", "error": "maximum"}),
    ("TobitOscillator-v1", {"filter": "stochastic", "stochastic_weight": 1.0, "error": "trace"}),
    ("BiasedOscillator-v2", {"access": "round_robin"}),
    ("BiasedTracking-v1", {"access": "random", "clock": True}),
    ("LinearFusion-v2", {"price_range": (0.1, 1.0), "cost_weight": "random"}),
    ("LinearFusion-v2", {"filter": "joint", "sharing": "fixed"}),
    ("LinearFusion-v2", {"initial_covariance": [[0.0, 0.0], [0.0, 1.0]], "action": "discrete"}),
    ("RemoteEstimation-v1", {"sensors": 3, "tokens": "limited", "sharing": "fixed"}),
    ("RemoteEstimation-v1", {"sensors": 2, "channel": "gilbert_elliott"}),
    ("CorrelatedTracking-v1", {"noise_scale": "random"}),
    ("MarkovJumpTracking-v1", {}),
    ("UnknownInput-v1", {"filter": "paper", "input_signal": "steps"}),
]  # the last three compile long, as do the following
MORE_TASKS: list[tuple[str, dict[str, Any]]] = [
    ("TobitOscillator-v1", {"filter": "tobit", "fusion": "sici"}),
    *(("MarkovJumpTracking-v1", {"filter": name}) for name in ("centralised", "imm")),
    ("CorrelatedTracking-v1", {"fusion": "ci", "state_weights": (1.0, 2.0, 3.0)}),
    ("CorrelatedTracking-v1", {"fusion": "sci", "order": (2, 0, 1), "track_actual": True}),
    ("UnknownInput-v1", {}),
    ("UnknownInput-v1", {"filter": "predict", "fusion": "sci", "input_signal": "random_walk"}),
]


DERIVATIVES = [
    (TASKS[1], "measurement_variance"),
    (TASKS[1], "information_shares"),
    (TASKS[8], "process_covariance"),
    (TASKS[8], "threshold"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("task_options", "parameter"), DERIVATIVES)
def test_derivatives_equal_central_differences(
    task_options: tuple[str, dict[str, Any]], parameter: str
) -> None:
    """The mean squared error over 100 steps, on fixed requests and noise."""
    name, options = task_options
    task, rng = fusion_gym.make_task(f"fusion_gym/{name}", **options), np.random.default_rng(0)
    env, estimator, steps = FunctionalEnv(task), task.estimator, 100
    branch = EpisodeBatch.seeded(task, 1, 0).branch()
    requests = rng.random((steps, task.sensors, 1)) < 0.4
    noise = rng.normal(size=(steps, branch.channels, 1))
    sensors = estimator.centre.sensors
    start = {
        "process_covariance": estimator.model.process_covariance[..., 0],
        "measurement_variance": sensors.variance[..., 0],
        "information_shares": np.full(sensors.count, 1.0 / sensors.count),
        "threshold": np.full(sensors.count, 1.0),
    }[parameter]
    direction = rng.normal(size=start.shape)
    direction = (direction + direction.T) * 0.01 if parameter == "process_covariance" else direction
    if parameter == "information_shares":
        direction = (direction - direction.mean()) / 10.0

    def smooth(scale: Any) -> Any:
        threshold = start + scale * direction

        def step(state: Any, noise: Any) -> Any:
            norm = jax.numpy.linalg.norm(env.signals(state)["innovation"], axis=1)[:, 0]
            state, outcome = env.expected_step(
                noise, state, jax.nn.sigmoid(5.0 * (norm - threshold))
            )
            return state, outcome.reward.sum()

        return jax.lax.scan(step, branch.position(), noise)[1].mean()

    def error(scale: Any) -> Any:
        if parameter == "threshold":
            return smooth(scale)
        changed = estimator.with_parameters(**{parameter: start + scale * direction})
        parts = Parts(task.plant, changed)

        def step(state: Any, inputs: Any) -> Any:
            delivered = parts.deliver(state, inputs[0])
            error = parts.truth(delivered) - parts.fused(delivered)[0]
            return parts.sense(delivered, inputs[1]), (error * error).sum()

        first = jax.tree.map(jax.numpy.asarray, branch.state._replace(network=None))
        return jax.lax.scan(step, first, (requests, noise))[1].mean()

    width = 1e-5
    both = jax.jit(jax.value_and_grad(error))
    difference = (both(width)[0] - both(-width)[0]) / (2.0 * width)
    np.testing.assert_allclose(both(0.0)[1], difference, rtol=1e-6, atol=1e-8)
