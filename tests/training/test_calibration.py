"""Agents calibrated with a rule: both ends of the mixture, the choice, and the file."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_runs import refusal, succeed
from sb3_contrib import MaskablePPO
from stable_baselines3 import DQN, PPO
from training_configs import small_config

import fusion_gym
from fusion_gym import seeds
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.task import Task
from fusion_gym.evaluation.episodes import run_episodes, run_priced
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.saved import (
    CalibratedPolicy,
    CalibrationPoint,
    ModelPolicy,
    ModelView,
    agent_files,
    read_calibration,
    save_calibrated,
    tag_model,
)
from fusion_gym.training.calibration import _choice, calibrate, fit_slopes
from fusion_gym.training.config import Experiment, load_checked
from fusion_gym.training.run import train
from fusion_gym.validation import ConfigurationError

LINEAR = "fusion_gym/LinearFusion-v2"
OPTIONS: dict[str, Any] = {
    "horizon": 25, "memory": True, "cost_weight": "random", "price_range": (0.05, 2.0),
    "reward_scale": None,
}  # fmt: skip
RULE = "priced_threshold:own={own},reference_price=0.3,threshold=0.2,margin={margin}"


def made(kind: Any = PPO, local: bool = False, **options: Any) -> tuple[Task, ModelPolicy, Any]:
    """A task, an untrained agent and a rule of the same class."""
    task = fusion_gym.make_task(LINEAR, **OPTIONS | options)
    envs = fusion_gym.make_sb3_vec_env(LINEAR, 2, local=local, **OPTIONS | options)
    model = kind("MlpPolicy", envs, seed=3)
    tag_model(model, task, local)
    own, margin = ("true", 1) if local else ("false", 1.7)
    rule = make_policy(RULE.format(own=own, margin=margin), task)
    return task, ModelPolicy(model, task, trained=ModelView(local=local)), rule


@pytest.fixture(scope="module")
def parts() -> tuple[Task, ModelPolicy, Any]:
    """A task, an untrained agent and a rule, of a scheduler."""
    return made()


def requests(task: Task, policy: Any, episodes: int = 30) -> Any:
    return run_episodes(task, policy, episodes, 0)


KINDS: list[tuple[Any, bool, dict[str, Any]]] = [
    (PPO, False, {}),
    (PPO, True, {}),
    (PPO, True, {"memory": False}),
    (PPO, False, {"access": "single"}),
    (MaskablePPO, False, {}),
]


@pytest.mark.parametrize(("kind", "local", "options"), KINDS)
def test_the_ends_of_the_mixture_are_the_rule_and_the_agent(
    kind: Any, local: bool, options: dict[str, Any]
) -> None:
    """The rule bit by bit, with its margin; the agent by its likeliest action."""
    task, agent, rule = made(kind, local, **options)
    for mixture, end in ((1.0, rule), (0.0, agent)):
        point = CalibrationPoint(0.3, 0, mixture, 0.0)
        ours = requests(task, CalibratedPolicy(task, [agent], [0.7], rule, [point]))
        theirs = requests(task, end)
        np.testing.assert_array_equal(ours.returns, theirs.returns)
        if kind is PPO and not options:
            np.testing.assert_array_equal(ours.requests, theirs.requests)
            assert 0.0 < ours.requests.mean() < 1.0


def test_between_two_prices_the_numbers_are_linear_in_the_logarithm(parts: Any) -> None:
    task, agent, rule = parts
    points = [CalibrationPoint(0.1, 0, 0.5, -0.3), CalibrationPoint(1.6, 1, 1.0, 0.1)]
    policy = CalibratedPolicy(task, [agent, agent], [1.0, 2.0], rule, points)
    number, mixture, threshold = policy.at(np.array([0.01, 0.2, 0.4, 0.8, 9.0]))
    np.testing.assert_allclose(mixture, [0.5, 0.625, 0.75, 0.875, 1.0])
    np.testing.assert_allclose(threshold, [-0.3, -0.2, -0.1, 0.0, 0.1], atol=1e-12)
    assert [*number[:2], *number[3:]] == [0, 0, 1, 1]


def test_the_slope_is_the_regression_of_logits_on_log_ratios(parts: Any) -> None:
    task, agent, rule = parts
    slopes = fit_slopes(CalibratedPolicy(task, [agent], (), rule, ()), [0.3], 30)
    batch, samples = EpisodeBatch.seeded(task, 30, seeds.CALIBRATION.start), []
    batch.price = np.full(30, 0.3)
    for _ in range(task.horizon):
        signals = batch.signals()
        samples.append([rule.log_ratio(signals), agent.logits(signals)])
        batch.step(rule(signals))
    z, logit = np.array(samples).swapaxes(0, 1).reshape(2, -1)
    some = np.isfinite(z)
    slope = np.polyfit(z[some], logit[some], 1)[0]
    spread = logit[some].std() / z[some].std()
    assert slopes == pytest.approx([slope if slope > 0.0 else spread])


def saved(agent: ModelPolicy, folder: Path) -> Path:
    agent.model.save(folder / "agent.zip")
    return folder / "agent.zip"


@pytest.mark.slow
def test_a_hopeless_agent_leaves_the_rule_and_a_bad_rule_is_mended(
    tmp_path: Path, parts: Any
) -> None:
    """At fresh episodes a rule that sends far too often is cheaper by a higher threshold."""
    task, agent, _ = parts
    prices, episodes, output = (0.05, 0.3, 2.0), (8, 100), tmp_path / "policy.zip"
    files = [saved(agent, tmp_path)]
    rows = calibrate(task, files, prices, episodes, output)
    assert all(row.cost <= row.rule_cost for row in rows)
    assert all(row.point.mixture == 1.0 for row in rows)
    bad = RULE.format(own="false", margin=1).replace("0.2", "0.02")
    rows = calibrate(task, files, prices, episodes, output, bad)
    assert any(row.point.threshold > 0.0 for row in rows)
    seeds, every = np.tile(np.arange(200), 3), np.repeat(prices, 200)
    ours, theirs = (
        run_priced(task, make_policy(text, task), seeds, every).cost(every).mean()
        for text in (f"model:{output}", bad)
    )
    assert ours < 0.97 * theirs


def test_of_several_agents_a_price_has_the_best(tmp_path: Path, parts: Any) -> None:
    task, agent, _ = parts
    files, output = [saved(agent, tmp_path)] * 2, tmp_path / "policy.zip"
    text = RULE.format(own="false", margin=1)
    rows = calibrate(task, files, (0.05, 2.0), (4, 20), output, text)
    policy: Any = make_policy(f"model:{output}", task)
    assert policy.points == [row.point for row in rows]
    assert {point.agent for point in policy.points} <= {0, 1}


@pytest.mark.parametrize("rule", ["os:system", "always", "priced_threshold_other:threshold=1"])
def test_a_rule_of_another_kind_is_refused(tmp_path: Path, rule: str, parts: Any) -> None:
    task, agent, _ = parts
    with pytest.raises(ConfigurationError, match=r"rule = .* must be a priced_threshold"):
        calibrate(task, [saved(agent, tmp_path)], (0.05, 2.0), (2, 4), tmp_path / "o.zip", rule)


def test_a_file_is_the_policy(tmp_path: Path, parts: Any) -> None:
    task, agent, rule = parts
    points = [CalibrationPoint(0.05, 0, 0.0, -0.2), CalibrationPoint(2.0, 0, 0.5, 0.1)]
    policy = CalibratedPolicy(task, [agent], [0.3], rule, points)
    text = RULE.format(own="false", margin=1.7)
    save_calibrated(text, [0.3], points, [saved(agent, tmp_path)], tmp_path / "policy.zip")
    again = make_policy(f"model:{tmp_path / 'policy.zip'}", task)
    np.testing.assert_array_equal(requests(task, again).returns, requests(task, policy).returns)
    fixed = fusion_gym.make_task(LINEAR, **OPTIONS | {"cost_weight": 0.4, "price_range": None})
    priced = make_policy(f"model:{tmp_path / 'policy.zip'},price=0.4", fixed)
    prices = np.full(30, 0.4)
    theirs = run_priced(task, policy, np.arange(30), prices)
    np.testing.assert_allclose(requests(fixed, priced).tokens, theirs.tokens)
    (tmp_path / "policy.zip").write_bytes((tmp_path / "policy.zip").read_bytes()[:-40])
    with pytest.raises(ConfigurationError, match=r"model .* is not allowed"):
        make_policy(f"model:{tmp_path / 'policy.zip'}", task)


def test_without_its_calibration_a_file_is_the_agent(tmp_path: Path, parts: Any) -> None:
    task, agent, _ = parts
    text, file = RULE.format(own="false", margin=1.7), saved(agent, tmp_path)
    point, output = CalibrationPoint(0.3, 0, 1.0, 0.0), tmp_path / "policy.zip"
    save_calibrated(text, [0.3], [point], [file], output)
    for settings in ("", ",deterministic=false"):
        alone = make_policy(f"model:{output},calibrated=false{settings}", task)
        theirs = requests(task, make_policy(f"model:{file}{settings}", task)).returns
        np.testing.assert_array_equal(requests(task, alone).returns, theirs)
    with pytest.raises(ConfigurationError, match="deterministic = False is not allowed"):
        make_policy(f"model:{output},deterministic=false", task)
    save_calibrated(text, [0.3, 0.3], [point], [file, file], output)
    with pytest.raises(ConfigurationError, match="price = None is not allowed"):
        make_policy(f"model:{output},calibrated=false", task)
    files = agent_files(output, tmp_path)
    assert [path.read_bytes() for path in files] == [file.read_bytes()] * 2
    assert agent_files(file, tmp_path) == [file]
    content = output.read_bytes()
    save_calibrated(text, [0.3, 0.3], [point], [file, file], output)
    assert output.read_bytes() == content


def test_an_evaluation_draws_no_actions_of_a_calibrated_policy(tmp_path: Path, parts: Any) -> None:
    task, agent, _ = parts
    text, output = RULE.format(own="false", margin=1.7), tmp_path / "policy.zip"
    point = CalibrationPoint(0.3, 0, 0.5, 0.0)
    save_calibrated(text, [0.3], [point], [saved(agent, tmp_path)], output)
    options = [f"{name}={value}" for name, value in OPTIONS.items() if value is not None]
    words = ["--env", LINEAR, "--set", *(word.replace(" ", "") for word in options)]
    words += ["reward_scale=null", "--episodes", "3", "--policies", f"model:{output}"]
    succeed("evaluate", [*words, "--json", str(tmp_path / "evaluation.json")])
    assert requests(task, make_policy(f"model:{output}", task)).episodes == 30


POINT = {"price": 0.3, "agent": 0, "mixture": 0.0, "threshold": 0.0}


@pytest.mark.parametrize(
    "content", ["[1]", "{}", '{"slopes": 1}', "no JSON", "[" * 100_000, '{"a": 1}'], ids=range(6)
)
def test_agents_of_a_file_with_other_content_are_refused(tmp_path: Path, content: str) -> None:
    with zipfile.ZipFile(tmp_path / "policy.zip", "w") as archive:
        archive.writestr("calibration.json", content)
    with pytest.raises(ConfigurationError, match=r"is not|unknown entry of calibration\.json"):
        agent_files(tmp_path / "policy.zip", tmp_path)


@pytest.mark.parametrize(
    "content",
    [
        {"points": []},
        {"points": [POINT, POINT]},
        {"points": [POINT | {"agent": 1}]},
        {"points": [POINT | {"threshold": float("nan")}]},
        {"points": [POINT | {"price": 10**400}]},
        {"points": [POINT | {"price": "0.3"}]},
        {"points": [POINT | {"price": -1.0}]},
        {"points": [POINT | {"mixture": 7.0}]},
        {"points": 3},
        {"slopes": ["1.0"]},
        {"points": [{"price": 0.3}]},
        {"slopes": []},
        {"slopes": [-1.0]},
        {"rule": "os:system"},
    ],
)
def test_a_file_with_other_content_is_refused(tmp_path: Path, content: Any, parts: Any) -> None:
    """In one line, and no rule of a file runs code."""
    task, agent, _ = parts
    right = {"points": [POINT], "slopes": [1.0], "rule": RULE.format(own="false", margin=1)}
    with zipfile.ZipFile(tmp_path / "policy.zip", "w") as archive:
        archive.writestr("calibration.json", json.dumps(right | content))
        archive.write(saved(agent, tmp_path), "agent_0.zip")
    with pytest.raises(
        ConfigurationError, match=r"model .* is not allowed: \w+ = .* is not allowed: it must be"
    ) as caught:
        make_policy(f"model:{tmp_path / 'policy.zip'}", task)
    assert "\n" not in str(caught.value)


def test_agents_without_a_logit_a_sensor_are_refused(parts: Any) -> None:
    task, _, rule = parts
    for kind in (DQN, PPO):
        envs = fusion_gym.make_sb3_vec_env(LINEAR, 2, **OPTIONS, action="discrete")
        discrete = fusion_gym.make_task(LINEAR, **OPTIONS, action="discrete")
        agent = ModelPolicy(kind("MlpPolicy", envs, seed=0), discrete)
        with pytest.raises(ConfigurationError, match="is not allowed: it must be"):
            CalibratedPolicy(task, [agent], [1.0], rule, [CalibrationPoint(0.3, 0, 0.0, 0.0)])


def trained(folder: Path, kind: str = "ppo", quiet: bool = True, **options: Any) -> Path:
    """The file that a short training at drawn prices may calibrate."""
    options = OPTIONS | {"price_range": [0.05, 2.0]} | options
    changes = {
        "environment": {"id": LINEAR, "options": options},
        "calibration": {"episodes": [2, 8]},
    }
    experiment = load_checked(Experiment, small_config(folder, kind, **changes))
    train(experiment, quiet=quiet)
    return folder / "run" / "calibrated_model.zip"


def test_a_training_ends_with_a_calibrated_model(tmp_path: Path) -> None:
    file, task = trained(tmp_path), fusion_gym.make_task(LINEAR, **OPTIONS)
    policy: Any = make_policy(f"model:{file}", task)
    assert [point.price for point in policy.points] == pytest.approx(np.geomspace(0.05, 2.0, 5))


@pytest.mark.parametrize("quiet", [False, True])
def test_a_training_without_a_logit_a_sensor_tells_so(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], quiet: bool
) -> None:
    assert not trained(tmp_path, "dqn", quiet, action="discrete").exists()
    assert ("no calibrated model: policy = 'DQN'" in capfd.readouterr().err) is not quiet


def test_a_failed_calibration_ends_the_training_with_its_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise ConfigurationError("a failure")

    monkeypatch.setattr("fusion_gym.training.calibration.calibrate", fail)
    with pytest.raises(ConfigurationError, match="a failure"):
        trained(tmp_path)


ONE_PRICE: list[dict[str, Any]] = [
    {"local": True},
    {"local": False, "options": {"information": "centre"}},
    {"local": False},
]


@pytest.mark.slow
@pytest.mark.parametrize("environment", ONE_PRICE, ids=["local", "centre", "scheduler"])
def test_a_silent_agent_of_one_price_is_calibrated_by_the_lines_that_a_user_types(
    environment: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Train, calibrate, evaluate, compare and export; the agent is silenced after its training."""
    monkeypatch.chdir(tmp_path)
    local, options = environment["local"], environment.get("options", {})
    options = {"horizon": 25, "cost_weight": 0.3, **options}
    entries = {"id": LINEAR, "options": options, "local": local}
    config = str(small_config(tmp_path, environment=entries, output="run"))
    succeed("train", ["--config", config])
    model = PPO.load("run/best_model.zip")
    with torch.no_grad():
        model.policy.action_net.bias.add_(torch.tensor([9.0, -9.0]) if local else -9.0)
    model.save("run/best_model.zip")
    config, agent = "run/config.yaml", "model:run/best_model.zip"
    words = ["--config", config, "--policy", agent, "--episodes", "40"]
    assert "0.3" in succeed("calibrate", [*words, "--output", "run/calibrated.zip"]).out
    rule, slopes, (point,) = read_calibration(Path("run/calibrated.zip"))
    assert point.price == 0.3
    names = [agent, "model:run/calibrated.zip", rule]
    words = ["--config", config, "--policies", *names]
    succeed("evaluate", [*words, "--episodes", "200", "--json", "e.json"])
    results = json.loads(Path("e.json").read_text())["policies"]
    silent, ours, ruled = (results[name]["return"]["mean"] for name in names)
    assert results[agent]["tokens"]["mean"] == 0.0 < results[names[1]]["tokens"]["mean"]
    assert ours > silent
    assert ours >= ruled - 0.01 * abs(ruled)
    succeed("compare", [*words, "--episodes", "4", "--output", "compared"])
    again = [CalibrationPoint(0.3, 0, 0.0, -99.0)]
    save_calibrated(rule, slopes, again, [Path("run/best_model.zip")], Path("run/shifted.zip"))
    assert "all decisions agree" in succeed("export", ["run/shifted.zip", "--onnx", "a.onnx"]).out


@pytest.mark.parametrize("local", [True, False])
def test_at_one_price_the_calibration_is_the_best_of_agent_shifted_agent_and_rule(
    local: bool, tmp_path: Path
) -> None:
    """A rule that never sends is left, a good rule stays."""
    never = RULE.format(own=str(local).lower(), margin=1).replace("0.2", "1e9")
    for price, rule in ((0.02, never), (0.3, None)):
        task, agent, _ = made(local=local, cost_weight=price, price_range=None)
        files, output = [saved(agent, tmp_path)], tmp_path / "policy.zip"
        (row,) = calibrate(task, files, (price,), (4, 40), output, rule)
        assert row.cost <= min(row.rule_cost, row.agent_cost)
        assert (row.point.mixture < 1.0) is (rule is not None)
        assert rule is None or row.cost < row.rule_cost


WRONG_PRICES: list[tuple[list[str], str]] = [
    (["cost_weight=0"], "cost_weight = 0.0 is not allowed: it must be a positive price"),
    (["cost_weight=0.3", "--prices", "3"], "prices = 3 is not allowed at one price"),
    (["cost_weight=random"], "price_range"),
]


@pytest.mark.parametrize(("words", "message"), WRONG_PRICES)
def test_a_calibration_without_prices_is_refused(
    words: list[str], message: str, tmp_path: Path
) -> None:
    output = ["--policy", "zoo:nobody", "--output", str(tmp_path / "o.zip")]
    assert message in refusal("calibrate", ["--env", LINEAR, "--set", *words, *output])


@pytest.mark.parametrize("threshold", [-0.4, 0.6])
def test_a_mixture_weighs_the_logit_over_its_slope_and_the_log_ratio(
    threshold: float, parts: Any
) -> None:
    task, agent, rule = parts
    point = CalibrationPoint(0.3, 0, 0.3, threshold)
    policy = CalibratedPolicy(task, [agent], [0.2], rule, [point])
    batch = EpisodeBatch.seeded(task, 200, 0)
    for _ in range(6):
        signals = batch.signals()
        z, logit = rule.log_ratio(signals), agent.logits(signals)
        expected = 0.7 * logit / 0.2 + 0.3 * z >= threshold
        np.testing.assert_array_equal(policy(signals), expected)
        assert 0.0 < expected.mean() < 1.0
        batch.step(expected)


@pytest.mark.parametrize(("gain", "chosen"), [(0.1, 0.0), (0.3, 0.8)])
def test_the_rule_stays_within_two_standard_errors(gain: float, chosen: float) -> None:
    """A hundred episodes whose difference has the deviation 1, so a standard error of .1."""
    noise = np.random.default_rng(0).normal(size=100)
    noise = (noise - noise.mean()) / noise.std(ddof=1)
    candidates = [(0, 1.0, 0.0), (0, 0.0, 0.0), (0, 0.5, 0.8)]
    costs = np.array([np.full(100, 5.0), np.full(100, 7.0), 5.0 - gain + noise])
    row = _choice(0.3, candidates, costs, 1)
    assert (row.point.threshold, row.rule_cost, row.agent_cost) == (chosen, 5.0, 7.0)
    assert row.cost == pytest.approx(5.0 - gain if chosen else 5.0)


@pytest.mark.parametrize(("kind", "local", "options"), KINDS)
def test_an_agent_without_the_rule_has_its_threshold_in_its_network(
    kind: Any, local: bool, options: dict[str, Any]
) -> None:
    _, agent, rule = made(kind, local, **options)
    fixed = fusion_gym.make_task(
        LINEAR, **OPTIONS | options | {"cost_weight": 0.3, "price_range": None}
    )
    own = ModelPolicy(agent.model, fixed, price=0.3, trained=ModelView(None, local, (0.05, 2.0)))
    points = [CalibrationPoint(0.3, 0, 0.0, 0.4)]
    policy = CalibratedPolicy(fixed, [own], [0.2], rule, points, 0.3)
    single = policy.single_agent()
    ours, theirs = (requests(fixed, item).returns for item in (single, policy))
    np.testing.assert_allclose(ours, theirs, rtol=1e-12)
    assert (ours != requests(fixed, own).returns).any()
    mixed = CalibratedPolicy(fixed, [own], [0.2], rule, [CalibrationPoint(0.3, 0, 0.5, 0.4)], 0.3)
    with pytest.raises(ConfigurationError, match=r"mixture = 0.5 is not allowed: .* rule reads"):
        mixed.single_agent()
