"""What one improvement by simulation brings over the value rule, in the benchmark's settings.

    python -m benchmarks.rollout tobit_oscillator --output results

For each price of a token it plays `rollout` on `value_of_information`, and that base by itself, on
the same episodes of the setting with memory, and writes both points and the paired difference of
the returns at that price to `OUTPUT/SETTING/rollout.csv`. The base's own price is the token's over
`--ratio`: a packet keeps its worth over several steps, and the rule counts one.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import yaml

import fusion_gym
from agents.benchmark.tables import write_rows
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.evaluation.metrics import mean_interval
from fusion_gym.output.progress import progress_bar, quietly, remark, writing
from fusion_gym.policies.registry import make_policy

CONFIG = Path(__file__).parent.parent / "configs" / "benchmark.yaml"


def point(policy: str, results: EpisodeResults) -> dict[str, Any]:
    """Rate and mean squared error of a policy's episodes."""
    return {
        "policy": policy,
        "rate": float(results.rate.mean()),
        "mse": mean_interval(results.mse)._asdict(),
    }


def improve(task: Task, price: float, value: Any, progress: Any) -> dict[str, Any]:
    """The point of one improvement at a price, with its base's beside it."""
    base = f"value_of_information:price={price / value.ratio:.3g},at_most=1"
    policy = f"rollout:samples={value.samples},steps={value.steps},price={price:.3g},base={base}"
    results, plain = (
        run_episodes(task, make_policy(name, task), value.episodes, value.seed, progress)
        for name in (policy, base)
    )
    gain = mean_interval(results.returns - plain.returns)
    return point(policy, results) | {
        "price": price,
        **{f"base_{key}": value for key, value in point(base, plain).items()},
        "return_gain": gain._asdict(),
        "return": float(results.returns.mean()),
    }


def main() -> None:
    """Entry point."""
    settings = {item["name"]: item for item in yaml.safe_load(CONFIG.read_text())["settings"]}
    parser = argparse.ArgumentParser(description="One improvement by simulation on the value rule.")
    parser.add_argument("setting", choices=settings)
    parser.add_argument("--prices", type=float, nargs="+", help="default: four of the range")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--samples", type=int, default=8)
    parser.add_argument("--steps", type=int, default=8)
    parser.add_argument("--ratio", type=float, default=5.0)
    parser.add_argument("--output", type=Path, required=True, help="a folder")
    parser.add_argument("--quiet", action="store_true", help="neither progress nor remarks")
    arguments = parser.parse_args()
    selection = settings[arguments.setting]
    low, high = selection["price_range"]
    prices = arguments.prices or [(low * high) ** 0.5 * factor for factor in (0.3, 1.0, 3.0, 10.0)]
    environment = selection["environment"]
    points, options = [], environment["options"] | {"memory": True}
    tasks = {
        price: fusion_gym.make_task(environment["id"], **options, cost_weight=price)
        for price in (float(f"{price:.3g}") for price in prices)
    }
    steps = sum(2 * arguments.episodes * task.horizon for task in tasks.values())
    with quietly(arguments.quiet), progress_bar(steps, arguments.setting) as bar:
        writing(("points", arguments.output))
        for price, task in tasks.items():
            points.append(improve(task, price, arguments, bar.update))
            last = points[-1]
            remark(f"price {price}: rate {last['rate']:.4f}, MSE {last['mse']['mean']:.4g}")
    shared = {
        "env": environment["id"],
        "options": options,
        "episodes": arguments.episodes,
        "seed": arguments.seed,
        "command": " ".join(["python -m benchmarks.rollout", *sys.argv[1:]]),
    }
    write_rows(arguments.output / arguments.setting, "rollout", [shared | item for item in points])


if __name__ == "__main__":
    main()
