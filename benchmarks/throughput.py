"""Environment steps per second, everything included, beside the alternatives.

    python -m benchmarks.throughput [--seconds 3]

One thread (``make bench`` sets it), float64. All rows are measured in one run, in turns, and each
figure is the median of its turns; the ratios are to a plain loop with FilterPy and to SB3's
DummyVecEnv. The absolute figures belong to the machine, the ratios to the code.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import filterpy.kalman
import gymnasium
import numpy as np
from rich.console import Console
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

import fusion_gym
from fusion_gym.output import tables
from fusion_gym.systems.tobit.oscillator import TobitOscillatorOptions

ENV = "fusion_gym/TobitOscillator-v1"
TURNS = 5
# A workload takes seconds and returns environment steps per second.
Workload = Callable[[float], float]


def _timed(step: Callable[[], object], steps_per_call: int) -> Workload:
    def run(seconds: float) -> float:
        calls, began = 0, time.perf_counter()
        while True:
            for _ in range(8):
                step()
            calls += 8
            elapsed = time.perf_counter() - began
            if elapsed >= seconds:
                return calls * steps_per_call / elapsed

    return run


def single(options: dict[str, Any]) -> Workload:
    """``gym.make``, with the reset at the end of each episode."""
    env = gymnasium.make(ENV, **options)
    env.reset(seed=0)
    actions = [np.array(bits, dtype=np.int8) for bits in ((1, 0, 1), (0, 1, 0), (0, 0, 0))]
    count = iter(range(10**12))

    def step() -> None:
        truncated = env.step(actions[next(count) % 3])[3]
        if truncated:
            env.reset()

    return _timed(step, 1)


def vector(options: dict[str, Any], num_envs: int, env_id: str = ENV) -> Workload:
    """``gym.make_vec`` with autoreset."""
    env = gymnasium.make_vec(env_id, num_envs, vectorization_mode="vector_entry_point", **options)
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(16)]
    count = iter(range(10**12))
    return _timed(lambda: env.step(actions[next(count) % 16]), num_envs)


def native_sb3(options: dict[str, Any], num_envs: int) -> Workload:
    """The native SB3 environment, its first episodes staggered as in training."""
    return _sb3(fusion_gym.make_sb3_vec_env(ENV, num_envs, seed=0, stagger=True, **options))


def dummy_sb3(options: dict[str, Any], num_envs: int) -> Workload:
    """SB3's DummyVecEnv over single environments."""
    env = DummyVecEnv([lambda: gymnasium.make(ENV, **options)] * num_envs)
    env.seed(0)
    return _sb3(env)


def _sb3(env: VecEnv) -> Workload:
    env.reset()
    actions = np.random.default_rng(0).integers(0, 2, (16, env.num_envs, 3), dtype=np.int8)
    count = iter(range(10**12))
    return _timed(lambda: env.step(actions[next(count) % 16]), env.num_envs)


# Other environments by gym.make_vec.
OTHERS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("CorrelatedTracking", {}),
    ("CorrelatedTracking", {"fusion": "ci"}),
    ("MarkovJumpTracking", {}),
    ("UnknownInput", {}),
    ("UnknownInput", {"filter": "predict"}),
    ("UnknownInput", {"filter": "paper"}),
    ("BiasedOscillator", {}),
    ("BiasedOscillator", {"filter": "adf"}),
    ("BiasedTracking", {}),
)


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

    return _timed(step, 1)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description="Environment steps per second, as ratios.")
    parser.add_argument("--seconds", type=float, default=0.6, help="of each row and turn")
    seconds = parser.parse_args().seconds
    paper: dict[str, Any] = {}
    tobit: dict[str, Any] = {"filter": "tobit"}
    rows: dict[str, Workload] = {
        "plain loop with FilterPy's Kalman filter": filterpy_loop(),
        "gym.make, paper's filter": single(paper),
        "gym.make, Tobit filter": single(tobit),
        "SB3 DummyVecEnv, 64 × gym.make, paper's filter": dummy_sb3(paper, 64),
        "native SB3 VecEnv, 1,024, paper's filter": native_sb3(paper, 1024),
        "native SB3 VecEnv, 1,024, Tobit filter": native_sb3(tobit, 1024),
        "gym.make_vec, 1,024, paper's filter": vector(paper, 1024),
        "gym.make_vec, 1,024, Tobit filter": vector(tobit, 1024),
    }
    for name, options in OTHERS:
        label = ", ".join((name, "1,024", *map(str, options.values())))
        rows[label] = vector(options, 1024, f"fusion_gym/{name}-v1")
    figures = measured(rows, seconds)
    medians = {name: statistics.median(figure) for name, figure in figures.items()}
    first, _, _, other, *_ = medians.values()
    title = f"steps per second, one thread, median of {TURNS} turns ({ENV} where not named)"
    heads = ("what", "steps/s", "least", "most", "to the FilterPy loop", "to DummyVecEnv")
    cells = []
    for name, median in medians.items():
        speeds = (f"{speed:,.0f}" for speed in (median, min(figures[name]), max(figures[name])))
        cells.append((name, *speeds, f"{median / first:.2f}", f"{median / other:.2f}"))
    Console(width=130).print(tables.table_tables(title, heads, cells))


def measured(rows: dict[str, Workload], seconds: float) -> dict[str, list[float]]:
    """Steps per second of every row in every turn, after a short first try."""
    figures: dict[str, list[float]] = {name: [] for name in rows}
    for workload in rows.values():
        workload(seconds / 4)
    for _ in range(TURNS):
        for name, workload in rows.items():
            figures[name].append(workload(seconds))
    return figures


if __name__ == "__main__":
    main()
