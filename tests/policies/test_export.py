"""An exported file decides as the agent does, says what it sees, and is refused where it cannot."""

import contextlib
import functools
import importlib.util
import io
import json
import re
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from small_models import ENV, MODELS

import fusion_gym
from fusion_gym import seeds, zoo
from fusion_gym.commands.export import Export, spec
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.evaluation.onnx_export import DecisionGraph, onnx_agreement, onnx_card, save_graph
from fusion_gym.policies.base import owner_of
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.saved import ModelPolicy, ModelView, tag_model
from fusion_gym.validation import ConfigurationError


def requests_at(name: str) -> tuple[ModelPolicy, Task]:
    model, task = MODELS[name].build()
    return ModelPolicy(model, task, trained=ModelView(local="local" in MODELS[name].options)), task


def written(agent: ModelPolicy, path: Path) -> DecisionGraph:
    graph = DecisionGraph(agent)
    save_graph(graph, path, onnx_card(agent, graph, ENV, "test"))
    return graph


def describe(path: Path) -> dict[str, Any]:
    """The metadata as a node reads it."""
    session = onnxruntime.InferenceSession(str(path))
    result = dict(session.get_modelmeta().custom_metadata_map)
    words = {"decides", "knows", "model", "environment", "algorithm", "observation_version"}
    words |= {"format", "fusion_gym_version"}
    return result | {key: json.loads(result[key]) for key in result.keys() - words}


def played(task: Task, decide: Callable[[Any], Any], owner: Any, runs: int = 30) -> Any:
    """Requests (steps, sensors, N) of whole episodes."""
    batch, result = EpisodeBatch.seeded(task, runs, 3, owner), []
    for _ in range(task.horizon):
        result.append(decide(batch))
        batch.step(result[-1])
    return np.array(result)


@pytest.mark.parametrize("name", MODELS)
def test_the_file_decides_as_stable_baselines_does(name: str, tmp_path: Path) -> None:
    """Played by onnxruntime alone, on rows made by hand: the same requests in all steps."""
    agent, task = requests_at(name)
    path = tmp_path / "agent.onnx"
    graph = written(agent, path)
    session = onnxruntime.InferenceSession(str(path))
    view, memory = agent.view, {}
    for item in session.get_inputs():
        if item.name in ("hidden", "cell"):
            shape = (item.shape[0], 30 * view.rows_per_run, item.shape[2])
            memory[item.name] = np.zeros(shape, dtype=np.float32)

    def by_file(batch: EpisodeBatch) -> Any:
        arguments = {"observation": view.rows(batch.observe())} | memory
        if "grantable" in graph.inputs:
            arguments["grantable"] = batch.grantable().T.reshape(len(arguments["observation"]), -1)
        result = dict(zip(graph.outputs, session.run(None, arguments), strict=True))
        memory.update({key: result[f"{key}_next"] for key in memory})
        assert result["request"].dtype == np.int8
        if graph.choices is None:
            np.testing.assert_array_equal(result["request"], result["probability"] > 0.5)
        return result["request"].reshape(30, task.sensors).T == 1

    agent.reset(30)
    expected = played(task, lambda batch: agent(batch.signals()), owner_of(agent))
    np.testing.assert_array_equal(played(task, by_file, owner_of(agent)), expected)
    assert 0.0 < expected.mean() < 1.0
    result = onnx_agreement(agent, graph, path, task, observations=500)
    assert result.holds
    assert 500 <= result.observations == result.episodes * 20 * view.rows_per_run
    assert result.difference < 1e-4


def test_probabilities_are_those_that_the_agent_draws_with(tmp_path: Path) -> None:
    """The share of requests of 4,000 draws at one observation, within four deviations."""
    for name in ("ppo", "ppo_discrete", "maskable_single"):
        agent, task = requests_at(name)
        graph = written(agent, tmp_path / "agent.onnx")
        batch = EpisodeBatch.seeded(task, 1, 0)
        rows = np.repeat(agent.view.rows(batch.observe()), 4000, axis=0)
        masks = {}
        arguments = {"observation": rows[:1]}
        if "grantable" in graph.inputs:
            allowed = np.array([[True], [False], [True]])
            masks = {"action_masks": agent.view.action.masks(allowed.repeat(4000, axis=1))}
            arguments["grantable"] = allowed.T
        session = onnxruntime.InferenceSession(str(tmp_path / "agent.onnx"))
        probability = session.run(["probability"], arguments)[0][0]
        action, _ = agent.model.predict(rows, deterministic=False, **masks)
        drawn = agent.view.action.requests(action, 4000).mean(1)
        slack = 4.0 * np.sqrt(probability * (1.0 - probability) / 4000) + 1e-6
        assert (np.abs(drawn - probability) < slack).all()
        if masks:
            assert probability[1] == 0.0


def test_another_file_is_reported_apart(tmp_path: Path) -> None:
    agent, task = requests_at("ppo")
    other, _ = requests_at("ppo")
    with torch.no_grad():
        other.model.policy.action_net.bias.add_(torch.tensor([0.0, 0.3, 0.0]))
    written(other, tmp_path / "other.onnx")
    graph, path = DecisionGraph(agent), tmp_path / "other.onnx"
    value = onnx_agreement(agent, graph, path, task, observations=500)
    assert not value.holds
    assert value.different > 0
    assert value.difference == pytest.approx(0.3, abs=1e-3)


def test_what_lies_beyond_the_bounds_is_clipped_inside(tmp_path: Path) -> None:
    agent, _ = requests_at("ppo")
    written(agent, tmp_path / "agent.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "agent.onnx"))
    space = agent.view.space
    rows = np.random.default_rng(0).normal(0.0, 8.0, (50, *space.shape)).astype(np.float32)
    inside = np.clip(rows, space.low, space.high)
    both = [session.run(["logits"], {"observation": value})[0] for value in (rows, inside)]
    np.testing.assert_array_equal(*both)
    assert (rows != inside).any()


# --- the command ----------------------------------------------------------------------------------


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command's own check, on fewer observations."""
    shorter = functools.partial(onnx_agreement, observations=500)
    monkeypatch.setattr("fusion_gym.evaluation.onnx_export.onnx_agreement", shorter)


def command(model: str, path: Path, *options: str, **value: Any) -> list[str]:
    with contextlib.redirect_stdout(io.StringIO()) as output:
        Export(model, path, options=(options,) if options else (), **value).run()
    return output.getvalue().splitlines()


AGENTS = ["remote_estimation_local", "biased_oscillator_scheduler"]


@pytest.mark.parametrize("name", AGENTS)
def test_agents_of_the_zoo_are_exported_with_what_they_see(name: str, tmp_path: Path) -> None:
    path = tmp_path / "agent.onnx"
    lines = command(f"zoo:{name},calibrated=false", path)
    assert f"{path.stat().st_size:,} bytes" in lines[0]
    assert re.search(r"against the agent on 10,[\d]{3} observations of \d+ episodes", lines[3])
    assert "all decisions agree" in lines[3]
    assert lines[4].startswith("transmissions per sensor and step there: 0.")
    assert "µs in the median" in lines[5]
    trained = zoo.card(name)["training"]["environment"]
    task = fusion_gym.make_task(trained["id"], **trained["options"])
    result, local = describe(path), "local" in name
    env = fusion_gym.FusionSB3VecEnv(task, 1, local=local)
    names, space = env.observation_names, env.observation_space
    assert result["observation_names"] == list(names)
    np.testing.assert_array_equal(np.float32(result["observation_low"]), space.low)
    np.testing.assert_array_equal(np.float32(result["observation_high"]), space.high)
    assert result["inputs"]["observation"]["shape"] == ["batch", len(names)]
    assert result["outputs"]["request"]["shape"] == ["batch", 1 if local else task.sensors]
    assert {observation_block["name"] for observation_block in result["observation_blocks"]} == {
        name.partition("[")[0] for name in names
    }
    assert result["options"]["token_rate"] == trained["options"]["token_rate"]
    expected = {
        "environment": trained["id"], "price_range": trained["options"]["price_range"],
        "fixed_price": None, "algorithm": "ppo", "format": "1",
        "fusion_gym_version": fusion_gym.__version__,
    }  # fmt: skip
    assert result | expected == result
    assert result["observation_version"].startswith(f"{trained['id']}:")
    assert result["action"]["sensors"] == task.sensors
    assert result["decides"].startswith("each sensor" if local else "a scheduler")
    onnx.checker.check_model(onnx.load(path), full_check=True)


@pytest.mark.usefixtures("few")
def test_a_node_in_an_environment_does_what_run_episodes_does(tmp_path: Path) -> None:
    """Through PettingZoo, one row at a time, by names from the file: the same share of requests."""
    name, price = "tobit_oscillator_local", 0.2
    path = tmp_path / "sensor.onnx"
    command(f"zoo:{name},price={price},calibrated=false", path)
    session = onnxruntime.InferenceSession(str(path))
    trained = zoo.card(name)["training"]["environment"]
    env = fusion_gym.parallel_env(trained["id"], **trained["options"])
    names = describe(path)["observation_names"]
    assert set(env.observation_names) - set(names) == {"price"}
    columns = [env.observation_names.index(name) for name in names]

    def request(row: Any) -> int:
        return int(session.run(["request"], {"observation": row[None, columns]})[0][0, 0])

    shares = []
    for seed in (5, 6):
        visited, _ = env.reset(seed=seed)
        result = []
        while env.agents:
            actions = {agent: request(visited[agent]) for agent in env.agents}
            result.append(list(actions.values()))
            visited = env.step(actions)[0]
        shares.append(np.mean(result, axis=0))
    task = fusion_gym.make_task(trained["id"], **trained["options"])
    policy = make_policy(f"zoo:{name},price={price},calibrated=false", task)
    expected = run_episodes(task, policy, 2, 5).requests
    np.testing.assert_allclose(shares, expected, atol=1e-12)
    assert 0.0 < expected.mean() < 0.9


@pytest.mark.usefixtures("few")
def test_one_price_is_inside_the_file(tmp_path: Path) -> None:
    name = "zoo:tobit_oscillator_centre,calibrated=false"
    command(name, tmp_path / "all.onnx")
    command(f"{name},price=0.1", tmp_path / "one.onnx")
    every, row = (onnxruntime.InferenceSession(str(tmp_path / f"{n}.onnx")) for n in ("all", "one"))
    about = describe(tmp_path / "one.onnx")
    assert "price" not in about["observation_names"]
    assert about["fixed_price"] == pytest.approx(0.1)
    assert about["price_range"] is None
    task = fusion_gym.make_task(ENV, **zoo.card(name[4:-17])["training"]["environment"]["options"])
    rows = EpisodeBatch.seeded(task, 64, 0).observe()
    place = describe(tmp_path / "all.onnx")["observation_names"].index("price")
    low, high = describe(tmp_path / "all.onnx")["price_range"]
    rows[:, place] = np.log(0.1 / low) / np.log(high / low)
    first = every.run(["logits"], {"observation": rows})[0]
    second = row.run(["logits"], {"observation": np.delete(rows, place, axis=1)})[0]
    np.testing.assert_allclose(first, second, atol=1e-5)
    rows[:, place] = 1.0
    dear = every.run(["probability"], {"observation": rows})[0]
    assert dear.mean() < 0.9 * (1.0 / (1.0 + np.exp(-first))).mean()


@pytest.mark.usefixtures("few")
def test_a_training_of_ones_own_says_its_environment(tmp_path: Path) -> None:
    model, task = MODELS["ppo"].build()
    tag_model(model, task)
    model.save(tmp_path / "best_model.zip")
    text = f"environment: {{id: {ENV}, options: {{filter: tobit, horizon: 20}}}}\n"
    path = tmp_path / "agent.onnx"
    with pytest.raises(ConfigurationError, match=r"give --env ID or --config FILE"):
        command(str(tmp_path / "best_model.zip"), path)
    text += "algorithm: {name: ppo}\ntraining: {timesteps: 32}\noutput: made\n"
    (tmp_path / "config.yaml").write_text(text)
    lines = command(str(tmp_path / "best_model.zip"), path)
    assert f"of {ENV}" in lines[3]
    assert describe(path)["options"]["horizon"] == 20
    by_hand = command(f"model:{tmp_path / 'best_model.zip'}", path, "filter=tobit", env=ENV)
    assert by_hand[3] != lines[3]  # its episodes are longer


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize(
    ("bias", "silent"),
    [([0, 0, 0], None), ([0, -99, -99], r"of the sensors \[1, 2\] none"), ([-99] * 3, "no sensor")],
)
def test_an_export_says_its_rate_and_warns_of_silent_sensors(
    bias: list[float], silent: str | None, tmp_path: Path
) -> None:
    """The rates are those of the agent on the same episodes."""
    model, task = MODELS["ppo"].build()
    with torch.no_grad():
        model.policy.action_net.bias.add_(torch.tensor(bias))
    tag_model(model, task)
    model.save(tmp_path / "agent.zip")
    options = ("filter=tobit", "horizon=20")
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", UserWarning)
        lines = command(f"{tmp_path / 'agent.zip'}", tmp_path / "a.onnx", *options, env=ENV)
    agent = make_policy(f"model:{tmp_path / 'agent.zip'}", task)
    rates = run_episodes(task, agent, 25, seeds.EXPORT.start).rate.mean(0)
    parts = ", ".join(f"{rate:.3g}" for rate in rates)
    assert lines[4].endswith(f" there: {rates.mean():.3g} (sensors: {parts})")
    messages = [str(item.message) for item in warned if item.category is UserWarning]
    assert len(messages) == (silent is not None)
    if silent is not None:
        assert re.match(
            f"{silent} ever transmits .* lower price .* fusion-gym calibrate", *messages
        )


ZOO = "zoo:tobit_oscillator_scheduler"
REFUSED = [
    ("always", {}, "it must be zoo:NAME, model:PATH or the path of a .zip"),
    ("zoo:nobody", {}, "zoo = 'nobody'"),
    (f"{ZOO},deterministic=false,calibrated=false", {}, "deterministic = False"),
    (f"{ZOO},price=9", {}, "price"),
    (ZOO, {}, "price = None is not allowed"),
    (ZOO, {"env": "fusion_gym/CorrelatedTracking-v1"}, "layout"),
]


@pytest.mark.parametrize(("model", "arguments", "message"), REFUSED)
def test_what_cannot_be_exported_is_refused(
    model: str, arguments: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigurationError, match=message):
        command(model, tmp_path / "agent.onnx", **arguments)
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("few")
def test_a_file_that_decides_otherwise_is_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "agent.onnx"
    command("zoo:tobit_oscillator_centre,price=0.2,calibrated=false", tmp_path / "other.onnx")
    path.write_text("kept")

    def wrong(graph: Any, to: Path, metadata: Any) -> None:
        shutil.copy(tmp_path / "other.onnx", to)

    monkeypatch.setattr("fusion_gym.evaluation.onnx_export.save_graph", wrong)
    message = r"is not exported: file .* [\d,]+ of .* observations, and"
    with pytest.raises(ConfigurationError, match=message):
        command("zoo:tobit_oscillator_centre,price=0.1,calibrated=false", path)
    assert path.read_text() == "kept"
    assert len(list(tmp_path.iterdir())) == 2


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find, parts = importlib.util.find_spec, {"onnxruntime": lambda name: None}
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: parts.get(name, find)(name))
    with pytest.raises(ConfigurationError, match=r"onnxruntime, .* its extra 'onnx'"):
        command("zoo:tobit_oscillator_centre", tmp_path / "agent.onnx")


def test_a_bare_path_is_a_model() -> None:
    assert spec("runs/a/best_model.zip,price=0.1") == "model:runs/a/best_model.zip,price=0.1"
    assert spec("zoo:a,price=2") == "zoo:a,price=2"
    assert spec("model:a") == "model:a"
