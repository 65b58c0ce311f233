"""Many sensors of one kind on one bucket: what learning leaves beside the rules.

    fusion-gym train --config configs/many_sensors.yaml
    python -m benchmarks.many_sensors --model runs/many_sensors/best_model.zip

The second plays the agent of `configs/many_sensors.yaml` and rules, each family tuned on other
seeds, on the same episodes under the same budget, with a floor that no policy undercuts: every
source's own optimum at the price of a token that the budget has (weak duality).
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from fusion_gym.commands.compare import run_all
from fusion_gym.core.task import Task
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.evaluation.intervals import mean_interval
from fusion_gym.output import tables
from fusion_gym.output.files import write
from fusion_gym.output.progress import progress_bar, quietly
from fusion_gym.policies.registry import make_policy
from fusion_gym.solvers import lagrangian_bound
from fusion_gym.solvers.task import source_problems
from fusion_gym.training.checked import load_checked
from fusion_gym.training.config import Experiment

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
    parser.add_argument("--config", default="many_sensors")
    parser.add_argument("--model", type=Path, required=True, help="the trained agent")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--tuning", type=int, default=200, help="episodes of a rule's trial")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, help="write the figures to this JSON file")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    arguments = parser.parse_args()
    environment = load_checked(Experiment, arguments.config).environment
    task = make_task(environment.id, **environment.options)
    shared = {"episodes": arguments.episodes, "seed": arguments.seed}
    with quietly(arguments.quiet):
        rules, least = tuned(task, arguments.tuning), floor(task)
        rows = comparison(task, f"model:{arguments.model}", rules, **shared)
    write(arguments.output, shared | {"floor": least, "rows": rows})
    Console(width=130).print(comparison_table(rows, least))


if __name__ == "__main__":
    main()
