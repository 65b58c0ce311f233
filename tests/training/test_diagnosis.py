"""What a training shows of itself: the lines of TensorBoard, and validation at each price."""

import json
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from training_configs import ENV, SMALL, read_records, small_config

from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.training.callbacks import PriceRecord, threshold_costs, warn_of_silence
from fusion_gym.training.config import TABLE, Experiment, load_checked
from fusion_gym.training.run import train

FRONT = {"filter": "tobit", "horizon": 20, "cost_weight": "random", "price_range": [0.01, 0.32]}
COUNTERFACTUAL = {"n_steps": 8, "batch_size": 32, "n_epochs": 1}


def trained(folder: Path, kind: str, local: bool = False, **options: Any) -> Experiment:
    """A short training on drawn prices."""
    choice = SMALL.get(kind, {"name": kind, **COUNTERFACTUAL})
    if "binary" not in TABLE[kind].actions:
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
    assert max(granted) <= 0.5 / 3 / 3 + 0.05  # tokens per step, cost, sensors
    if kind != "dqn":
        entropy = visible["train/entropy_per_sensor"]
        assert all(0.0 < value <= math.log(2) + 1e-6 for value in entropy)
    if kind == "counterfactual_ppo":
        for name in ("advantage_spread", "surplus_share", "explained_variance"):
            assert visible[f"train/{name}"]
    for row in read_records(tmp_path / "run")[-1]["prices"]:
        for key in ("cost", "tokens", "mse", "drawn_cost", "drawn_tokens", "drawn_mse"):
            name = f"validation/{key}_price_{row['price']:.3g}"
            assert visible[name][-1] == pytest.approx(row[key])


@pytest.fixture(scope="module")
def front(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a training by PPO."""
    return Path(trained(tmp_path_factory.mktemp("front"), "ppo").output)


def test_the_records_at_each_price_are_those_of_the_agent(front: Path) -> None:
    """Of the likeliest action; drawn actions of a new agent send about half of the time."""
    record, options = read_records(front)[-1], FRONT | {"price_range": None}
    prices = [row["price"] for row in record["prices"]]
    np.testing.assert_allclose(prices, np.geomspace(0.01, 0.32, 5))
    for row in record["prices"]:
        task = make_task(ENV, **options | {"cost_weight": row["price"]})
        agent = f"model:{front / 'final_model.zip'},price={row['price']!r}"
        results = run_episodes(task, make_policy(agent, task), 8, 500_000_000)
        assert row["mse"] == pytest.approx(results.mse.mean())
        assert row["tokens"] == pytest.approx(results.tokens.mean())
        assert row["cost"] == pytest.approx(-results.returns.mean() / task.horizon)
        assert row["drawn_tokens"] > 0.0 != row["drawn_mse"]
    costs = np.array([row["cost"] for row in record["prices"]])
    task = make_task(ENV, **FRONT)
    relative = costs / threshold_costs(task, False, prices)
    assert record["relative_cost"] == pytest.approx(relative.mean())


def test_the_best_model_has_the_least_relative_cost(front: Path) -> None:
    least = min(record["relative_cost"] for record in read_records(front))
    summary = json.loads((front / "summary.json").read_text())
    assert summary["best_validation"]["relative_cost"] == least


@pytest.mark.parametrize(("tokens", "expected"), [(0.0, True), (0.6, False)])
def test_a_silent_likeliest_action_gets_a_warning(tokens: float, expected: bool) -> None:
    row = PriceRecord(0.1, 1.0, tokens, 1.0, 0.1, 1.0, 1.0, 1.0)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        warn_of_silence([row, row._replace(tokens=1.0)])
    assert [bool("at 1 of 2 prices" in str(item.message)) for item in warned] == [True] * expected


def test_a_fixed_price_is_the_one_of_the_records(tmp_path: Path) -> None:
    trained(tmp_path, "ppo", cost_weight=0.02)
    for record in read_records(tmp_path / "run"):
        assert [row["price"] for row in record["prices"]] == [0.02]
        assert record["relative_cost"] == record["prices"][0]["cost"]
