"""Evaluate policies on paired episodes.

    python -m agents.evaluate --env fusion_gym/TobitOscillator-v0 --set filter=tobit \\
        --policies always dynamic_event innovation_threshold:threshold=1 --reference always

Every policy runs on the same seeds, so that the same noise meets every policy. The JSON is
written after each policy; with ``--resume`` the policies that it already holds are not run again.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import fusion_gym
from agents import tables
from agents.config import load_experiment
from agents.progress import progress_bar
from fusion_gym.evaluation.episodes import EpisodeResults, run_episodes
from fusion_gym.evaluation.metrics import paired_difference, robust_summary, summarise
from fusion_gym.policies.make import make_policy
from fusion_gym.policies.registry import parse_settings
from fusion_gym.validation import ConfigurationError


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(
        prog="python -m agents.evaluate",
        description="Evaluate policies on paired episodes.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    result.add_argument("--env", help="id of a registered environment")
    result.add_argument("--config", help="take environment and options from a training's YAML")
    result.add_argument(
        "--set",
        nargs="+",
        action="extend",
        default=[],
        metavar="OPTION=VALUE",
        help="options of gym.make for the environment; they go before the config's",
    )
    result.add_argument(
        "--policies",
        nargs="+",
        action="extend",
        required=True,
        metavar="NAME[:key=value,…]",
        help="analytic policies by name, or model:PATH",
    )
    result.add_argument("--episodes", type=int, default=1000)
    result.add_argument("--seed", type=int, default=0, help="seed of the first episode")
    result.add_argument("--reference", help="one of the policies: print paired differences to it")
    result.add_argument("--json", type=Path, help="write the results to this file")
    result.add_argument("--resume", action="store_true", help="keep what the JSON already holds")
    return result


def evaluate(arguments: argparse.Namespace) -> dict[str, Any]:
    """Run the evaluation that the command line asks for and return what the JSON holds.

    Raises:
        ConfigurationError: anything that is not allowed, before the first episode.
    """
    env_id, options = environment(arguments)
    task = fusion_gym.make_task(env_id, **options)
    names = list(dict.fromkeys(arguments.policies))
    if arguments.reference is not None and arguments.reference not in names:
        raise ConfigurationError(
            f"reference = {arguments.reference!r} is not allowed: it must be one of the policies "
            f"{names}"
        )
    if arguments.resume and arguments.json is None:
        raise ConfigurationError("resume = True is not allowed without json: there is no file")
    if arguments.resume and arguments.reference:
        raise ConfigurationError(
            f"resume = True is not allowed with reference = {arguments.reference!r}: paired "
            "differences need the episodes of every policy, and the JSON holds only their means"
        )
    policies = {name: make_policy(name, task) for name in names}
    report: dict[str, Any] = {
        "env": env_id,
        "episodes": arguments.episodes,
        "seed": arguments.seed,
        "horizon": task.horizon,
        "settings": task.settings,
        "states": list(task.system.state_names),
        "policies": {},
        "quantiles": {},
    }
    done = finished(arguments.json, report) if arguments.resume else {"policies": {}}
    results: dict[str, EpisodeResults] = {}
    steps = len(names) * arguments.episodes * task.horizon
    with progress_bar(steps, "evaluating") as bar:
        for name, policy in policies.items():
            if name in done["policies"]:
                report["policies"][name] = done["policies"][name]
                report["quantiles"][name] = done["quantiles"][name]
                bar.update(arguments.episodes * task.horizon)
                continue
            bar.set_postfix_str(name, refresh=False)
            results[name] = run_episodes(
                task, policy, arguments.episodes, arguments.seed, bar.update
            )
            report["policies"][name] = summarise(results[name])
            report["quantiles"][name] = robust_summary(results[name])
            write(arguments.json, report)
    differences = {
        name: paired_difference(found, results[arguments.reference])
        for name, found in results.items()
        if arguments.reference and name != arguments.reference
    }
    if arguments.reference:
        report["reference"] = {
            "name": arguments.reference,
            "differences": {name: found._asdict() for name, found in differences.items()},
        }
    write(arguments.json, report)
    title = (
        f"{env_id}: {arguments.episodes} episodes of {task.horizon} steps, seed {arguments.seed}"
    )
    tables.console().print(
        tables.evaluation_table(title, report["policies"], report["quantiles"], differences)
    )
    tables.console().print(tables.state_table(task.system.state_names, report["policies"]))
    return report


def environment(arguments: argparse.Namespace) -> tuple[str, dict[str, Any]]:
    """Id and options from ``--config``, ``--env`` and ``--set``.

    Raises:
        ConfigurationError: neither an id nor a config, or a config that is not allowed.
    """
    options = parse_settings("option", arguments.set)
    if arguments.config is None:
        if arguments.env is None:
            raise ConfigurationError("env = None is not allowed: give --env ID or --config FILE")
        return arguments.env, options
    chosen = load_experiment(arguments.config).environment
    return arguments.env or chosen.id, dict(chosen.options) | options


def finished(path: Path, report: dict[str, Any]) -> dict[str, Any]:
    """What an earlier run of the same evaluation has written.

    Raises:
        ConfigurationError: the file is of another evaluation.
    """
    if not path.exists():
        return {"policies": {}}
    earlier: dict[str, Any] = json.loads(path.read_text())
    plain = json.loads(json.dumps(report))
    for key in ("env", "episodes", "seed", "horizon", "settings"):
        if earlier.get(key) != plain[key]:
            raise ConfigurationError(
                f"json {str(path)!r} holds another evaluation: its {key} is {earlier.get(key)!r}, "
                f"asked for is {plain[key]!r}"
            )
    return earlier


def write(path: Path | None, report: dict[str, Any]) -> None:
    """Replace the file in one move, so that an interrupt never leaves half of it."""
    if path is None:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".part")
    partial.write_text(json.dumps(report, indent=1) + "\n")
    partial.replace(path)


def main() -> None:
    """Entry point."""
    try:
        evaluate(parser().parse_args())
    except ConfigurationError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted: finished policies are in the JSON, if one was asked for")


if __name__ == "__main__":
    main()
