"""Many sensors of one kind on one bucket: what learning costs, and what it leaves beside the rules.

    python -m benchmarks.many_sensors cost
    fusion-gym train --config configs/many_sensors.yaml
    python -m benchmarks.many_sensors table --model runs/many_sensors/best_model.zip

The first measures a counterfactual training step against the number of sensors. The last plays the
agent of `configs/many_sensors.yaml` and rules, each family tuned on other seeds, on the same
episodes under the same budget, with a floor that no policy undercuts: every source's own optimum
at the price of a token that the budget has (weak duality).
"""

import argparse
import json
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from fusion_gym.agents.compare import run_all
from fusion_gym.agents.output import tables
from fusion_gym.agents.output.progress import progress_bar, quietly
from fusion_gym.agents.training.checked import load_checked, parse
from fusion_gym.agents.training.checkpoint import read_journal
from fusion_gym.agents.training.config import Experiment
from fusion_gym.agents.training.run import train
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.evaluation.intervals import mean_interval
from fusion_gym.policies.registry import make_policy
from fusion_gym.solvers import lagrangian_bound
from fusion_gym.solvers.task import source_problems

SENSORS = (3, 6, 12, 24, 40)
RUNS, STEPS, ROLLOUTS = 64, 8, 3
TUNING_SEED = 600_000_000
# Every family with the values that are tried; {0} is what varies.
FAMILIES: dict[str, Sequence[float]] = {
    "whittle:price={0:.3g}": np.geomspace(0.1, 0.4, 15).tolist(),
    "whittle:price={0:.3g},at_most=4": np.geomspace(0.02, 0.3, 15).tolist(),
    "value_of_information:price={0:.3g}": np.geomspace(0.03, 0.15, 15).tolist(),
    "value_of_information:price={0:.3g},at_most=4": np.geomspace(0.01, 0.1, 15).tolist(),
    "innovation_threshold:threshold={0:.3g}": np.geomspace(1.5, 4.0, 15).tolist(),
    "send_on_delta:threshold={0:.3g}": np.geomspace(1.5, 4.0, 15).tolist(),
    "stochastic_event:weight={0:.3g}": np.geomspace(0.03, 1.0, 15).tolist(),
    "variance_threshold:threshold={0:.4g},at_most=4": np.geomspace(100.0, 400.0, 10).tolist(),
    "periodic:period={0:.0f}": list(range(8, 16)),
    "paced:rate={0:.3g}": np.geomspace(0.05, 0.15, 8).tolist(),
    "random:rate={0:.3g}": np.geomspace(0.05, 0.2, 8).tolist(),
    "always": [0.0],
}


# --- what a step costs ----------------------------------------------------------------------------


class Cost(NamedTuple):
    """Microseconds of one step of one run of a training, on one thread, by what they go to."""

    environment: float
    policy: float
    update: float


def cost(sensors: int, local: bool) -> Cost:
    """Of a counterfactual training with one flip a sensor: of a scheduler, or of local rows."""
    rows = RUNS * (sensors if local else 1)
    content = {
        "environment": {
            "id": "fusion_gym/RemoteEstimation-v0",
            "local": local,
            "options": {"sensors": sensors, "tokens": "limited", "token_rate": sensors / 10},
        },
        "algorithm": {
            "name": "counterfactual_ppo", "alternatives": "flips", "n_steps": STEPS,
            "initial_rate": 0.1,
        },
        "training": {"timesteps": ROLLOUTS * STEPS * rows, "num_envs": RUNS},
        "validation": {"episodes": 1},
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        train(parse(Experiment, content | {"output": folder}, "many_sensors"), quiet=True)
        seconds = read_journal(Path(folder) / "latest.zip").seconds
    scale = 1e6 / (ROLLOUTS * STEPS * RUNS)
    return Cost(*(seconds[part] * scale for part in Cost._fields))


def exponent(sensors: Sequence[int], costs: Sequence[float]) -> float:
    """The slope of the costs' logarithm over that of the number of sensors."""
    return float(np.polyfit(np.log(sensors), np.log(costs), 1)[0])


def cost_table(sensors: Sequence[int]) -> tuple[Table, dict[str, Any]]:
    """A row a number of sensors and kind of agent, and the exponents below."""
    heads = ("agent", "sensors", *Cost._fields, "sum")
    table = tables.table_tables("microseconds of a training step of one run", heads)
    report: dict[str, Any] = {"sensors": list(sensors)}
    for local in (False, True):
        name = "local rows" if local else "scheduler, flips"
        result = [cost(count, local) for count in sensors]
        for count, part in zip(sensors, result, strict=True):
            table.add_row(name, str(count), *(f"{value:.0f}" for value in (*part, sum(part))))
        sums = [sum(part) for part in result]
        slopes = [exponent(sensors, column) for column in (*zip(*result, strict=True), sums)]
        last = [exponent(sensors[-2:], sums[-2:])]
        table.add_row(name, "exponent", *(f"{slope:.2f}" for slope in slopes), end_section=True)
        report[name] = {
            "costs": [part._asdict() for part in result],
            "exponents": dict(zip((*Cost._fields, "sum"), slopes, strict=True)),
            "exponent_of_the_last_two": last[0],
        }
    return table, report


# --- agent, rules and floor -----------------------------------------------------------------------


def tuned(task: Task, episodes: int) -> list[str]:
    """Of every family the policy with the best mean return on tuning seeds."""

    trials = sum(map(len, FAMILIES.values()))
    with progress_bar(trials * episodes * task.horizon, "tuning rules") as bar:

        def worth(name: str) -> float:
            bar.say(name)
            policy = make_policy(name, task)
            results = run_episodes(task, policy, episodes, TUNING_SEED, bar.update)
            return float(results.returns.mean())

        return [
            max((family.format(value) for value in values), key=worth)
            for family, values in FAMILIES.items()
        ]


def floor(task: Task) -> float:
    """The return of an episode that no policy exceeds, of sources that are all alike.

    All have the same optimum at a price, so one with its share of the tokens stands for them.
    """
    problems, bucket = source_problems(task), task.bucket
    count = len(problems)
    if any(repr(problem) != repr(problems[0]) for problem in problems):
        raise ValueError("the sources are not alike")
    share, spent = bucket.rate / count, float(bucket.cost[0, 0])
    bound = lagrangian_bound(
        problems[:1], (spent,), share, task.horizon, float(bucket.initial) / count
    )
    return -count * bound.cost


def comparison(
    task: Task, agent: str, rules: Sequence[str], episodes: int, seed: int
) -> list[dict[str, Any]]:
    """Agent and rules, best first, each with its paired difference to the agent."""
    result = run_all(task, [agent, *rules], episodes, seed, "testing")
    rows = [
        {
            "policy": name,
            "return": mean_interval(results.returns)._asdict(),
            "to_agent": mean_interval(results.returns - result[agent].returns)._asdict(),
            "rate": float(results.rate.mean()),
            "requests": float(results.requests.mean()),
            "mse": float(results.mse.mean()),
        }
        for name, results in result.items()
    ]
    return sorted(rows, key=lambda row: -row["return"]["mean"])


def comparison_table(rows: Sequence[dict[str, Any]], least: float) -> Table:
    """Best first; above the floor is by how much a policy costs more."""
    heads = ("return", "below the agent's", "above the floor", "rate", "requests", "MSE")
    table = tables.table_tables("forty sensors, one bucket", ("policy", *heads))
    table.add_row("floor: no policy has more", f"{least:.2f}", "", "", "", "", "")
    for row in rows:
        mean, difference = row["return"]["mean"], row["to_agent"]
        table.add_row(
            row["policy"],
            f"{mean:.2f}",
            f"{-difference['mean']:.2f} [{-difference['high']:.2f}, {-difference['low']:.2f}]",
            f"{mean / least - 1.0:+.1%}",
            f"{row['rate']:.4f}",
            f"{row['requests']:.4f}",
            f"{row['mse']:.2f}",
        )
    return table


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("what", choices=("cost", "table"))
    parser.add_argument("--sensors", type=int, nargs="+", default=SENSORS)
    parser.add_argument("--config", default="many_sensors")
    parser.add_argument("--model", type=Path, help="the trained agent, for the table")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--tuning", type=int, default=200, help="episodes of a rule's trial")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, help="write the figures to this JSON file")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    arguments = parser.parse_args()
    warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
    with quietly(arguments.quiet):
        table, report = build_parts(arguments, parser)
    if arguments.output is not None:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        arguments.output.write_text(json.dumps(report, indent=1) + "\n")
    Console(width=130).print(table)


def build_parts(
    arguments: argparse.Namespace, parser: argparse.ArgumentParser
) -> tuple[Table, dict[str, Any]]:
    """What was asked for, as a table and for a file."""
    if arguments.what == "cost":
        return cost_table(arguments.sensors)
    if arguments.model is None:
        parser.error("the table needs --model")
    environment = load_checked(Experiment, arguments.config).environment
    task = make_task(environment.id, **environment.options)
    rules, least = tuned(task, arguments.tuning), floor(task)
    rows = comparison(task, f"model:{arguments.model}", rules, arguments.episodes, arguments.seed)
    report = {"episodes": arguments.episodes, "seed": arguments.seed, "floor": least, "rows": rows}
    return comparison_table(rows, least), report


if __name__ == "__main__":
    main()
