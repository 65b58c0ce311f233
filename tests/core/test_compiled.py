"""Programs of JAX in machine code, and the cache of their code."""

import ctypes
import dataclasses
import gc
import hashlib
import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import gymnasium
import jax
import jax.numpy as jnp
import llvmlite.binding as llvm
import numpy as np
import pytest
from jax import lax
from jax.scipy.special import erf, erfc

import fusion_gym
import fusion_gym.jax
from fusion_gym.core import compiled
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import run_priced, run_several
from fusion_gym.lowering import Buffer, LoweringError, assembly

LINEAR, REMOTE = "fusion_gym/LinearFusion-v2", "fusion_gym/RemoteEstimation-v1"
VALUES = np.array([-np.inf, -3.5, -1.0, -0.0, 0.0, 0.25, 1.0, 2.0, 7.5, np.inf, np.nan])


def run(
    function: Callable[..., Any], *columns: Any, most: int = compiled.MOST_INSTRUCTIONS
) -> np.ndarray:
    """The results (entries,) of a function of columns (entries,).

    Each of six runs, of rolled columns, has the bits of the run alone.
    """
    arrays = [np.asarray(column, np.float64)[:, None] for column in columns]
    closed = jax.make_jaxpr(lambda *x: jnp.atleast_1d(function(*(a[:, 0] for a in x))))(*arrays)
    real = np.dtype(np.float64)
    out = np.zeros((closed.out_avals[0].size, 1), closed.out_avals[0].dtype)
    text = assembly(closed, [Buffer(real, arrays)], [Buffer(real, [out], out.size)], most)
    code = compiled._compile(text)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), compiled._machine(jit=True))
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    pointers = [ctypes.c_void_p] * 2
    step = ctypes.CFUNCTYPE(None, ctypes.c_int64, *pointers)(engine.get_function_address("step"))
    rows = [np.concatenate([np.roll(a[:, 0], turn) for a in arrays]) for turn in range(6)]

    def results(runs: list[np.ndarray]) -> np.ndarray:
        inputs, result = np.ascontiguousarray(np.transpose(runs)), np.empty((len(runs), out.size))
        step(len(runs), inputs.ctypes.data, result.ctypes.data)
        return result

    together = results(rows)
    for own, row in zip(together, rows, strict=True):
        np.testing.assert_array_equal(own, results([row])[0])
    return together[0]


def doubled_or_summed(a: Any) -> Any:
    return lax.cond(a[0] > 0.0, lambda x: x * 2.0, jnp.cumsum, a)


def newton(x: Any) -> Any:
    """√a by a loop whose length depends on a."""
    start = jnp.ones(x.shape), x, 0
    far = lambda s: (jnp.abs(s[0] * s[0] - s[1]) > 1e-14 * s[1]).any() & (s[2] < 60)  # noqa: E731
    return lax.while_loop(far, lambda s: ((s[0] + s[1] / s[0]) / 2, s[1], s[2] + 1), start)[0]


def halvings(x: Any) -> Any:
    """How often the first number is halved until it is 1 at most."""
    start = x[0], 0.0
    return lax.while_loop(lambda s: s[0] > 1.0, lambda s: (s[0] / 2.0, s[1] + 1.0), start)[1]


PAIR, FINITE = (VALUES, VALUES[::-1]), VALUES[1:-2]
MATRIX = np.array([4.0, 1.0, 0.5, 1.0, 3.0, 0.2, 0.5, 0.2, 2.0])
FUNCTIONS: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
    "arithmetic": (lambda a, b: jnp.stack((a + b, a - b, a * b, a / b)), PAIR),
    "nothing times": (lambda a: 0.0 * a, (VALUES,)),
    "extremes": (lambda a, b: jnp.stack((jnp.maximum(a, b), jnp.minimum(a, b))), PAIR),
    "comparisons": (
        lambda a, b: jnp.stack((a < b, a <= b, a == b, a != b, a >= b, a > b)) * 1.0,
        PAIR,
    ),
    "functions": (
        lambda a: jnp.stack((jnp.exp(-a), erf(a), erfc(a), jnp.expm1(-a), jnp.sin(a), jnp.abs(a))),
        (FINITE,),
    ),
    "roots": (lambda a: jnp.stack((jnp.sqrt(a), jnp.log(a), a**0.3, jnp.log1p(a))), (VALUES[5:9],)),
    "powers": (lambda a: jnp.stack((a**3, a**-2, a**0, -a)), (VALUES,)),
    "parts": (lambda a: jnp.stack(jnp.frexp(a)), ([3.0, -0.1, 1e300, 1.0],)),
    "rounding": (lambda a: jnp.stack((jnp.floor(a), jnp.ceil(a), a % 2.0)), (FINITE,)),
    "order": (lambda a: jnp.concatenate((jnp.argsort(a), jnp.sort(a))), ([3.0, 1.0, 2.0, 1.0],)),
    "two keys": (lambda a, b: jnp.lexsort((a, b)), ([3.0, 1.0, 2.0, 1.0], [1.0, 1.0, 0.0, 1.0])),
    "places": (lambda a: jnp.stack((jnp.argmax(a), jnp.argmin(a))), ([1.0, 5.0, -2.0, 5.0],)),
    "place of NaN": (lambda a: jnp.argmax(a), ([1.0, np.nan, 9.0, np.nan],)),
    "sums": (lambda a: jnp.concatenate((a.cumsum(), a.sum()[None])), (FINITE,)),
    "truth": (lambda a: jnp.stack(((a > 0).any(), (a > 0).all(), ~(a > 0).any())), (FINITE,)),
    "few": (lambda a, i: a[i.astype(int)], (VALUES[1:6], [3.0, 0.0, 4.0])),
    "many": (lambda a, i: (a + 0.0)[i.astype(int)], (np.arange(20.0), [19.0, 0.0, 7.0])),
    "a table": (lambda i: jnp.asarray(np.arange(30.0) ** 2)[i.astype(int)], ([29.0, 3.0],)),
    "outside": (
        lambda a, i: jnp.stack(
            [
                jnp.asarray(a).at[i.astype(int)].get(mode=mode, fill_value=7.0)
                for mode in ("fill", "clip")
            ]
        ),
        (VALUES[1:6], [-9.0, 7.0, 4.0, 5.0, -5.0]),
    ),
    "signs": (
        lambda a, b: jnp.stack((a.astype(int) < b.astype(int), a.astype(int) >= b.astype(int))),
        ([-3.0, 2.0, -1.0], [2.0, -3.0, -1.0]),
    ),
    "rows": (lambda a, i: a.reshape(4, 3)[i.astype(int), 1:], (np.arange(12.0), [3.0, 1.0])),
    "pairs": (
        lambda a, i: jnp.take_along_axis(a.reshape(4, 3), i.astype(int)[:, None], 1),
        (np.arange(12.0), [2.0, 0.0, 1.0, 2.0]),
    ),
    "moves": (lambda a: jnp.pad(a.reshape(3, 4).T[::-1, 1:], ((1, 0), (0, 2))), (np.arange(12.0),)),
    "cholesky": (lambda a: jnp.linalg.cholesky(a.reshape(3, 3)), (MATRIX,)),
    "a solution": (
        lambda a, b: jax.scipy.linalg.solve_triangular(
            jnp.tril(a.reshape(3, 3)), b.reshape(3, 2), lower=True
        ),
        (MATRIX, np.arange(6.0)),
    ),
    "a branch": (doubled_or_summed, ([1.0, 2.0],)),
    "another branch": (doubled_or_summed, ([-1.0, 2.0],)),
    "a loop": (newton, ([2.0, 9.0],)),
    "loops of several lengths": (halvings, ([2.0, 9.0, 700.0],)),
    "a recursion": (lambda a: lax.scan(lambda c, x: (c * 0.5 + x, c), 0.0, a)[1], (FINITE,)),
    "choices": (lambda a: jnp.select([a > 1.0, a < 0.0], [a, -a], 7.0), (VALUES,)),
    "types": (lambda a: a.astype(np.float32) + a.astype(int).astype(np.float32), (FINITE,)),
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_program_is_that_of_jax(name: str) -> None:
    function, columns = FUNCTIONS[name]
    with np.errstate(all="ignore"):
        expected = np.asarray(function(*map(np.asarray, columns)), np.float64)
    np.testing.assert_allclose(run(function, *columns), expected.ravel(), rtol=2e-15, atol=1e-300)


def test_a_branch_that_is_not_taken_is_not_executed() -> None:
    """It would not end."""

    def endless(x: Any) -> Any:
        return lax.while_loop(lambda y: (y == y).any(), lambda y: y + 1.0, x)

    result = run(lambda a: lax.cond(a[0] > 0.0, lambda x: x * 2.0, endless, a), [1.0, 2.0])
    np.testing.assert_array_equal(result, [2.0, 4.0])


def test_an_unknown_primitive_is_named() -> None:
    with pytest.raises(LoweringError, match="'igamma'"):
        run(lambda a: jax.scipy.special.gammainc(a, a), [1.0])
    with pytest.raises(LoweringError, match="more than 10 instructions"):
        run(jnp.cumsum, np.arange(12.0), most=10)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty cache, without what this process has loaded."""
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    monkeypatch.setattr(compiled, "_LOADED", WeakValueDictionary())
    compiled._folder.cache_clear()
    yield tmp_path / ".cache/fusion-gym/compiled"
    compiled._folder.cache_clear()


def rewards(task: Task) -> np.ndarray:
    batch = EpisodeBatch.seeded(task, 2, 0)
    return np.array([batch.step(np.array([[True, False], [True, True]])).reward for _ in range(5)])


def test_damaged_code_is_compiled_again(cache: Path) -> None:
    task = fusion_gym.make_task(LINEAR, backend="compiled")
    expected = rewards(task)
    files = sorted(cache.iterdir())
    assert len(files) == 4  # the code of a start and of a step, and their tasks
    for file in files:
        file.write_bytes(file.read_bytes()[:-9])
    compiled._LOADED.clear()
    np.testing.assert_array_equal(rewards(task), expected)
    assert sorted(cache.iterdir()) == files


def test_a_cache_that_cannot_be_written_is_left_alone(cache: Path) -> None:
    cache.parent.mkdir(parents=True)
    cache.write_text("a file")
    with pytest.warns(UserWarning, match="each start compiles"):
        assert rewards(fusion_gym.make_task(LINEAR, backend="compiled")).all()


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner")
def test_code_that_others_may_write_is_not_run(cache: Path) -> None:
    task = fusion_gym.make_task(LINEAR, backend="compiled")
    expected, files = rewards(task), sorted(cache.iterdir())
    for file in files:
        file.write_bytes(hashlib.sha256(b"planted").digest() + b"planted")
        file.chmod(0o666)
    compiled._LOADED.clear()
    np.testing.assert_array_equal(rewards(task), expected)
    assert {file.stat().st_mode & 0o777 for file in files} == {0o600}
    cache.chmod(0o777)
    compiled._LOADED.clear()
    compiled._folder.cache_clear()
    with pytest.warns(UserWarning, match="is not the user's alone"):
        np.testing.assert_array_equal(rewards(task), expected)


def test_code_needs_no_home(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", home)
    with pytest.warns(UserWarning, match="home directory"):
        assert rewards(fusion_gym.make_task(LINEAR, backend="compiled")).all()


def test_code_that_is_not_used_for_thirty_days_is_removed(cache: Path) -> None:
    rewards(fusion_gym.make_task(LINEAR, backend="compiled"))
    old, *others = sorted(cache.iterdir())
    for file, days in ((old, 31), (others[0], 29)):
        os.utime(file, (time.time() - days * 86_400,) * 2)
    compiled._folder.cache_clear()
    compiled._folder()
    assert sorted(cache.iterdir()) == others


@pytest.mark.slow
def test_processes_compile_one_step_at_once(tmp_path: Path) -> None:
    lines = (
        "import fusion_gym, numpy as np",
        "from fusion_gym.core.batch import EpisodeBatch",
        f"task = fusion_gym.make_task('{LINEAR}', backend='compiled')",
        "print(EpisodeBatch.seeded(task, 2, 0).step(np.ones((2, 2), bool)).reward)",
    )
    command = [sys.executable, "-W", "error", "-c", "; ".join(lines)]
    home = os.environ | {"HOME": str(tmp_path), "PYTHONPATH": os.getcwd()}
    every = [subprocess.Popen(command, env=home, stdout=subprocess.PIPE) for _ in range(3)]
    outputs = {process.communicate()[0] for process in every}
    assert [process.returncode for process in every] == [0, 0, 0]
    assert len(outputs) == 1
    assert len([*(tmp_path / ".cache/fusion-gym/compiled").iterdir()]) == 4


def test_threads_make_and_step_one_environment(cache: Path) -> None:
    task = fusion_gym.make_task(LINEAR, backend="compiled")
    expected = rewards(task)
    with ThreadPoolExecutor(3) as pool:
        for _ in range(50):
            compiled._LOADED.clear()
            for result in pool.map(rewards, [task] * 3):
                np.testing.assert_array_equal(result, expected)


@pytest.mark.slow
def test_a_warm_start_needs_no_jax() -> None:
    lines = (
        "import sys, gymnasium, fusion_gym",
        f"env = gymnasium.make('{LINEAR}', backend='compiled')",
        "env.reset(seed=0), env.step([1, 0])",
        "print('jax' in sys.modules)",
    )
    command = [sys.executable, "-W", "error", "-c", "; ".join(lines)]
    subprocess.run(command, check=True, capture_output=True)
    warm = subprocess.run(command, check=True, capture_output=True, text=True)
    assert warm.stdout.strip() == "False"


def test_other_numbers_have_other_code(cache: Path) -> None:
    every = [
        rewards(fusion_gym.make_task(LINEAR, backend="compiled", measurement_covariances=v))
        for v in (1.0, 2.0, 1.0)
    ]
    assert (every[0] != every[1]).any()
    np.testing.assert_array_equal(every[0], every[2])
    assert len([*cache.iterdir()]) == 8


@pytest.mark.parametrize(
    ("env_id", "options", "reason"),
    [
        ("LinearFusion-v2", {"true_transition": 0.9}, "true_transition = 0.9 is not allowed"),
        ("LinearFusion-v2", {"delay": 1}, "delay = 1 is not allowed under JAX"),
        ("LinearFusion-v2", {"filter": "hold"}, "filter = 'hold' is not allowed under JAX"),
    ],
)
def test_numpy_runs_what_is_not_lowered(env_id: str, options: dict[str, Any], reason: str) -> None:
    with pytest.warns(UserWarning, match=f"^backend='compiled' runs under NumPy here: {reason}"):
        env = gymnasium.make(f"fusion_gym/{env_id}", backend="compiled", **options)
    plain = gymnasium.make(f"fusion_gym/{env_id}", **options)
    for one in (env, plain):
        one.reset(seed=0)
        one.action_space.seed(0)
    action = env.action_space.sample()
    assert env.step(action)[1] == plain.step(action)[1]


@pytest.mark.parametrize(
    "options", [{}, {"memory": True, "cost_weight": "random", "price_range": (0.1, 1.0)}], ids=str
)
def test_resets_of_some_runs_and_restored_runs_are_those_of_numpy(options: dict[str, Any]) -> None:
    batches = [
        EpisodeBatch.seeded(fusion_gym.make_task(LINEAR, backend=backend, **options), 4, 0, "own")
        for backend in ("numpy", "compiled")
    ]
    rng, stored = np.random.default_rng(0), [{}, {}]
    for step in range(12):
        requests = rng.random((2, 4)) < 0.5
        first, second = (batch.step(requests) for batch in batches)
        np.testing.assert_allclose(second.reward, first.reward, rtol=1e-12)
        for place, batch in enumerate(batches):
            if step % 3 == 1:
                batch.reset(np.array([step % 4, 2]))
            if step == 4:
                stored[place] = batch.snapshot()
                batch.reset(np.array([1]))
                batch.restore(stored[place])
            if step == 8:
                batch.restore(stored[place])
        np.testing.assert_allclose(batches[1].observe(), batches[0].observe(), rtol=1e-6)
        batches[1].observe()[:] = np.nan  # the caller's own
        state = [batch.delivered.estimate.mean for batch in batches]
        np.testing.assert_allclose(*state, rtol=1e-12)
        np.testing.assert_allclose(*(batch.beliefs().value for batch in batches), atol=1e-12)


@pytest.mark.parametrize("shape", [(2,), (1, 4), (2, 1), (2, 3), (3, 4)])
def test_requests_have_a_row_for_each_sensor_and_a_column_for_each_run(shape: Any) -> None:
    batch = EpisodeBatch.seeded(fusion_gym.make_task(LINEAR, backend="compiled"), 4, 0)
    if 1 in shape:
        assert batch.step(np.ones(shape, np.bool_)).requested.all()
    else:
        with pytest.raises(ValueError, match="broadcast"):
            batch.step(np.ones(shape, np.bool_))


RULES = (
    *("innovation_threshold:threshold=1,at_most=1", "stochastic_event", "periodic:period=3"),
    *("value_of_information:threshold=.05", "estimate_difference:threshold=.5,at_most=1"),
    *("kullback_leibler:threshold=.5", "priced_threshold:margin=1.2,mixture=.3,age_exponent=.2"),
    *("value_of_information:own=true,threshold=.05", "priced_threshold:own=true"),
)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("LinearFusion-v2", {}),
        ("RemoteEstimation-v1", {"memory": True, "sensors": 2, "channel": "independent"}),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                ("TobitOscillator-v1", {"memory": True, "filter": "tobit", "token_rate": 2.0}),
                ("TobitOscillator-v1", {"memory": True, "broadcast": "estimate", "horizon": 40}),
                ("BiasedOscillator-v2", {"memory": True, "access": "any"}),
                ("CorrelatedTracking-v1", {"memory": True, "horizon": 30}),
            )
        ),
    ],
)
def test_figures_of_policies_are_those_of_numpy(name: str, options: dict[str, Any]) -> None:
    tasks = [
        fusion_gym.make_task(f"fusion_gym/{name}", backend=backend, **options)
        for backend in ("numpy", "compiled")
    ]
    own = tasks[0].network.rule.by_channel or name.startswith(("Linear", "Correlated"))
    rules = RULES[: -2 if own else None]
    every = [
        run_several(task, [fusion_gym.make_policy(rule, task) for rule in rules], 20, 0)
        for task in tasks
    ]
    prices = np.geomspace(0.01, 1.0, 20)
    for results, task in zip(every, tasks, strict=True):
        policy = fusion_gym.make_policy("priced_threshold", task)
        results.append(run_priced(task, policy, np.arange(20), prices))
    assert sum(0.05 < result.rate.mean() < 0.95 for result in every[0]) > 4
    for numpy, ours in zip(*every, strict=True):
        for field in dataclasses.fields(numpy):
            pair = [getattr(part, field.name) for part in (ours, numpy)]
            if pair[0] is not None:
                np.testing.assert_allclose(*pair, rtol=1e-9, atol=1e-12, err_msg=field.name)


def test_code_that_no_task_uses_is_freed(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "_RECENT", deque(maxlen=2))
    for value in (1.0, 2.0, 3.0):
        rewards(fusion_gym.make_task(LINEAR, backend="compiled", measurement_covariances=value))
    gc.collect()
    assert len(compiled._LOADED) == 2  # the start and the step of the last one


def test_observations_show_a_price_that_was_set() -> None:
    task = fusion_gym.make_task(
        "fusion_gym/LinearFusion-v2", price_range=(0.1, 1.0), backend="compiled"
    )
    batch = EpisodeBatch.seeded(task, 4, seed=0)
    batch.observe()
    for price in (0.1, 1.0):
        batch.price = np.full(4, price)
        place = batch.layout.names.index("price")
        assert batch.observe()[:, place].tolist() == pytest.approx([np.log10(10 * price)] * 4)
