"""What a step costs against the number of sensors and of states, and how it grows.

    python -m benchmarks.many_sensors_step [--output results/many_sensors] [--seconds 0.1]

Processor time of one step of one run, 16 runs side by side on one thread: the environment's step,
the observation, and what three rules take to decide. On LinearFusion-v0, whose plant and sensors
are drawn at random, sensors and states are apart; on RemoteEstimation-v0 every sensor has a state
of its own. Writes ``step.json`` and a figure beside it.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from fusion_gym.agents.output import tables
from fusion_gym.agents.output.figures import save_figure
from fusion_gym.agents.output.palette import BLUE, GREEN, INK, ORANGE, VERMILLION
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.policies.base import owner_of
from fusion_gym.policies.registry import make_policy

LINEAR, REMOTE = "LinearFusion-v0", "RemoteEstimation-v0"
SENSORS, STATES = (3, 6, 12, 25, 50, 100, 200), (2, 5, 10, 20)
RUNS, HORIZON, TURNS = 16, 1000, 3
LARGE = {"sensors": 25, "states": 5}  # from which on growth is fitted: below, a step has a floor
MIDDLE = {"sensors": 50, "states": 10}  # what the figure holds fixed
plt.rcParams["text.parse_math"] = True  # of the numbers on logarithmic axes
# What is timed, and how it is drawn. A part is the environment's own, or a policy's decision.
RULES = {
    "information gain": "information_gain:threshold=0.01",
    "value of information, scheduler": "value_of_information:price=0.01",
    "value of information, own": "value_of_information:price=0.01,own=true",
}
STYLES = {
    "step": (INK, "o", "-"),
    "observation": (GREEN, "v", ":"),
    "information gain": (ORANGE, "s", "--"),
    "value of information, scheduler": (BLUE, "^", "-"),
    "value of information, own": (VERMILLION, "D", "-."),
}
PARTS = tuple(STYLES)


def linear(sensors: int, states: int) -> Task:
    """A stable plant and sensors of one channel each, both drawn, a tenth of them paid for."""
    rng = np.random.default_rng(sensors * 1000 + states)
    transition = rng.normal(size=(states, states))
    transition *= 0.95 / np.abs(np.linalg.eigvals(transition)).max()
    return make_task(
        f"fusion_gym/{LINEAR}",
        transition=transition.tolist(),
        process_covariance=(0.1 * np.eye(states)).tolist(),
        measurement_matrices=rng.normal(size=(sensors, states)).tolist(),
        horizon=HORIZON,
        **tokens(sensors),
    )


def remote(sensors: int) -> Task:
    """Sources of one kind on one bucket."""
    return make_task(f"fusion_gym/{REMOTE}", sensors=sensors, horizon=HORIZON, **tokens(sensors))


def tokens(sensors: int) -> dict[str, Any]:
    """A bucket that pays for a tenth of the sensors in each step."""
    capacity = float(max(sensors, 3))
    return {
        "tokens": "limited", "token_cost": 1.0, "token_rate": sensors / 10,
        "token_capacity": capacity, "initial_tokens": 1.0,
    }  # fmt: skip


def cost(task: Task, part: str, seconds: float) -> float:
    """Microseconds of CPU of a part, over steps that take so many seconds together, two at least.

    What is random is so for all parts alike: every sensor asks, and a tenth of them is granted.
    """
    policy = make_policy(RULES[part], task) if part in RULES else None
    batch = EpisodeBatch.seeded(task, RUNS, 0, owner_of(policy) if policy else None)
    if policy is not None:
        policy.reset(RUNS)
    everyone = np.ones((task.sensors, RUNS), dtype=np.bool_)
    decide: Callable[[], object]
    decide = batch.observe if policy is None else lambda: policy(batch.signals())
    for _ in range(3):  # past the start, at which nothing is old
        batch.step(everyone)
    spent, steps = 0.0, 0
    while (spent < seconds or steps < 2) and steps < HORIZON - 10:
        began = time.process_time()
        if part == "step":
            batch.step(everyone)
        else:
            decide()
        spent += time.process_time() - began
        steps += 1
        if policy is not None:  # what is believed of a step is computed once
            batch.step(everyone)
    return 1e6 * spent / (steps * RUNS)


def measured(sensors: Sequence[int], states: Sequence[int], seconds: float) -> pd.DataFrame:
    """Microseconds of every part at every size, each the least of several turns through all."""
    turns = [row for _ in range(TURNS) for row in _turn(sensors, states, seconds)]
    columns = ["env", "sensors", "states", "part", "microseconds"]
    return (
        pd.DataFrame(turns, columns=columns).groupby(columns[:-1], sort=False).min().reset_index()
    )


def _turn(
    sensors: Sequence[int], states: Sequence[int], seconds: float
) -> Iterator[tuple[str, int, int, str, float]]:
    for count in sensors:
        for env, size in [*((LINEAR, size) for size in states), (REMOTE, count)]:
            task = remote(count) if env == REMOTE else linear(count, size)
            for part in PARTS:
                yield env, count, size, part, cost(task, part, seconds)


def exponents(costs: pd.DataFrame) -> dict[str, dict[str, dict[str, float]]]:
    """By environment and part: p and q of c ∝ sensors^p states^q, by least squares of logarithms.

    Over sizes from :data:`LARGE` on, and of one state a sensor p alone.
    """
    result: dict[str, dict[str, dict[str, float]]] = {}
    large = costs[(costs.sensors >= LARGE["sensors"]) & (costs.states >= LARGE["states"])]
    for (env, part), group in large.groupby(["env", "part"], sort=False):
        names = ["sensors", "states"] if env == LINEAR else ["sensors"]
        rows = np.column_stack([np.log(group[names]), np.ones(len(group))])
        slopes = np.linalg.lstsq(rows, np.log(group.microseconds))[0]
        values = dict(zip(names, map(float, slopes), strict=False))
        result.setdefault(str(env), {})[str(part)] = values
    return result


def table(costs: pd.DataFrame, fitted: dict[str, dict[str, dict[str, float]]]) -> Table:
    """A row a size, and below the exponents."""
    heads = ("environment", "sensors", "states", *PARTS)
    sizes = costs.assign(order=costs.states.where(costs.env == LINEAR, 0)).pivot(
        index=["env", "order", "sensors", "states"], columns="part", values="microseconds"
    )
    rows = [
        [env, str(count), str(size), *(f"{value:.3g}" for value in values)]
        for (env, _, count, size), *values in sizes[list(PARTS)].sort_index().itertuples()
    ]
    for env, parts in fitted.items():
        for name in parts[PARTS[0]]:
            cells = (f"{parts[part][name]:.2f}" for part in PARTS)
            rows.append([env, f"exponent, {name}", "", *cells])
    return tables.table_tables("CPU microseconds of a step of one run", heads, rows)


def figure(costs: pd.DataFrame, *paths: Path) -> None:
    """Cost against sensors and against states of the one, against sensors of the other."""
    size, count = MIDDLE["states"], MIDDLE["sensors"]
    env = costs.env
    panels = (
        (f"{LINEAR}, {size} states", "sensors", (env == LINEAR) & (costs.states == size)),
        (f"{LINEAR}, {count} sensors", "states", (env == LINEAR) & (costs.sensors == count)),
        (f"{REMOTE}, a state a sensor", "sensors", env == REMOTE),
    )
    drawn, axes = plt.subplots(1, 3, figsize=(11.5, 4.0), sharey=True, constrained_layout=True)
    for panel, (title, along, selection) in zip(axes, panels, strict=True):
        for part, (colour, marker, line) in STYLES.items():
            points = costs[selection & (costs.part == part)].sort_values(along)
            panel.loglog(
                points[along], points.microseconds, line, marker=marker, ms=4.5, lw=1.2,
                color=colour, label=part,
            )  # fmt: skip
        panel.set_title(title, loc="left", fontsize=9)
        panel.set_xlabel(along)
        ticks = SENSORS if along == "sensors" else STATES
        panel.set_xticks(ticks, [str(tick) for tick in ticks])
        panel.minorticks_off()
    axes[0].set_ylabel("CPU µs of a step of one run")
    axes[0].legend(fontsize=7.5)
    save_figure(drawn, *paths)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--sensors", type=int, nargs="+", default=SENSORS)
    parser.add_argument("--states", type=int, nargs="+", default=STATES)
    parser.add_argument("--seconds", type=float, default=0.1, help="of each figure and turn")
    parser.add_argument("--output", type=Path, help="folder for the figures and the table")
    arguments = parser.parse_args()
    costs = measured(arguments.sensors, arguments.states, arguments.seconds)
    fitted = exponents(costs)
    Console(width=150).print(table(costs, fitted))
    if arguments.output is not None:
        arguments.output.mkdir(parents=True, exist_ok=True)
        report = {
            "runs": RUNS,
            "turns": TURNS,
            "seconds": arguments.seconds,
            "costs": costs.to_dict("records"),
            "fitted_from": LARGE,
            "exponents": fitted,
        }
        (arguments.output / "step.json").write_text(json.dumps(report, indent=1) + "\n")
        figure(costs, arguments.output / "step.png", arguments.output / "step.svg")


if __name__ == "__main__":
    main()
