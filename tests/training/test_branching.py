"""Branches over a window: their costs, the start at a rule, the saved file, errors."""

import copy
import json
import os
import signal
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from small_runs import meaning
from stable_baselines3.common.callbacks import BaseCallback
from training_configs import read_records

import fusion_gym
from fusion_gym.core.memory import Memory
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.runs import Branch
from fusion_gym.envs.views import LARGEST_RATIO
from fusion_gym.evaluation.episodes import run_priced
from fusion_gym.evaluation.onnx_export import export_onnx
from fusion_gym.policies.saved import ModelPolicy, ModelView, tag_model
from fusion_gym.training.branching import Branches, BranchingPPO, RuleVecEnv, changes_of
from fusion_gym.validation import ConfigurationError

VALUE = "priced_threshold:score=value,threshold=0.03,reference_price=0.02"
TOBIT = {"filter": "tobit", "token_rate": 2.0, "horizon": 12}
MEMORY = TOBIT | {"memory": True}
PRICED = {"cost_weight": "random", "price_range": (0.02, 0.5)}
# Options, whether sensors decide locally, and a rule of the agent's knowledge.
CASES: dict[str, tuple[dict[str, Any], bool, str]] = {
    "scheduler": (MEMORY, False, f"{VALUE},margin=5"),
    "local": (MEMORY, True, f"{VALUE},own=true"),
    "centre": (TOBIT | {"information": "centre"}, False, "priced_threshold:score=variance"),
    "single": (MEMORY | {"access": "single"}, False, VALUE),
}
PRICES = 0.02, 0.1, 0.5


def env_of(case: str, runs: int = 6, **more: Any) -> RuleVecEnv:
    options, local, rule = CASES[case]
    task = fusion_gym.make_task("fusion_gym/TobitOscillator-v1", **options, **PRICED, **more)
    return RuleVecEnv(task, runs, local=local, rule=rule, prices=PRICES)


def config(folder: Path, case: str = "scheduler", **more: Any) -> fusion_gym.Experiment:
    options, local, rule = CASES[case]
    content: dict[str, Any] = {
        "environment": {
            "id": "fusion_gym/TobitOscillator-v1", "options": options | PRICED, "local": local,
        },
        "algorithm": {"name": "branching_ppo", "rule": rule},
        "training": {"timesteps": 2000, "num_envs": 8},
        "validation": {"every": 500, "episodes": 10},
        "calibration": None,
        "output": str(folder),
    }  # fmt: skip
    for part, changes in more.items():
        content[part] = content[part] | changes if isinstance(changes, dict) else changes
    return fusion_gym.Experiment.model_validate(content)


@pytest.mark.parametrize("case", CASES)
def test_the_cost_of_a_set_is_that_of_a_simulation(
    case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """NumPy runs each set and then silence, on the same noise, up to the critic or the end."""
    env = env_of(case)
    monkeypatch.setattr(Branches, "windows", lambda _, price: np.where(price < 0.1, 3, 5))
    branches, drawn = Branches(env, 2.0, 0), []
    normals = branches._normals
    monkeypatch.setattr(branches, "_normals", lambda *a: drawn.append(normals(*a)) or drawn[-1])
    position, states = copy.deepcopy(branches.step.moved(branches.rows))
    price, left = branches.price.copy(), branches.left.copy()
    window = branches.windows(price)
    assert (left < window).any()
    assert (left > window).any()
    assert {*window} == {3, 5}
    decisions = branches.decide(
        lambda rows: torch.full((len(rows), 3), -60.0), lambda rows: torch.full((len(rows),), 0.3)
    )
    costs = []
    for requests in branches.changes:
        memory = Memory(env.task, env.owner).with_states(states)
        runs = Branch(env.task, memory, ObservationLayout(env.task, env.owner), position)
        cost, goes_on = np.zeros(6), np.ones(6, np.bool_)
        for step in range(5):
            sent = np.repeat(requests[:, None], 6, axis=1) & (step == 0)
            outcome = runs.step(sent, drawn[step])
            cost += (goes_on & (step < window)) * (price * outcome.cost - outcome.reward_error)
            goes_on = goes_on & (step + 1 < left)
        later = np.where(left > window, 10.0 * 0.3 + left - window, 0.0)
        costs.append(cost / branches.unit(price) + later)
    expected = costs[0] - np.array(costs)  # the policy's mean is silence
    np.testing.assert_allclose(decisions.advantages.T, expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(decisions.values, (costs[0] - left) / 10.0, rtol=1e-4, atol=1e-5)
    assert np.abs(expected).max() > 0.1


def test_runs_go_on_in_a_branch_or_begin_again() -> None:
    """A run continues within its window, and after its end with a new episode and price."""
    branches = Branches(env_of("scheduler", 200), 2.0, 0)
    longest = branches.windows(np.array(PRICES)).max()
    for _ in range(3):
        left, price = branches.left.copy(), branches.price.copy()
        branches.decide(
            lambda rows: torch.zeros((len(rows), 3)), lambda rows: torch.zeros(len(rows))
        )
        moved = left - branches.left
        begun = branches.left == 12
        assert begun.any()
        assert {1, 2, 3} < {*moved[~begun]} <= {*range(1, longest + 1)}
        assert (branches.price[~begun] == price[~begun]).all()
        position = branches.step.moved(branches.rows)[0]
        np.testing.assert_array_equal(position.limit - position.steps, branches.left)
        often = np.isin(branches.price, PRICES).mean()
        assert 0.45 < often < 0.75


@pytest.mark.parametrize("case", CASES)
def test_an_untrained_agent_has_three_times_the_log_ratios_of_its_rule(case: str) -> None:
    env = env_of(case)
    _, local, rule = CASES[case]
    model = BranchingPPO("MlpPolicy", env, policy_kwargs=SILU)
    agent = ModelPolicy(model, env.task, trained=ModelView(local=local, rule=rule))
    env.seed(0)
    env.reset()
    for _ in range(12):
        signals = env.batch.signals()
        ratio = agent.rule.log_ratio(signals)  # type: ignore[union-attr]
        expected = 3.0 * np.clip(ratio, -6.0, 6.0)
        np.testing.assert_allclose(agent.logits(signals), expected, rtol=1e-4, atol=1e-4)
        env.step(env.view.action.actions(ratio > 0.0))


SILU = {"net_arch": [16, 16], "activation_fn": torch.nn.SiLU, "ortho_init": False}


@pytest.mark.parametrize("case", CASES)
def test_a_trained_agent_is_a_file_like_any_other(case: str, tmp_path: Path) -> None:
    experiment = config(tmp_path / "run", case, environment={"options": CASES[case][0] | PRICED})
    assert fusion_gym.train(experiment, quiet=True)["finished"]
    file, local = tmp_path / "run" / "final_model.zip", CASES[case][1]
    task = fusion_gym.make_task(experiment.environment.id, **experiment.environment.options)
    agent: Any = fusion_gym.make_policy(f"model:{file}", task)
    assert agent.view.local == local
    assert agent.rule is not None
    each, seeds = np.repeat(PRICES, 3), np.arange(9)
    means = run_priced(task, agent, seeds, each)
    fixed = fusion_gym.make_policy(f"model:{file},price=0.1", task)
    same = run_priced(task, fixed, seeds, np.full(9, 0.1))
    np.testing.assert_array_equal(means.cost(each)[3:6], same.cost(0.1)[3:6])
    rest = fusion_gym.evaluation.run_episodes(task, agent, 3, seed=0)
    assert np.isfinite(rest.returns).all()
    for policy, priced in ((agent, 1), (fixed, 0)):
        file = tmp_path / f"agent{priced}.onnx"
        export_onnx(policy, task, file, experiment.environment.id)
        texts = {item.key: item.value for item in onnx.load(file).metadata_props}
        names, ratios = json.loads(texts["observation_names"]), task.sensors if not local else 1
        assert names[-ratios:] == [f"log_ratio[{place}]" for place in range(ratios)]
        assert ("price" in names) == priced
        assert json.loads(texts["observation_high"])[-1] == LARGEST_RATIO
        assert agent.rule_text in texts["observation_blocks"]


def test_a_file_names_no_policy_that_may_run_code(tmp_path: Path) -> None:
    env = env_of("scheduler")
    model = BranchingPPO("MlpPolicy", env, policy_kwargs=SILU)
    tag_model(model, env.task, rule="model:other.zip")
    model.save(tmp_path / "agent.zip")
    with pytest.raises(ConfigurationError, match="rule = 'model:other"):
        fusion_gym.make_policy(f"model:{tmp_path / 'agent.zip'}", env.task)


@pytest.mark.slow
def test_learning_repairs_a_rule_that_sends_too_little(tmp_path: Path) -> None:
    """The last validation costs less than the first one, in which only the critic had learned."""
    rule = "priced_threshold:score=value,threshold=0.6,reference_price=0.02"
    experiment = config(
        tmp_path / "run", algorithm={"rule": rule, "learning_rate": 3e-3},
        training={"timesteps": 150_000, "num_envs": 32},
        validation={"every": 5_000, "episodes": 200},
    )  # fmt: skip
    fusion_gym.train(experiment, quiet=True)
    costs = [record["relative_cost"] for record in read_records(tmp_path / "run")]
    assert costs[-1] < 0.8 * costs[0]


class Stop(BaseCallback):
    """Ctrl-C in a rollout."""

    def _on_step(self) -> bool:
        if self.n_calls == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return True


def test_a_resumed_training_is_the_uninterrupted_one(tmp_path: Path) -> None:
    whole, parts = (config(tmp_path / name) for name in ("whole", "parts"))
    fusion_gym.train(whole, quiet=True)
    assert not fusion_gym.train(parts, quiet=True, callbacks=[Stop()])["finished"]
    fusion_gym.train(parts, quiet=True, resume=True)
    assert meaning(Path(parts.output)) == meaning(Path(whole.output))


ERRORS: list[tuple[dict[str, Any], str]] = [
    ({"algorithm": {"rule": "always"}}, "rule = 'always'"),
    ({"algorithm": {"rule": VALUE}, "environment": {"options": CASES["centre"][0]}}, "value"),
    ({"algorithm": {"network": {"hidden": (4,), "activation": "silu"}}}, r"hidden = \[4\]"),
    ({"training": {"error": "mismatch"}}, "error = 'mismatch'"),
    ({"training": {"price_exponent": 0.5}}, "price_exponent = 0.5"),
    ({"environment": {"options": MEMORY | {"delay": 0.5}}}, "delay"),
    ({"environment": {"options": MEMORY | {"action": "discrete"}}}, "action = 'discrete'"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), ERRORS)
def test_what_cannot_branch_is_one_error(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigurationError, match=message):
        fusion_gym.train(config(tmp_path / "run", **changes), quiet=True)
    assert not (tmp_path / "run").exists()


def test_sets_change_all_requests_of_few_sensors_and_at_most_two_of_many() -> None:
    assert {tuple(own) for own in changes_of(3, True)} == {*product((False, True), repeat=3)}
    assert len(changes_of(10, True)) == 1 + 10 + 45
    assert changes_of(10, True).sum(1).max() == 2
    np.testing.assert_array_equal(changes_of(40, False), np.eye(41, 40, -1, dtype=np.bool_))


def test_too_many_sensors_are_one_error() -> None:
    task = fusion_gym.make_task("fusion_gym/RemoteEstimation-v1", sources=(12, 0), horizon=8)
    env = RuleVecEnv(task, 4, rule="priced_threshold", prices=(1.0,))
    with pytest.raises(ConfigurationError, match=r"sensors = 12 .* 79 sets"):
        Branches(env, 1.0, 0)
