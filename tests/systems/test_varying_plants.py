"""Plants whose matrices vary with the step: closed forms, an independent loop, and refusals."""

from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.jax import FunctionalEnv
from fusion_gym.solvers.silence.problem import silence_model
from fusion_gym.validation import ConfigurationError

Array = NDArray[Any]
LINEAR, TRACKING = "fusion_gym/LinearFusion-v2", "fusion_gym/CorrelatedTracking-v1"
T, SIZES = 7, (2, 1)


def stacks(full: bool = False) -> dict[str, Any]:
    """Random stacks of two states and two sensors, with covariances of any rank."""
    generator = np.random.default_rng(3)
    roots = generator.normal(size=(T, 2, 2)) * (np.arange(T) % 3 > 0)[:, None, None]
    wide = [generator.normal(size=(T, size, size + 1)) for size in SIZES]
    noise = [0.2 * root @ root.swapaxes(1, 2) + 0.1 * np.eye(root.shape[1]) for root in wide]
    if not full:
        noise = [matrix * np.eye(matrix.shape[1]) for matrix in noise]
    return {
        "transition": 0.4 * generator.normal(size=(T, 2, 2)),
        "process_covariance": 0.3 * roots @ roots.swapaxes(1, 2),
        "measurement_matrices": [generator.normal(size=(T, size, 2)) for size in SIZES],
        "measurement_covariances": noise,
    }


def place(step: int, end: str) -> int:
    return step % T if end == "repeat" else min(step, T - 1)


@pytest.mark.parametrize("end", ["repeat", "hold"])
@pytest.mark.parametrize(
    "options",
    [
        {"filter": "kalman"},
        {"filter": "kalman", "information_shares": (0.2, 0.8)},
        {"filter": "joint"},
        {"filter": "adf"},
        {"filter": "kalman", "backend": "compiled"},
    ],
    ids=["equal", "shares", "joint", "adf", "compiled"],
)
def test_the_centre_is_the_kalman_filter_of_the_product_form(
    options: dict[str, Any], end: str
) -> None:
    """Means and covariances of runs at different steps, against textbook updates of each run."""
    own, runs = stacks(), 3
    task = fusion_gym.make_task(
        LINEAR, schedule=own | {"end": end}, tokens="unlimited", horizon=25, **options
    )
    batch = EpisodeBatch.seeded(task, runs, 0)
    request = np.random.default_rng(1).random((20, 2, runs)) < 0.5

    def update(mean: Array, covariance: Array, at: int, sensor: int, y: Array) -> Any:
        matrix = own["measurement_matrices"][sensor][at]
        total = matrix @ covariance @ matrix.T + own["measurement_covariances"][sensor][at]
        gain = covariance @ matrix.T @ np.linalg.inv(total)
        keep = np.eye(2) - gain @ matrix
        noise = own["measurement_covariances"][sensor][at]
        covariance = keep @ covariance @ keep.T + gain @ noise @ gain.T
        return mean + gain @ (y[: len(matrix)] - matrix @ mean), covariance

    plain = []
    for run in range(runs):
        estimate: Any = np.zeros(2), np.eye(2)
        for sensor in range(2):
            y = batch.state.estimate.held[sensor, :, run]
            estimate = update(*estimate, 0, sensor, y)
        plain.append(estimate)
    for step, requests in enumerate(request):
        moved, measured = place(step, end), place(step + 1, end)
        y = batch.signals()["measurement"]
        batch.step(requests)
        for run in range(runs):
            mean, covariance = plain[run]
            matrix = own["transition"][moved]
            estimate = (
                matrix @ mean,
                matrix @ covariance @ matrix.T + own["process_covariance"][moved],
            )
            for sensor in np.flatnonzero(requests[:, run]):
                estimate = update(*estimate, measured, sensor, y[sensor, :, run])
            plain[run] = estimate
        state = batch.delivered.estimate
        mean, covariance = (np.stack(parts, -1) for parts in zip(*plain, strict=True))
        np.testing.assert_allclose(state.mean, mean, rtol=0, atol=1e-12)
        np.testing.assert_allclose(state.covariance, covariance, rtol=0, atol=1e-12)


@pytest.mark.parametrize("full", [False, True])
def test_the_truth_follows_the_matrices(full: bool) -> None:
    """Squared errors of many runs against the claimed covariance; a wrong step exceeds it."""
    schedule = stacks(full) | {"end": "hold"}
    task = fusion_gym.make_task(LINEAR, schedule=schedule, tokens="unlimited", horizon=12)
    batch, runs = EpisodeBatch.seeded(task, 4000, 0), 4000
    for requests in np.random.default_rng(2).random((12, 2)) < 0.6:
        outcome = batch.step(np.repeat(requests[:, None], runs, axis=1))
        covariance = batch.delivered.estimate.covariance[..., 0]
        weighted = (outcome.error * np.linalg.solve(covariance, outcome.error)).sum(0)
        assert abs(weighted.mean() - 2.0) < 5.0 * 2.0 / np.sqrt(runs)  # chi-squared, variance 4


SAME: list[tuple[str, dict[str, Any]]] = [
    (LINEAR, {}),
    (LINEAR, {"filter": "joint"}),
    (LINEAR, {"fusion": "ci"}),
    (LINEAR, {"filter": "stochastic", "stochastic_weight": 0.5}),
    (LINEAR, {"filter": "truncated", "trigger": "report_on_change", "trigger_threshold": 0.8}),
    (LINEAR, {"filter": "adf", "censoring_threshold": -0.5}),
    (LINEAR, {"filter": "tobit", "censoring_threshold": -0.5}),
    (TRACKING, {"noise_scale": "random"}),
    (TRACKING, {"fusion": "ci"}),
]
COMPILED = [
    pytest.param(*case, False, "compiled", marks=pytest.mark.slow if number > 0 else ())
    for number, case in enumerate(SAME)
    if case[1].get("filter") != "truncated"
]
UNDER_NUMPY = [(*case, False, "numpy") for case in SAME]
UNDER_NUMPY += [
    pytest.param(*case, True, "numpy", marks=pytest.mark.slow if case[0] == TRACKING else ())
    for case in SAME
]


@pytest.mark.parametrize(("env_id", "options", "memory", "backend"), [*UNDER_NUMPY, *COMPILED])
def test_a_stack_of_equal_matrices_is_the_constant_plant(
    env_id: str, options: dict[str, Any], memory: bool, backend: str
) -> None:
    """Bitwise over 200 steps with autoresets; the last matrices differ, and are not reached.

    LLVM rounds products with constants in another order.
    """
    common = {"horizon": 30, "memory": memory, "backend": backend} | options
    plain = fusion_gym.make_task(env_id, **common)
    # The last entries differ, so that every array has an axis of steps.
    schedule: dict[str, Any] = {}
    names = ("transition", "process_covariance", "process_gain", "noise_coupling")
    for name in (*names, "measurement_matrices", "measurement_variance", "measurement_covariances"):
        value = plain.settings.get(name)
        if value is None:
            continue
        if name == "measurement_covariances":
            value = [value] * plain.sensors
        each = [np.asarray(value)] if name in names[:3] else [np.asarray(part) for part in value]
        parts = [np.stack([part] * 40 + [0.9 * part]) for part in each]
        schedule[name] = parts[0] if name in names[:3] else parts
    request = np.random.default_rng(0).random((200, plain.sensors, 3)) < 0.5

    def record(**more: Any) -> list[Any]:
        envs = gymnasium.make_vec(env_id, 3, **common, **more)
        result = [envs.reset(seed=4)]
        for requests in request:
            result.append(envs.step(requests.T.astype(np.int8)))
        return result

    compare: Any = partial(np.testing.assert_array_equal, strict=True)
    if backend == "compiled":
        compare = partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-12)
    for one, other in zip(record(), record(schedule=schedule), strict=True):
        jax.tree.map(compare, one, other)


@pytest.mark.parametrize("end", ["repeat", "hold"])
def test_nodes_with_correlated_noises(end: str) -> None:
    """Each node against the conditional law of plain matrices, and its errors against it."""
    generator = np.random.default_rng(5)
    own: dict[str, Any] = {
        "transition": np.eye(3) + 0.1 * generator.normal(size=(T, 3, 3)),
        "process_gain": generator.normal(size=(T, 3, 2)),
        "process_variance": generator.uniform(0.1, 1.0, size=(T, 2)),
        "measurement_matrices": generator.normal(size=(3, T, 1, 3)),
        "measurement_variance": generator.uniform(0.1, 1.0, size=(3, T)),
        "noise_coupling": generator.normal(size=(3, T, 1, 2)),
    }
    task = fusion_gym.make_task(TRACKING, schedule=own | {"end": end}, horizon=16)
    batch, runs = EpisodeBatch.seeded(task, 3000, 0), 3000
    means = np.repeat(task.estimator.model.initial_mean[None], runs, axis=-1).repeat(3, axis=0)  # type: ignore[attr-defined]
    covariances = np.repeat(np.eye(3)[None], 3, axis=0)
    for step, requests in enumerate(generator.random((16, 3)) < 0.6):
        moved, at = place(step, end), place(step + 1, end)
        y = batch.signals()["measurement"]
        batch.step(np.repeat(requests[:, None], runs, axis=1))
        matrix, gain = own["transition"][moved], own["process_gain"][moved]
        variance = np.diag(own["process_variance"][moved])
        for node in range(3):
            mean, prior = matrix @ means[node], matrix @ covariances[node] @ matrix.T
            prior = prior + gain @ variance @ gain.T
            row = own["measurement_matrices"][node, at]
            coupling = own["noise_coupling"][node, at]
            crossed = prior @ row.T + gain @ variance @ coupling.T
            shared = row @ gain @ variance @ coupling.T
            own_noise = own["measurement_variance"][node, at] + coupling @ variance @ coupling.T
            total = row @ prior @ row.T + shared + shared.T + own_noise
            if requests[node]:
                mean = mean + crossed @ np.linalg.solve(total, y[node] - row @ mean)
                prior = prior - crossed @ np.linalg.solve(total, crossed.T)
            means[node], covariances[node] = mean, prior
        estimate = batch.delivered.estimate
        np.testing.assert_allclose(estimate.means[1:], means, rtol=1e-9, atol=1e-9)
        expected = np.broadcast_to(covariances[..., None], estimate.covariances[1:].shape)
        np.testing.assert_allclose(estimate.covariances[1:], expected, rtol=1e-9, atol=1e-9)
    for mean, covariance in zip(means, covariances, strict=True):
        error = batch.delivered.plant.truth - mean
        weighted = (error * np.linalg.solve(covariance, error)).sum(0)
        assert abs(weighted.mean() - 3.0) < 5.0 * np.sqrt(6.0 / runs)


def test_files_and_mappings_are_the_same_schedule(tmp_path: Path) -> None:
    own = {name: value for name, value in stacks().items() if "measurement" not in name}
    own["measurement_matrices"] = np.random.default_rng(0).normal(size=(2, T, 2))
    (tmp_path / "plant.yaml").write_text(
        yaml.safe_dump({name: value.tolist() for name, value in own.items()} | {"end": "hold"})
    )
    np.savez(tmp_path / "plant.npz", **own, end="hold")
    every = [own | {"end": "hold"}, str(tmp_path / "plant.yaml"), str(tmp_path / "plant.npz")]
    covariances = []
    for schedule in every:
        task = fusion_gym.make_task(LINEAR, schedule=schedule, horizon=20)
        batch = EpisodeBatch.seeded(task, 2, 0)
        for _ in range(9):
            batch.step(np.ones((2, 2), dtype=np.bool_))
        covariances.append(batch.delivered.estimate.covariance)
    np.testing.assert_array_equal(covariances[1], covariances[0])
    np.testing.assert_array_equal(covariances[2], covariances[0])


EYE = np.eye(2)


@pytest.mark.parametrize(
    ("schedule", "message"),
    [
        (3, "schedule = 3 is not allowed"),
        ({}, "schedule = {} is not allowed"),
        ({"end": "hold"}, "one or more stacks"),
        ({"transitions": [EYE]}, "did you mean 'transition'"),
        ({1: [EYE]}, "unknown entry of schedule '1'"),
        ({"transition": []}, "schedule: transition = .* for each step"),
        ({"transition": 1.0}, "schedule: transition = 1.0"),
        ({"transition": [EYE], "end": "stop"}, "schedule: end = 'stop'"),
        ({"transition": [EYE] * 2, "process_covariance": [EYE] * 3}, "all of one length"),
        ({"transition": [EYE, np.eye(3)]}, "schedule: transition at step 1"),
        ({"transition": [EYE, [[1.0], [0.0, 1.0]]]}, "schedule: transition at step 1"),
        ({"transition": [EYE, EYE * np.nan]}, "schedule at step 1: transition = .* finite"),
        ({"transition": [EYE, [["a", "b"]] * 2]}, "schedule at step 1: transition"),
        ({"process_covariance": [EYE, -EYE]}, "schedule at step 1: process_covariance"),
        ({"process_covariance": [np.eye(3)]}, "schedule at step 0: process_covariance"),
        ({"measurement_matrices": 2}, "a stack for each sensor"),
        ({"measurement_matrices": []}, "a stack for each sensor"),
        ({"measurement_matrices": [[[1.0, 0.0, 0.0]]] * 2}, "step 0: measurement_matrices"),
        ({"measurement_covariances": [[1.0, 0.0], [1.0, 1.0]]}, "step 1: measurement_cov"),
        ({"measurement_covariances": [[1.0, 2.0]]}, "step 0: measurement_covariances"),
        ("plant.txt", "schedule = 'plant.txt' is not allowed"),
        ("absent.yaml", "schedule = 'absent.yaml' cannot be read"),
        ("absent.npz", "schedule = 'absent.npz' cannot be read"),
    ],
)
def test_bad_stacks_are_refused_with_field_and_step(schedule: Any, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        fusion_gym.make_task(LINEAR, schedule=schedule)


W = np.stack([EYE, 2.0 * EYE])


@pytest.mark.parametrize(
    ("env_id", "options", "message"),
    [
        (LINEAR, {"filter": "hold"}, "schedule is not allowed with filter='hold'"),
        (LINEAR, {"memory": True, "memory_filter": "hold"}, "with filter='hold'"),
        (LINEAR, {"process_covariance": 3.0 * EYE}, "process_covariance = .* left out with"),
        (TRACKING, {"track_actual": True}, "schedule is not allowed with track_actual=True"),
        ("fusion_gym/RecordedFusion-v1", {}, "schedule"),
        ("fusion_gym/TobitOscillator-v1", {}, "unknown option 'schedule'"),
    ],
)
def test_what_needs_constant_matrices_refuses_a_schedule(
    env_id: str, options: dict[str, Any], message: str
) -> None:
    name = "process_variance" if env_id == TRACKING else "process_covariance"
    schedule = {name: [0.1, 0.2] if env_id == TRACKING else W}
    with pytest.raises(ConfigurationError, match=message):
        fusion_gym.make_task(env_id, schedule=schedule, **options)


def test_solvers_and_parameters_of_filters_refuse_a_schedule() -> None:
    task = fusion_gym.make_task(LINEAR, schedule={"process_covariance": W})
    with pytest.raises(ConfigurationError, match="schedule is not allowed for the bound"):
        silence_model(task)
    env, changed = FunctionalEnv(task), np.eye(2)
    env.reset(jax.random.key(0), env.default_params)
    with pytest.raises(ConfigurationError, match="not allowed with another process covariance"):
        env.reset(jax.random.key(0), env.default_params._replace(process_covariance=changed))
    varying = fusion_gym.make_task(TRACKING, schedule={"process_variance": [0.1, 0.2]})
    with pytest.raises(ConfigurationError, match="policy 'periodic_optimum' is not allowed"):
        fusion_gym.make_policy("periodic_optimum", varying)


@pytest.mark.parametrize("end", ["repeat", "hold"])
def test_the_periodic_optimum_follows_the_schedule(end: str) -> None:
    """The best of all pairs of steps by plain products; the first sensor measures everything."""
    scale = np.array([1.0, 30.0, 1.0])
    task = fusion_gym.make_task(
        LINEAR,
        schedule={"process_covariance": scale[:, None, None], "end": end},
        transition=[[0.9]],
        measurement_matrices=[[1.0]],
        tokens="unlimited",
    )
    policy: Any = fusion_gym.make_policy("periodic_optimum:packets=1,period=3", task)
    traces = []
    for sent in range(3):
        variance, trace = 0.2, []
        for step in range(90):
            at = step % 3 if end == "repeat" else min(step, 2)
            variance = 0.81 * variance + scale[at]
            if step % 3 == sent:
                variance = 1.0 / (1.0 / variance + 1.0 / 0.25)
            trace.append(variance)
        traces.append(np.mean(trace[-3:]))
    assert policy.trace == pytest.approx(min(traces), rel=1e-6)
    if end == "repeat":
        assert int(policy.schedule[:, 0].argmax()) == int(np.argmin(traces)) == 1
