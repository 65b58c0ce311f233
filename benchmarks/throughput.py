"""Environment steps per second on one processor, everything included, beside the alternatives.

    python -m benchmarks.throughput [--seconds 0.1] [--gpu] [--page]

All cells are measured in one run, in turns, and each is the median of its turns. The last column is
the ratio to ``oscillator.c``, where a C compiler is at hand. ``--gpu`` measures the pure functions
on a GPU instead. ``--page`` writes the table into docs/speed.md.
"""

import itertools
import os
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import filterpy.kalman
import gymnasium
import jax
import numpy as np
import tyro
from rich.console import Console
from rich.markdown import Markdown
from rich.progress import track
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

import fusion_gym
import fusion_gym.jax
from fusion_gym.docstrings import table
from fusion_gym.entries import Options
from fusion_gym.systems.tobit.oscillator import TobitOscillatorOptions

PAGE = Path(__file__).parent.parent / "docs" / "speed.md"
LOOP = Path(__file__).with_name("oscillator.c")
TURNS, RUNS, GPU_RUNS = 9, (1, 64, 1024), (1024, 65_536, 524_288)
RULE = "innovation_threshold:threshold=1.1"
OPTIONS: tuple[tuple[str, Options], ...] = (
    ("TobitOscillator-v1", {}),
    ("TobitOscillator-v1", {"filter": "tobit"}),
    ("BiasedOscillator-v2", {"access": "any"}),
    ("LinearFusion-v2", {}),
    ("RemoteEstimation-v1", {}),
)
OTHERS: tuple[tuple[str, Options], ...] = (
    ("CorrelatedTracking-v1", {}),
    ("CorrelatedTracking-v1", {"fusion": "ci"}),
    ("MarkovJumpTracking-v1", {}),
    ("UnknownInput-v1", {}),
    ("UnknownInput-v1", {"filter": "predict"}),
    ("UnknownInput-v1", {"filter": "paper"}),
    ("BiasedOscillator-v2", {"filter": "adf"}),
)
GPU: tuple[tuple[str, Options], ...] = (
    *OPTIONS,
    *((name, {}) for name in ("CorrelatedTracking-v1", "MarkovJumpTracking-v1", "UnknownInput-v1")),
)
# A workload takes seconds and returns environment steps per second.
Workload = Callable[[float], float]


def timed(
    step: Callable[[], object], steps_per_call: int, clock: Callable[[], float] = time.process_time
) -> Workload:
    """Return the workload of a function that makes some steps."""

    def run(seconds: float) -> float:
        calls, began = 0, clock()
        while (elapsed := clock() - began) < seconds:
            step()
            calls += 1
        return calls * steps_per_call / elapsed

    return run


def interface(env_id: str, options: Options, runs: int, backend: str) -> Workload:
    """``gym.make`` for one run, else ``gym.make_vec``, with the reset of ended episodes."""
    options = options | {"backend": backend}
    if runs > 1:
        mode: Any = "vector_entry_point"
        envs = gymnasium.make_vec(env_id, runs, vectorization_mode=mode, **options)
        return _workload(envs, runs, envs.step)
    env = gymnasium.make(env_id, **options)

    def step(action: Any) -> None:
        if env.step(action)[3]:
            env.reset()

    return _workload(env, 1, step)


def _workload(env: Any, runs: int, step: Callable[[Any], object]) -> Workload:
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = itertools.cycle([env.action_space.sample() for _ in range(16)])
    return timed(lambda: step(next(actions)), runs)


def scan(
    env_id: str, options: Options, runs: int, clock: Callable[[], float] = time.process_time
) -> Workload:
    """100 steps of pure functions under ``jax.lax.scan``, with a rule, noise and resets."""
    env, params = fusion_gym.jax.make(env_id, **options)
    rule = fusion_gym.make_policy(RULE, env.task)

    def one(state: Any, key: Any) -> Any:
        action = rule(env.signals(state, params))[:, 0]
        observation, state, reward, *_ = env.step(key, state, action, params)
        return state, (observation.mean(), reward)

    @jax.jit
    def episodes(states: Any, key: Any) -> Any:
        def step(states: Any, key: Any) -> Any:
            states, results = jax.vmap(one)(states, jax.random.split(key, runs))
            return states, [result.mean() for result in results]

        return jax.lax.scan(step, states, jax.random.split(key, 100))

    keys = jax.random.split(jax.random.key(0), runs)
    states = jax.vmap(env.reset, (0, None))(keys, params)[1]
    return timed(lambda: jax.block_until_ready(episodes(states, keys[0])), 100 * runs, clock)


def sb3(env_id: str, options: Options, runs: int, native: bool = True) -> Workload:
    """The native environment of Stable-Baselines3, or its DummyVecEnv over ``gym.make``."""
    if native:
        env: VecEnv = fusion_gym.make_sb3_vec_env(
            env_id, runs, seed=0, stagger=True, backend="compiled", **options
        )
    else:
        env = DummyVecEnv([lambda: gymnasium.make(env_id, **options)] * runs)
        env.seed(0)
    env.reset()
    shape = (16, runs, *(env.action_space.shape or ()))
    actions = itertools.cycle(np.random.default_rng(0).integers(0, 2, shape))
    return timed(lambda: env.step(next(actions)), runs)


def cartpole() -> Workload:
    """Gymnasium's CartPole, for the cost of its interface."""
    env = gymnasium.make("CartPole-v1")
    env.reset(seed=0)
    actions = itertools.cycle([0, 1])

    def step() -> None:
        if env.step(next(actions))[2]:
            env.reset()

    return timed(step, 1)


def filterpy_loop() -> Workload:
    """Plant, three sensors and three FilterPy updates in a loop: no network, no observation.

    The filter takes censored values at face value, which is less work than the Tobit filter.
    """
    numbers = TobitOscillatorOptions()
    transition, gain = np.array(numbers.transition), np.array(numbers.process_gain)
    generator = np.random.default_rng(0)
    node = filterpy.kalman.KalmanFilter(dim_x=2, dim_z=2)
    node.F, node.H, node.R = transition, np.eye(2), 0.5 * np.eye(2)
    node.Q, node.P = 0.05 * np.outer(gain, gain), 0.1 * np.eye(2)
    state = np.array([5.0, 0.0])
    node.x = state.copy()

    def step() -> None:
        nonlocal state
        state = transition @ state + gain * (0.05**0.5 * generator.standard_normal())
        node.predict()
        for _ in range(3):
            noise = 0.5**0.5 * generator.standard_normal(2)
            node.update(np.maximum(state + noise, 0.0))

    return timed(step, 1)


def c_loop(folder: str) -> Workload | None:
    """``oscillator.c``, or ``None`` without a C compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        return None
    program = f"{folder}/oscillator"
    flags = "-O3", "-march=native", "-o", program, str(LOOP), "-lm"
    subprocess.run([compiler, *flags], check=True)

    def run(seconds: float) -> float:
        steps = str(max(1, round(3000 * seconds)))
        printed = subprocess.run([program, "1024", steps], capture_output=True, check=True)
        return float(printed.stdout.split()[0])

    return run


def rows(folder: str) -> Iterator[tuple[str, str, dict[int, Workload]]]:
    """Return name, interface and the workload of each number of runs."""
    if (loop := c_loop(folder)) is not None:
        yield "TobitOscillator-v1", "C loop", {1024: loop}
    yield "TobitOscillator-v1", "FilterPy loop", {1: filterpy_loop()}
    yield "CartPole-v1 of Gymnasium", "`gym.make`", {1: cartpole()}
    dummy = sb3("fusion_gym/TobitOscillator-v1", {}, 64, native=False)
    yield "TobitOscillator-v1", "SB3 `DummyVecEnv`", {64: dummy}
    device = jax.devices()[0].platform
    for name, options in OPTIONS:
        env_id, label = f"fusion_gym/{name}", _label(name, options)
        kinds: dict[str, Callable[[str, Options, int], Workload]] = {
            "NumPy": partial(interface, backend="numpy"),
            "compiled": partial(interface, backend="compiled"),
            f"JAX ({device}), scan": scan,
            "SB3 `VecEnv`, compiled": sb3,
        }
        for kind, build in kinds.items():
            yield label, kind, {runs: build(env_id, options, runs) for runs in RUNS}
    for name, options in OTHERS:
        env_id, label = f"fusion_gym/{name}", _label(name, options)
        for backend, kind in (("numpy", "NumPy"), ("compiled", "compiled")):
            every = {runs: interface(env_id, options, runs, backend) for runs in (1, 1024)}
            yield label, kind, every


def _label(name: str, options: Options) -> str:
    given = ", ".join(f"`{key}={value!r}`" for key, value in options.items())
    return f"{name}, {given}" if given else name


def measure_cpu(seconds: float) -> str:
    """Return the table of all interfaces on one core."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
    with tempfile.TemporaryDirectory() as folder:
        every = list(rows(folder))
        workloads = [workload for *_, by_runs in every for workload in by_runs.values()]
        for workload in track(workloads, "first calls"):
            workload(1e-3)
        speeds = [
            [workload(seconds) for workload in track(workloads, f"turn {turn + 1}")]
            for turn in range(TURNS)
        ]
    medians, lines, reference = iter(np.median(speeds, axis=0)), [], None
    for label, kind, by_runs in every:
        median = {runs: next(medians) for runs in by_runs}
        reference = median[1024] if kind == "C loop" else reference
        cells = (_rounded(median[r]) if r in median else "" for r in RUNS)
        ratio = f"{median[1024] / reference:.2f}" if reference and 1024 in median else ""
        lines.append((label, kind, *cells, ratio))
    heads = "environment", "interface", "1 run", *map(_runs, RUNS[1:]), "1,024 to C"
    return f"{table(heads, lines)}\n\nMeasured in fusion-gym {fusion_gym.__version__}."


def measure_gpu(seconds: float, sizes: Iterable[int] = GPU_RUNS) -> str:
    """Return the table of the pure functions for each number of runs, on the device of JAX."""
    lines, sizes = [], tuple(sizes)
    for name, options in track(GPU, "environments"):
        cells, slowest = [], 0.0
        for runs in sizes:
            began = time.perf_counter()
            workload = scan(f"fusion_gym/{name}", options, runs, time.perf_counter)
            workload(1e-9)
            slowest = max(slowest, time.perf_counter() - began)
            cells.append(_rounded(np.median([workload(seconds) for _ in range(TURNS)])))
        lines.append((_label(name, options), *cells, f"{slowest:.1f}"))
    heads = "environment", *map(_runs, sizes), "first call (s)"
    device = jax.devices()[0].device_kind
    return f"{table(heads, lines)}\n\n{device}, in fusion-gym {fusion_gym.__version__}."


def _rounded(number: float) -> str:
    return f"{float(f'{number:.3g}'):,.0f}"


def _runs(count: int) -> str:
    return f"{count:,} runs"


def main(seconds: float = 0.1, gpu: bool = False, page: bool = False) -> None:
    """Measure all rows and print the table.

    Args:
        seconds: of each cell and turn.
        gpu: measure the pure functions on a GPU.
        page: write docs/speed.md.
    """
    if gpu and (platform := jax.devices()[0].platform) == "cpu":
        raise SystemExit(f"--gpu is not allowed: JAX has the platform '{platform}', not a GPU")
    text = measure_gpu(seconds) if gpu else measure_cpu(seconds)
    if page:
        name = "gpu" if gpu else "throughput"
        PAGE.write_text(replaced(PAGE.read_text(encoding="utf-8"), name, text), encoding="utf-8")
    Console(width=150).print(Markdown(text))


def replaced(text: str, name: str, content: str) -> str:
    """Return the page with new content between the marks of this name."""
    pattern = re.compile(rf"(<!-- table: {name} -->\n).*?(<!-- end -->)", re.DOTALL)
    return pattern.sub(lambda mark: f"{mark[1]}\n{content}\n\n{mark[2]}", text)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
