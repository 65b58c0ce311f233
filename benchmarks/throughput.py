"""Environment steps per second, everything included, beside the alternatives.

    python -m benchmarks.throughput [--seconds 3]

One thread (``make bench`` sets it), float64. All rows are measured in one run, in turns, and each
figure is the median of its turns; the ratios are to a plain loop with FilterPy and to SB3's
DummyVecEnv, and in a second table what memory costs. The absolute figures belong to the machine,
the ratios to the code.
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
from rich.table import Table
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.memory import Owner
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


# An environment's options in the comparison of what memory costs.
REMEMBERED: dict[str, dict[str, Any]] = {
    "TobitOscillator": {"filter": "tobit"},
    "BiasedOscillator": {"access": "any"},
    "BiasedTracking": {"access": "any"},
    "CorrelatedTracking": {},
    "UnknownInput": {},
    "MarkovJumpTracking": {},
    "MarkovJumpTracking, imm": {"filter": "imm"},
    "RemoteEstimation": {"sensors": 3},
}
RATE = 0.3  # of requests there, a sensor and step


def remembering(env_id: str, options: dict[str, Any], how: str, num_envs: int = 1024) -> Workload:
    """The core's loop without memory, or with ``memory_system``, ``values`` or ``own`` values."""
    changed = {"memory": how != "without", "horizon": 250}
    task = fusion_gym.make_task(env_id, **(options | changed))
    owner: Owner = "own" if how == "own" else "scheduler"
    batch = EpisodeBatch.seeded(task, num_envs, 0, owner)
    draw = np.random.default_rng(0)
    required = draw.random((16, task.sensors, num_envs)) < RATE
    count = iter(range(10**12))

    def step() -> None:
        if how in ("values", "own"):
            batch.beliefs().value()
        if batch.step(required[next(count) % 16]).ended.any():
            batch.reset()

    return _timed(step, num_envs)


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
    adf: dict[str, Any] = {"filter": "adf"}
    rows: dict[str, Workload] = {
        "plain loop with FilterPy's Kalman filter": filterpy_loop(),
        "gym.make, paper's filter": single(paper),
        "gym.make, Tobit filter": single(tobit),
        "SB3 DummyVecEnv, 64 × gym.make, paper's filter": dummy_sb3(paper, 64),
        "native SB3 VecEnv, 1,024, paper's filter": native_sb3(paper, 1024),
        "native SB3 VecEnv, 1,024, Tobit filter": native_sb3(tobit, 1024),
        "gym.make_vec, 1,024, paper's filter": vector(paper, 1024),
        "gym.make_vec, 1,024, Tobit filter": vector(tobit, 1024),
        "CorrelatedTracking, 1,024": vector({}, 1024, "fusion_gym/CorrelatedTracking-v1"),
        "CorrelatedTracking, 1,024, ci": vector(
            {"fusion": "ci"}, 1024, "fusion_gym/CorrelatedTracking-v1"
        ),
        "MarkovJumpTracking, 1,024": vector({}, 1024, "fusion_gym/MarkovJumpTracking-v1"),
        "UnknownInput, 1,024": vector({}, 1024, "fusion_gym/UnknownInput-v1"),
        "UnknownInput, 1,024, exact filter": vector(
            {"filter": "predict"}, 1024, "fusion_gym/UnknownInput-v1"
        ),
        "UnknownInput, 1,024, paper's filter": vector(
            {"filter": "paper"}, 1024, "fusion_gym/UnknownInput-v1"
        ),
        "BiasedOscillator, 1,024": vector({}, 1024, "fusion_gym/BiasedOscillator-v1"),
        "BiasedOscillator, 1,024, adf": vector(adf, 1024, "fusion_gym/BiasedOscillator-v1"),
        "BiasedTracking, 1,024": vector({}, 1024, "fusion_gym/BiasedTracking-v1"),
    }
    figures = measured(rows, seconds)
    medians = {name: statistics.median(figure) for name, figure in figures.items()}
    names = list(rows)
    title = f"steps per second, one thread, median of {TURNS} turns ({ENV} where not named)"
    heads = ("what", "steps/s", "least", "most", "to the FilterPy loop", "to DummyVecEnv")
    table = tables.table_tables(title, heads)
    for name, median in medians.items():
        result = figures[name]
        table.add_row(
            name,
            f"{median:,.0f}",
            f"{min(result):,.0f}",
            f"{max(result):,.0f}",
            f"{median / medians[names[0]]:.2f}",
            f"{median / medians[names[3]]:.2f}",
        )
    Console(width=130).print(table)
    Console(width=130).print(memory_table(seconds))


def measured(rows: dict[str, Workload], seconds: float) -> dict[str, list[float]]:
    """Steps per second of every row in every turn, after a short first try."""
    figures: dict[str, list[float]] = {name: [] for name in rows}
    for workload in rows.values():
        workload(seconds / 4)
    for _ in range(TURNS):
        for name, workload in rows.items():
            figures[name].append(workload(seconds))
    return figures


def memory_table(seconds: float) -> Table:
    """What memory costs: the core's loop with it over without, the median of a turn's ratios."""
    ways = {
        "memory_system": "shadow alone",
        "values": "and values",
        "own": "every sensor's own values",
    }
    title = f"core's loop, 1,024 runs, requests at rate {RATE}: with memory over without"
    table = tables.table_tables(title, ("environment", "steps/s without", *ways.values()))
    for name, options in REMEMBERED.items():
        env_id = f"fusion_gym/{name.partition(',')[0]}-v1"
        rows = {how: remembering(env_id, options, how) for how in ("without", *ways)}
        result = measured(rows, seconds)
        ratios = [
            statistics.median(a / b for a, b in zip(result[how], result["without"], strict=True))
            for how in ways
        ]
        without = statistics.median(result["without"])
        table.add_row(name, f"{without:,.0f}", *(f"{ratio:.2f}" for ratio in ratios))
    return table


if __name__ == "__main__":
    main()
