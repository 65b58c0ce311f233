"""What a training shows of itself: the lines of TensorBoard, and validation at each price."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from training_configs import ENV, SMALL, read_records, small_config

from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.training.algorithms import TABLE
from fusion_gym.training.checked import load_checked
from fusion_gym.training.config import Experiment
from fusion_gym.training.diagnosis import by_price, prices_of
from fusion_gym.training.run import train

FRONT = {"filter": "tobit", "horizon": 20, "cost_weight": "random", "price_range": [0.01, 0.32]}
COUNTERFACTUAL = {"n_steps": 8, "batch_size": 32, "n_epochs": 1}


def trained(folder: Path, kind: str, local: bool = False, **options: Any) -> Experiment:
    """A short training on drawn prices."""
    choice = SMALL.get(kind, {"name": kind, **COUNTERFACTUAL})
    if TABLE[kind].discrete_only:
        options["action"] = "discrete"
    environment = {"id": ENV, "options": FRONT | options, "local": local}
    training = {"timesteps": 512, "num_envs": 8, "price_exponent": 0.5}
    validation = {"every": 256, "episodes": 40}
    config = small_config(
        folder, environment=environment, algorithm=choice, training=training, validation=validation
    )
    experiment = load_checked(Experiment, config)
    train(experiment, quiet=True)
    return experiment


def lines(folder: Path) -> dict[str, list[float]]:
    """All values of every line that TensorBoard shows."""
    result = EventAccumulator(str(folder / "tensorboard"))
    result.Reload()
    return {tag: [e.value for e in result.Scalars(tag)] for tag in result.Tags()["scalars"]}


@pytest.mark.parametrize(
    ("kind", "local"),
    [("counterfactual_ppo", False), ("counterfactual_ppo", True), ("a2c", False), ("dqn", False)],
)
def test_traffic_entropy_and_validation_at_each_price_are_shown(
    tmp_path: Path, kind: str, local: bool
) -> None:
    trained(tmp_path, kind, local, tokens="limited", token_rate=0.5, initial_tokens=0.0)
    visible = lines(tmp_path / "run")
    requested, granted = visible["rollout/requested"], visible["rollout/granted"]
    assert all(0.0 <= few < many < 1.0 for few, many in zip(granted, requested, strict=True))
    assert max(granted) > 0.0
    assert max(granted) <= 0.5 / 3 / 3 + 0.05  # tokens a step, cost, sensors
    if kind != "dqn":
        entropy = visible["train/entropy_per_sensor"]
        assert all(0.0 < value <= math.log(2) + 1e-6 for value in entropy)
    if kind == "counterfactual_ppo":
        for name in ("advantage_spread", "surplus_share", "explained_variance"):
            assert visible[f"train/{name}"]
    for part in read_records(tmp_path / "run")[-1]["prices"]:
        where = f"price_{part['low']:.3g}-{part['high']:.3g}"
        for key in ("mse", "rate"):
            assert visible[f"validation/{key}_{where}"][-1] == pytest.approx(part[key])


def test_the_records_at_each_price_are_those_of_the_whole(tmp_path: Path) -> None:
    trained(tmp_path, "ppo")
    for record in read_records(tmp_path / "run"):
        parts = record["prices"]
        assert [round(part["low"], 6) for part in parts] == [0.01, 0.02, 0.04, 0.08, 0.16]
        assert sum(part["episodes"] for part in parts) == 40
        for key in ("mse", "rate"):
            mean = sum(part["episodes"] * part[key] for part in parts) / 40
            assert mean == pytest.approx(record[key])


def test_episodes_are_reported_apart_by_their_price() -> None:
    """Against each episode by itself, with a rule that asks for less at higher prices."""
    task = make_task(ENV, **FRONT)
    prices = prices_of(task, 30, 7)
    results = run_episodes(task, make_policy("random:rate=0.3", task), 30, 7)
    for part in by_price(task, prices, results):
        inside = [i for i, price in enumerate(prices) if part["low"] <= price < part["high"]]
        assert part["episodes"] == len(inside)
        assert part["mse"] == pytest.approx(float(np.mean(results.mse[inside])))
        assert part["rate"] == pytest.approx(float(np.mean(results.rate[inside])))
    assert {round(float(price), 12) for price in prices} == {
        round(float(prices_of(task, 1, 7 + i)[0]), 12) for i in range(30)
    }


def test_a_fixed_price_has_no_parts(tmp_path: Path) -> None:
    trained(tmp_path, "ppo", cost_weight=0.02)
    assert all("prices" not in record for record in read_records(tmp_path / "run"))
    assert not [name for name in lines(tmp_path / "run") if "price_" in name]
