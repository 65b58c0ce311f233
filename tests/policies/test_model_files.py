"""A model file is data: what is rebuilt from it decides as it did, and nothing in it runs."""

import base64
import functools
import io
import json
import pickle
import random
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cloudpickle
import numpy as np
import pytest
import torch
import yaml
from command_runs import refusal, succeed
from refusals import refused
from sb3_contrib import QRDQN
from small_models import DISCRETE, ENV, MODELS, OPTIONS, Recipe
from stable_baselines3 import DQN, PPO
from stable_baselines3.common import save_util
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.saved import tag_model
from fusion_gym.validation import ConfigurationError


class Saved(NamedTuple):
    model: BaseAlgorithm
    task: Task
    plain: Path
    carded: Path


Models = Callable[[str], Saved]


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Models:
    """New models by name, saved by plain Stable-Baselines3 and with our card, each made once."""
    folder = tmp_path_factory.mktemp("models")

    @functools.cache
    def get(name: str) -> Saved:
        model, task = MODELS[name].build()
        if isinstance(model, DQN):
            model.exploration_rate = 0.5  # a coin that decisions by chance throw
        plain, carded = folder / f"{name}_plain.zip", folder / f"{name}.zip"
        model.save(plain)
        tag_model(model, task)
        model.save(carded)
        return Saved(model, task, plain, carded)

    return get


def refused_agent(path: Path | str, task: Task, *parts: str) -> None:
    refused(lambda: make_policy(f"model:{path}", task), *parts)


@pytest.fixture
def no_unpickling(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever unpickles raises; torch's reader of plain weights has a reader of its own."""

    def forbidden(*_: Any, **__: Any) -> Any:
        raise AssertionError("something was unpickled")

    for module in (pickle, cloudpickle):
        for name in ("load", "loads"):
            monkeypatch.setattr(module, name, forbidden)
    monkeypatch.setattr(
        pickle, "Unpickler", type("Reader", (pickle.Unpickler,), {"load": forbidden})
    )
    monkeypatch.setattr(save_util, "json_to_data", forbidden)
    monkeypatch.setattr(base64, "b64decode", forbidden)


def streams() -> list[Any]:
    """Where the random numbers that all share stand: torch's, NumPy's and Python's."""
    numpys: Any = np.random.get_state()  # noqa: NPY002
    return [torch.get_rng_state().tolist(), numpys[1].tolist(), numpys[2], random.getstate()]


def decisions(policy: Any, task: Task) -> list[Any]:
    policy.reset(20, 5)
    batch, result = EpisodeBatch.seeded(task, 20, 0), []
    for _ in range(12):
        result.append(policy(batch.signals()))
        batch.step(result[-1])
    return result


def same_weights(model: Any, other: Any) -> None:
    expected, result = model.policy.state_dict(), other.policy.state_dict()
    assert expected.keys() == result.keys()
    assert all(torch.equal(weight, result[key]) for key, weight in expected.items())


@pytest.mark.parametrize("carded", [True, False], ids=["card", "plain"])
@pytest.mark.parametrize("name", [n for n, of in MODELS.items() if "local" not in of.options])
@pytest.mark.usefixtures("no_unpickling")
def test_a_rebuilt_policy_decides_as_the_model_did(saved: Models, name: str, carded: bool) -> None:
    """The same weights, decisions and chances, and torch's and NumPy's random numbers stay."""
    agent = saved(name)
    path = agent.carded if carded else agent.plain
    before = streams()
    policy: Any = make_policy(f"model:{path}", agent.task)
    assert streams() == before
    assert type(policy.model) is type(agent.model)
    same_weights(agent.model, policy.model)
    chance: Any = make_policy(f"model:{path},deterministic=false", agent.task)
    for item in (policy, chance):
        other: Any = make_policy(f"model:{path}", agent.task)
        other.model, other.deterministic = agent.model, item.deterministic
        np.testing.assert_array_equal(*(decisions(each, agent.task) for each in (item, other)))
    assert 0.0 < np.mean(decisions(policy, agent.task)) < 1.0


def test_the_file_with_a_card_is_an_ordinary_one(saved: Models) -> None:
    agent = saved("ppo_discrete")
    again = PPO.load(agent.carded, device="cpu")
    same_weights(agent.model, again)
    card_entry = again.fusion_gym_model
    assert (card_entry["format"], card_entry["algorithm"]) == (1, "ppo")
    assert len(card_entry["observation_names"]) == again.observation_space.shape[0]


class Payload:
    """Writes a file as soon as it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.write_text, (self.mark, "code ran")


def repacked(path: Path, source: Path, **parts: bytes | None) -> Path:
    """A copy of an archive with other parts (dots in their names written as ``__``)."""
    changed = {name.replace("__", "."): content for name, content in parts.items()}
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(path, "w") as new:
        for name in {*old.namelist(), *changed}:
            content = changed[name] if name in changed else old.read(name)
            if content is not None:
                new.writestr(name, content)
    return path


def data_of(path: Path) -> dict[str, Any]:
    with zipfile.ZipFile(path) as packed:
        content: dict[str, Any] = json.loads(packed.read("data"))
    return content


def dumped(thing: Any, **options: Any) -> bytes:
    stream = io.BytesIO()
    torch.save(thing, stream, **options)
    return stream.getvalue()


def poisoned(data: dict[str, Any], payload: Payload) -> bytes:
    """The data with the payload in the place of all that is pickled, and in a new entry."""
    text = base64.b64encode(cloudpickle.dumps(payload)).decode()
    for entry in data.values():
        if isinstance(entry, dict) and ":serialized:" in entry:
            entry[":serialized:"] = text
    data["extra"] = {":type:": "<class 'dict'>", ":serialized:": text}
    return json.dumps(data).encode()


@pytest.mark.parametrize("carded", [True, False], ids=["card", "plain"])
@pytest.mark.parametrize(
    "part", ["data", "policy", "legacy", "script", "pickle", "variables", "optimizer"]
)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch.jit, which attackers still have
def test_a_crafted_file_runs_nothing(
    saved: Models, tmp_path: Path, part: str, carded: bool
) -> None:
    agent, mark = saved("ppo"), tmp_path / "mark"
    source, payload = agent.carded if carded else agent.plain, Payload(mark)
    script = io.BytesIO()
    torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), script)
    parts: dict[str, dict[str, bytes]] = {
        "data": {"data": poisoned(data_of(source), payload)},
        "policy": {"policy__pth": dumped({"action_net.weight": payload})},
        "legacy": {"policy__pth": dumped(payload, _use_new_zipfile_serialization=False)},
        "script": {"policy__pth": script.getvalue()},
        "pickle": {"policy__pth": pickle.dumps(payload)},
        "variables": {"pytorch_variables__pth": dumped(payload), "tensors__pth": dumped(payload)},
        "optimizer": {"policy__optimizer__pth": dumped(payload)},
    }
    path = repacked(tmp_path / "crafted.zip", source, **parts[part])
    if part in ("data", "variables", "optimizer"):
        same = (make_policy(f"model:{file}", agent.task) for file in (path, source))
        np.testing.assert_array_equal(*(decisions(policy, agent.task) for policy in same))
    else:
        refused_agent(path, agent.task, "--trust")
    refused_agent(f"{path},trust=true", agent.task, "unknown parameter")
    assert not mark.exists()
    if part == "data":  # the payload is a live one
        with pytest.raises(ConfigurationError):
            make_policy(f"model:{path}", agent.task, trust=True)
        assert mark.read_text() == "code ran"


class OwnPolicy(ActorCriticPolicy):
    """Code of a user's own."""


class OwnExtractor(FlattenExtractor):
    """Code of a user's own that has no weights."""

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return -super().forward(observations)


FOREIGN = Recipe(QRDQN, options=DISCRETE, arguments={"buffer_size": 10})


def with_policy(**kwargs: Any) -> Recipe:
    return Recipe(PPO, arguments={"policy_kwargs": kwargs})


@pytest.mark.parametrize("carded", [True, False], ids=["card", "plain"])
@pytest.mark.parametrize(
    ("recipe", "reason"),
    [
        (FOREIGN, "its policy belongs to none of"),
        (Recipe(PPO, OwnPolicy), "its policy belongs to none of"),
        (with_policy(features_extractor_class=OwnExtractor), "features_extractor_class"),
        (with_policy(activation_fn=torch.nn.Softplus), "Softplus"),
    ],
    ids=["algorithm", "policy", "extractor", "activation"],
)
def test_what_weights_do_not_make_needs_trust(
    tmp_path: Path, recipe: Recipe, reason: str, carded: bool
) -> None:
    model, task = recipe.build()
    if carded:
        tag_model(model, task)
    path = tmp_path / "model.zip"
    model.save(path)
    refused_agent(path, task, str(path), reason, "--trust")
    policy: Any = make_policy(f"model:{path}", task, trust=True)
    assert type(policy.model.policy) is type(model.policy)
    trust: Any = "yes"
    refused(lambda: make_policy(f"model:{path}", task, trust=trust), "trust = 'yes'")


def test_an_agent_of_a_range_of_token_rates_decides_in_this_range_only(tmp_path: Path) -> None:
    model, task = Recipe(PPO, options={"token_rate": (2.0, 6.0)}).build()
    tag_model(model, task)
    model.save(path := tmp_path / "model.zip")
    assert make_policy(f"model:{path}", task)
    for rate, reason in (((1.0, 6.0), "token_rate = (1.0, 6.0)"), (4.0, "['token_rate']")):
        refused_agent(path, fusion_gym.make_task(ENV, **OPTIONS, token_rate=rate), reason)


HEAD, FIRST = "action_net.weight", "mlp_extractor.policy_net.0.weight"
Parts = Callable[[Saved], tuple[Path, dict[str, bytes]]]


def weights(change: Callable[[dict[Any, Any]], Any]) -> Parts:
    """Other weights, in a file without a card."""

    def parts(agent: Saved) -> tuple[Path, dict[str, bytes]]:
        return agent.plain, {"policy__pth": dumped(change(agent.model.policy.state_dict()))}

    return parts


def entry(name: str, **entries: Any) -> Parts:
    """Other readable entries of Stable-Baselines3."""

    def parts(agent: Saved) -> tuple[Path, dict[str, bytes]]:
        data = data_of(agent.carded)
        data[name] |= entries
        return agent.carded, {"data": json.dumps(data).encode()}

    return parts


def card(**entries: Any) -> Parts:
    """Other entries of the card."""
    return entry("fusion_gym_model", **entries)


def network(**arguments: Any) -> Parts:
    """Other arguments of the policy's class, as the file declares them."""
    return entry("policy_kwargs", **arguments)


def compressed() -> bytes:
    """An archive of weights that are larger than they look."""
    inner = io.BytesIO()
    with zipfile.ZipFile(inner, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("archive/data.pkl", bytes(10**6))
    return inner.getvalue()


REFUSED: dict[str, tuple[Parts, str]] = {
    "missing": (weights(lambda w: {name: w[name] for name in w if name != HEAD}), "--trust"),
    "extra": (weights(lambda w: w | {"extra": torch.zeros(2, 2)}), "--trust"),
    "float64": (weights(lambda w: w | {HEAD: w[HEAD].double()}), "--trust"),
    "shape": (weights(lambda w: w | {HEAD: w[HEAD][:2]}), "--trust"),
    "sparse": (weights(lambda w: w | {HEAD: w[HEAD].to_sparse()}), "--trust"),
    "huge": (weights(lambda w: w | {HEAD: torch.zeros(1).expand(10**6, 10**6)}), "bytes"),
    "wide": (weights(lambda w: w | {FIRST: torch.zeros(1).expand(10**7, 1)}), "do not fit ppo"),
    "nan": (weights(lambda w: w | {HEAD: w[HEAD] * torch.nan}), "not finite"),
    "list": (weights(lambda w: [w]), "--trust"),
    "many": (weights(lambda w: dict.fromkeys(map(str, range(2000)), torch.zeros(1))), "--trust"),
    "compressed": (lambda a: (a.plain, {"policy__pth": compressed()}), "weights are compressed"),
    "no JSON": (lambda a: (a.carded, {"data": b"[" * 100_000}), "its data is not JSON"),
    "format": (card(format="1"), "format = '1'"),
    "algorithm": (card(algorithm="sac"), "its policy belongs to none of"),
    "another": (card(algorithm="dqn"), "--trust"),
    "activation": (network(activation_fn="sine"), "its activation is 'sine'"),
    "actions": (entry("action_space", n=4), "MultiBinary(4)"),
    "matrix": (entry("observation_space", _shape=[9, 6]), "its observation is not a vector"),
    "network": (network(net_arch={"pi": [64, 64], "vf": [64, 65]}), "do not fit ppo"),
    "words": (network(net_arch="a wide one"), "do not fit ppo"),
    "memory": (network(lstm_hidden_size=64), "do not fit ppo"),
    "huge network": (network(net_arch=[10**9] * 3), "do not fit ppo"),
    "endless network": (network(net_arch=[10**30]), "do not fit ppo"),
    "deep network": (network(net_arch=[1] * 2000), "more than 1000 layers"),
    "deep memory": (network(n_lstm_layers=10**9), "more than 1000 layers"),
    "names": (card(observation_names=["a", "b"]), "missing are ['a', 'b']"),
    "local": (card(local=True), "layout"),
    "price_range": (card(price_range=[1.0, 0.5]), "price_range"),
    "unknown": (card(extra=1), "unknown entry of the card 'extra'"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_weights_and_cards_of_no_such_policy_are_refused(
    saved: Models, tmp_path: Path, name: str
) -> None:
    make, reason = REFUSED[name]
    source, parts = make(saved("ppo"))
    path = repacked(tmp_path / "crafted.zip", source, **parts)
    refused_agent(path, saved("ppo").task, reason)


def test_files_that_hold_no_fitting_agent(saved: Models, tmp_path: Path) -> None:
    agent, text, empty = saved("ppo"), tmp_path / "notes.zip", tmp_path / "empty.zip"
    text.write_text("no model")
    with zipfile.ZipFile(empty, "w") as packed:
        packed.writestr("notes.txt", "no model")
    centre = fusion_gym.make_task(ENV, **OPTIONS, information="centre")
    for path, parts in (
        (tmp_path, ["no such file"]),
        (text, ["not a Stable-Baselines3 model"]),
        (empty, ["not a Stable-Baselines3 model (it has no data)"]),
        (agent.plain, ["layout", str(agent.model.observation_space.shape)]),
        (agent.carded, ["layout", "whitened_innovation[0,0]"]),
    ):
        refused_agent(path, centre, str(path), *parts)


def test_parts_larger_than_any_model_are_not_read(
    saved: Models, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent = saved("ppo")
    monkeypatch.setattr("fusion_gym.policies.saved.LARGEST", 10_000)
    refused_agent(agent.plain, agent.task, "its data has ", " bytes, more than 10000")


def test_a_damaged_file_is_refused_or_harmless(saved: Models, tmp_path: Path) -> None:
    """Cut short, or with bytes changed: one line, or a policy."""
    agent, path, stream = saved("ppo"), tmp_path / "damaged.zip", random.Random(0)
    whole = agent.carded.read_bytes()
    text = []
    for trial in range(40):
        content = bytearray(whole[: stream.randrange(len(whole))] if trial % 2 else whole)
        for _ in range(20):
            content[stream.randrange(len(content))] = stream.randrange(256)
        path.write_bytes(content)
        try:
            make_policy(f"model:{path}", agent.task)
        except ConfigurationError as error:
            text.append(str(error))
    assert len(text) > 20
    assert max(map(len, text)) < 600
    assert not any("\n" in line for line in text)


def test_commands_load_foreign_code_with_trust_alone(tmp_path: Path) -> None:
    model, _ = FOREIGN.build()
    policy = f"model:{tmp_path / 'model.zip'}"
    model.save(tmp_path / "model.zip")
    content: dict[str, Any] = {
        "environment": {"id": ENV, "options": OPTIONS},
        "algorithm": {"name": "ppo"},
        "training": {"timesteps": 64},
        "output": "unused",
    }
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(content))
    config = str(tmp_path / "config.yaml")
    compared = ["--config", config, "--policies", "never", policy]
    compared += ["--output", str(tmp_path / "comparison")]
    for command, arguments in (
        ("evaluate", ["--config", config, "--policies", policy]),
        ("compare", compared),
    ):
        words = [*arguments, "--episodes", "3"]
        assert "--trust" in refusal(command, words)
        succeed(command, [*words, "--trust"])


def test_evaluate_says_where_drawn_actions_do_otherwise(saved: Models) -> None:
    agent, rule = f"model:{saved('ppo').carded}", "innovation_threshold"
    words = ["--env", ENV, "--set", "filter=tobit", "horizon=20", "--episodes", "40", "--policies"]
    message = f"{agent},deterministic=false evaluates them"
    ended = succeed("evaluate", [*words, agent, rule])
    assert ended.err.count("drawn actions change the return") == 1
    assert message in ended.err
    assert message not in succeed("evaluate", [*words, f"{agent},deterministic=false"]).err
