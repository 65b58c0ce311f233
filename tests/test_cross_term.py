"""Error, floor, mismatch and cross term: what they are, the command, a training's warning."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from training_configs import small_config

from fusion_gym.core.estimator import Estimator
from fusion_gym.envs.privileged import PrivilegedVecEnv, reference_estimator
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation import cross_term
from fusion_gym.evaluation.cross_term import CrossTerm, cross_terms, usual_policies, worst
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.evaluation.intervals import Interval
from fusion_gym.policies.registry import make_policy
from fusion_gym.training.checked import load_checked
from fusion_gym.training.config import Experiment
from fusion_gym.training.models import make_env
from fusion_gym.training.run import train

OSCILLATOR, INPUT = "fusion_gym/TobitOscillator-v1", "fusion_gym/UnknownInput-v1"
ORDINARY = {"filter": "tobit", "random_start": True, "token_rate": 2, "horizon": 30}
PAPER = ORDINARY | {"filter": "paper"}


def measured(
    env_id: str, options: dict[str, Any], policies: list[str], filter: str | None = None,
    episodes: int = 60, seed: int = 0,
) -> dict[str, CrossTerm]:  # fmt: skip
    task = make_task(env_id, **options)
    built = {name: make_policy(name, task) for name in policies}
    return cross_terms(task, reference_estimator(env_id, options, filter), built, episodes, seed)


def test_error_and_floor_are_what_an_evaluation_finds_and_the_parts_add_up() -> None:
    """Independent of how they are measured: the error is the policy's MSE, the floor that of a
    centre to which everything is delivered."""
    result = measured(OSCILLATOR, ORDINARY, ["random:rate=0.2"])["random:rate=0.2"]
    task = make_task(OSCILLATOR, **ORDINARY)
    policy = run_episodes(task, make_policy("random:rate=0.2", task), 60, 0)
    free = make_task(OSCILLATOR, **ORDINARY, tokens="unlimited")
    everything = run_episodes(free, make_policy("always", free), 60, 0)
    assert result.error == pytest.approx(float(policy.mse.mean()))
    assert result.rate == pytest.approx(float(policy.rate.mean()))
    assert result.floor == pytest.approx(float(everything.mse.mean()))
    parts = result.floor + result.mismatch + result.share.mean * result.error
    assert parts == pytest.approx(result.error)
    assert result.share.low < result.share.mean < result.share.high


def test_the_weights_are_the_rewards() -> None:
    task = make_task(OSCILLATOR, **ORDINARY, state_weights=[2.0, 0.0])
    reference = reference_estimator(OSCILLATOR, ORDINARY)
    requests = cross_terms(task, reference, {"a": make_policy("always", task)}, 20, 0)["a"]
    results = run_episodes(task, make_policy("always", task), 20, 0)
    assert requests.error == pytest.approx(2.0 * float(results.squared_error[:, 0].mean()))


@pytest.mark.parametrize(
    ("env_id", "options", "filter", "share"),
    [
        (OSCILLATOR, PAPER, "paper", -0.18),
        (INPUT, {"tokens": "limited", "token_rate": 2, "horizon": 60}, None, -0.13),
    ],
)
def test_where_the_filter_is_approximate_the_cross_term_is_reported(
    env_id: str, options: dict[str, Any], filter: str | None, share: float
) -> None:
    result = measured(env_id, options, ["always"], filter, episodes=150)["always"]
    assert not result.compatible
    assert result.share.mean == pytest.approx(share, abs=0.08)
    assert result.share.low <= result.share.mean <= result.share.high < 0.0


def test_where_the_filter_is_good_none_is_reported_under_any_policy() -> None:
    task = make_task(OSCILLATOR, **ORDINARY)
    policies = [*usual_policies(task, 0.03), *usual_policies(task, 0.3), "always"]
    result = measured(OSCILLATOR, ORDINARY, policies, episodes=150)
    assert all(part.compatible for part in result.values())
    assert result["random:rate=0.03"].rate < result["random:rate=0.3"].rate < 0.3
    exact = measured("fusion_gym/RemoteEstimation-v1", {"horizon": 20}, ["always"])["always"]
    assert (exact.floor, exact.share) == (0.0, Interval(0.0, 0.0, 0.0))


def test_what_is_beside_an_episode_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = measured(OSCILLATOR, ORDINARY, ["random"], episodes=12)["random"]
    monkeypatch.setattr(cross_term, "BATCH", 5)
    parts = measured(OSCILLATOR, ORDINARY, ["random"], episodes=12)["random"]
    np.testing.assert_allclose(np.hstack(parts), np.hstack(whole), rtol=1e-12)


def test_more_policies_and_a_higher_level_make_wider_intervals() -> None:
    def width(terms: dict[str, CrossTerm]) -> float:
        return terms["always"].share.high - terms["always"].share.low

    single = measured(OSCILLATOR, ORDINARY, ["always"])
    assert width(measured(OSCILLATOR, ORDINARY, ["always", "never", "random"])) > width(single)
    task = make_task(OSCILLATOR, **ORDINARY)
    reference = reference_estimator(OSCILLATOR, ORDINARY)
    policies = {"always": make_policy("always", task)}
    assert width(cross_terms(task, reference, policies, 60, 0, level=0.999)) > width(single)
    assert width(cross_terms(task, reference, policies, 60, 0)) == width(single)


def test_the_worst_is_one_that_is_reported_from_zero() -> None:
    def part(low: float, high: float) -> CrossTerm:
        return CrossTerm(0.1, 1.0, 0.5, 0.5, Interval((low + high) / 2, low, high))

    result = {"wide": part(-1.0, 3.0), "broadcast": part(-0.2, -0.1), "less": part(0.01, 0.02)}
    assert worst(result)[0] == "broadcast"
    assert worst({"near": part(-0.2, 0.1), "far": part(-0.2, 0.4)})[0] == "far"


# --- trainings ------------------------------------------------------------------------------------


def mismatch_config(folder: Path, error: str = "mismatch", **options: Any) -> Experiment:
    environment = {"id": OSCILLATOR, "options": PAPER | options}
    training = {"timesteps": 128, "num_envs": 8, "error": error, "error_filter": "paper"}
    return load_checked(
        Experiment, small_config(folder, environment=environment, training=training)
    )


def test_a_training_on_the_mismatch_is_warned_once_where_that_is_not_the_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    experiment = mismatch_config(tmp_path)
    train(experiment)
    text = [line for line in capsys.readouterr().err.splitlines() if "cross term" in line]
    assert len(text) == 1
    assert text[0].startswith("warning: training.error = 'mismatch' leaves out a cross term of -")
    train(experiment.changed(None, timesteps=256), resume=True)
    assert "cross term" not in capsys.readouterr().err


def test_a_memory_that_is_there_is_the_reference_and_changes_no_reward(tmp_path: Path) -> None:
    options = ORDINARY | {"memory": True, "memory_filter": "adf"}
    training = {"timesteps": 64, "num_envs": 4, "error": "mismatch"}
    environment = {"id": OSCILLATOR, "options": options}
    experiment = load_checked(
        Experiment, small_config(tmp_path, environment=environment, training=training)
    )
    task = make_task(OSCILLATOR, **options)
    env = make_env(experiment, task)
    assert env.batch.reference is task.memory_estimator

    def rewards(env: Any) -> list[Any]:
        env.seed(5)
        env.reset()
        return [env.step(np.eye(4, 3, k=step % 3 - 1, dtype=np.int8))[1] for step in range(40)]

    other: Estimator[Any] = reference_estimator(OSCILLATOR, options)
    apart = PrivilegedVecEnv(task, 4, error="mismatch", reference=other, stagger=True)
    np.testing.assert_array_equal(rewards(env), rewards(apart))
