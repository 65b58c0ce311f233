"""Results of a tiny benchmark as its commands write them, made up."""

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agents.benchmark.training import write_verdict

ENV = "fusion_gym/RemoteEstimation-v1"
SETTING = "remote_estimation"
ALWAYS = 0.5
PRICES = (0.1, 0.3, 1.0)
RATES = (0.25, 0.1, 0.04)
# Mode, memory, what is heard, class of knowledge, and the error relative to that of the centre.
CLASSES: dict[str, tuple[str, bool, str | None, str, float]] = {
    "centre": ("centre", False, None, "centre", 1.0),
    "local_none": ("local", False, "none", "own", 0.9),
    "local_packets_memory": ("local", True, "packets", "own_memory", 0.8),
    "sensors": ("sensors", False, None, "scheduler", 0.75),
    "sensors_memory": ("sensors", True, None, "scheduler_memory", 0.6),
}


def interval(mean: float, half: float = 0.01) -> dict[str, float]:
    return {"mean": mean, "low": mean - half, "high": mean + half}


def outcome(rate: float, mse: float) -> dict[str, Any]:
    others = {name: interval(0.0) for name in ("return", "denied", "tokens", "nees")}
    return {"rate": [rate, rate], "mse": interval(mse), "median": mse} | others


def error(scale: float, rate: float) -> float:
    """A front: falling and convex."""
    return scale / (rate + 0.05)


def front(name: str, seeds: int) -> dict[str, Any]:
    """A class in the verdict; its first agent is worse than the rules, the others are better."""
    mode, memory, broadcast, knows, scale = CLASSES[name]
    worse = (0.05, -0.1, -0.1)
    points = [
        {
            "price": price,
            "rate": rate,
            "mse": (1.0 + share) * error(scale, rate),
            "envelope": error(scale, rate),
            "reference": 0.9 * error(scale, rate),
            "hindsight": 0.5 * error(scale, rate),
            "difference": interval(share),
        }
        for price, rate, share in zip(PRICES, RATES, worse, strict=True)
    ]
    return {
        "seeds": seeds,
        "points": points,
        "prices": 3,
        "rates": [0.03, 0.1],
        "middle": interval(-0.05),
        "room": 0.1,
        "closed": 0.5,
        "hindsight_room": 0.5,
        "at": [
            {"rate": 0.025, "rules": interval(error(scale, 0.025))},
            {
                "rate": 0.1,
                "rules": interval(error(scale, 0.1)),
                "agents": interval(0.9 * error(scale, 0.1)),
                "difference": interval(-0.1),
            },
        ],
        "mode": mode,
        "memory": memory,
        "broadcast": broadcast,
        "packet": "measurement",
        "knows": knows,
        "sha256": "0" * 64,
        "envelope": [
            {"name": f"paced:rate={rate}/{scale}", "rate": rate, "mse": error(scale, rate)}
            for rate in (0.0, 0.05, 0.5)
        ],
    }


def run(name: str) -> dict[str, Any]:
    """What every run says of itself."""
    inputs = {"environment": {"id": ENV, "options": {"horizon": 4}}, "seed": 0}
    inputs |= {"training": {"validation": {"episodes": 1000, "seed": 500_000_000}}}
    return {"run": name, "horizon": 4, "episodes": 20, "made_from": "0", "inputs": inputs}


def agent(name: str, seed: int) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """One training, and what it did at its prices."""
    mode, memory, broadcast, _, scale = CLASSES[name]
    options: dict[str, Any] = {"memory": True} if memory else {}
    if broadcast not in (None, "none"):
        options["broadcast"] = broadcast
    label = f"agent_{name}_{seed}"
    policies = [
        {"run": label, "name": f"price={price}", "price": price}
        | outcome(rate, (1.0 + 0.1 * seed) * error(scale, rate))
        for price, rate in zip(PRICES, RATES, strict=True)
    ]
    return run(label) | {
        "class": name,
        "class_options": options | ({"information": "centre"} if mode == "centre" else {}),
        "training_seed": seed,
        "best_validation": {"return": -1.0 - seed},
    }, policies


def small_results(
    results: Path, setting: str = SETTING, classes: Sequence[str] = tuple(CLASSES), seeds: int = 2
) -> Path:
    """The folder of a setting, with all that the report reads there."""
    folder = results / setting
    fronts = {name: front(name, seeds) for name in classes}
    worth = {"kind": "memory", "knows": "sensors_memory", "less": "sensors"}
    verdict = {
        "title": "A small setting, made up",
        "env": ENV,
        "episodes": 20,
        "seed": 0,
        "always": ALWAYS,
        "classes": fronts,
        "worth": [worth | {"rules": interval(-0.2), "agents": interval(0.0)}],
    }
    places = [place for item in fronts.values() for place in item["envelope"]]
    rules = {place["name"]: ("paced", outcome(place["rate"], place["mse"])) for place in places}
    rules["always"] = ("always", outcome(ALWAYS, 1.0))
    policies = [
        {"run": "baselines", "name": name, "family": family, "knows": "centre"} | rule
        for name, (family, rule) in rules.items()
    ]
    policies.append({"run": "genie", "name": "everything arrives"} | outcome(0.5, 0.5))
    for rate in RATES:
        ahead = {"run": "informed", "name": f"lookahead:steps=1,price={rate}"}
        policies.append(ahead | outcome(rate, error(0.7, rate)))
    runs = [run("baselines"), run("informed")]
    for row, tested in (agent(name, seed) for name in classes for seed in range(seeds)):
        runs.append(row)
        policies += tested
    write_verdict(folder, verdict, runs, policies)
    return folder


def small_model(path: Path) -> None:
    """An archive in the place of a model."""
    path.parent.mkdir(parents=True)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", "{}")
