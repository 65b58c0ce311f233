"""From an empty folder to a front: the page's own lines run, with less of everything."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_runs import refusal, succeed
from paths import ROOT

from fusion_gym.training.config import Experiment, load_checked

PAGE = (ROOT / "docs" / "newcomer.md").read_text()
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
LESS = {
    "evaluate": ["--episodes", "3"],
    "train": ["--timesteps", "2048", "--set", "horizon=8"],
    "compare": ["--episodes", "3"],
}


def command_lines() -> list[list[str]]:
    text = "".join(block for language, block in BLOCKS if language == "bash")
    return [shlex.split(line) for line in text.replace("\\\n", " ").splitlines()]


def test_the_lines_of_the_page_lead_to_a_front(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text, _ = (block for language, block in BLOCKS if language == "yaml")
    first, *_ = text.splitlines()
    Path(first.removeprefix("# ")).write_text(text)
    installing, *commands = command_lines()
    assert installing[:2] == ["pip", "install"]
    assert [words[1] for words in commands] == [*LESS, "train", "compare"]
    for program, name, *words in commands[: len(LESS)]:
        assert program == "fusion-gym"
        ended = succeed(name, [*words, *LESS[name]])
        if name == "evaluate":
            assert "kitchen" in ended.out
    assert (tmp_path / "runs/rooms/comparison/pareto.png").stat().st_size > 20_000
    compared = json.loads((tmp_path / "runs/rooms/comparison/comparison.json").read_text())
    prices = [row["price"] for row in compared["prices"]]
    evaluated = json.loads((tmp_path / "runs/rooms/comparison/evaluation.json").read_text())
    agent = [text for text in evaluated["policies"] if text.startswith("model:")]
    assert [float(text.partition("price=")[2]) for text in agent] == prices
    # The plant of the file belongs to the training, wherever the file has gone.
    content = yaml.safe_load((tmp_path / "runs/rooms/front/config.yaml").read_text())["environment"]
    options = content["options"]
    assert options.pop("reward_scale") > 0.0
    low, high = options.pop("price_range")
    np.testing.assert_allclose(prices, np.geomspace(low, high, 5), rtol=1e-3)
    assert (prices[0], prices[-1]) == (low, high)
    assert options == {
        "memory": True, "cost_weight": "random", "horizon": 8, **yaml.safe_load(text)
    }  # fmt: skip
    Path("rooms.yaml").write_text(text.replace("0.05", "0.04"))
    same = ["--config", "linear_fusion_front", "--output", "runs/rooms/front", "--set", "horizon=8"]
    error = refusal("train", [*same, "system=rooms.yaml", "--resume", "--timesteps", "4096"])
    assert "environment" in error
    assert "transition" in error


def test_many_sensors_train_shorter() -> None:
    experiment = load_checked(Experiment, "linear_fusion_front")
    lengths = [
        experiment.resolved({"reward_scale": 1.0, "price_range": None}, sensors).training.timesteps
        for sensors in (2, 4, 12)
    ]
    assert lengths == [800_000, 800_000, 266_667]
    given = experiment.changed(None, timesteps=1000)
    resolved = given.resolved(given.environment.options | {"reward_scale": 1.0}, 12)
    assert resolved.training == given.training
