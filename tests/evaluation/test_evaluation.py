"""Episodes, metrics, intervals and the envelope, each against the plainest way to compute it."""

import math
import subprocess
import sys
import warnings
from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_case import Linear
from refusals import refused

from fusion_gym import make_task
from fusion_gym.core.task import CommonOptions, Scenario, Task
from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.errors import DivergenceError
from fusion_gym.evaluation.episodes import EpisodeResults, record_episode, run_episodes
from fusion_gym.evaluation.metrics import (
    METRICS,
    envelope_error,
    lower_envelope,
    mean_interval,
    paired_difference,
    robust_summary,
    summarise,
)
from fusion_gym.policies.registry import make_policy

ENV_ID = "fusion_gym/TobitOscillator-v1"
OPTIONS: dict[str, Any] = {"horizon": 12, "token_cost": (3.0, 2.0, 1.0), "token_rate": 2.0}


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task(ENV_ID, **OPTIONS)


def evaluate(task: Task, spec: str, episodes: int, seed: int = 10) -> EpisodeResults:
    return run_episodes(task, make_policy(spec, task), episodes, seed)


def fake(mse: Any, rate: Any) -> EpisodeResults:
    """Results of which only the error and the rate matter."""
    errors = np.asarray(mse, dtype=float)
    values = {field.name: np.zeros(len(errors)) for field in fields(EpisodeResults)}
    return EpisodeResults(**(values | {"mse": errors, "rate": np.full((len(errors), 3), rate)}))


@pytest.mark.parametrize(
    "spec", ["send_on_delta", "dynamic_event", "information_gain", "round_robin"]
)
def test_metrics_against_a_plain_loop(task: Task, spec: str) -> None:
    """Five episodes at seed 10 are the single environments with the seeds 10 to 14."""
    results = evaluate(task, spec, 5)
    squared_error = []
    for episode in range(5):
        env = gymnasium.make(ENV_ID, **OPTIONS)
        batch = env.unwrapped.batch
        policy = make_policy(spec, task)
        policy.reset(1)
        env.reset(seed=10 + episode)
        names = (field.name for field in fields(EpisodeResults))
        rows: dict[str, list[Any]] = {n: [] for n in names if getattr(results, n) is not None}
        truncated = False
        while not truncated:
            requests = policy(batch.signals())[:, 0]
            _, reward, _, truncated, info = env.step(requests.astype(np.int8))
            plant, estimate = batch.delivered.plant, batch.delivered.estimate
            error = (plant.truth - estimate.mean)[:, 0]
            claimed = estimate.covariance[..., 0]
            rows["squared_error"].append(info["squared_error"])
            rows["mse"].append(info["squared_error"].sum())
            rows["error_cost"].append(-info["reward_error"])
            rows["bound_trace"].append(np.trace(claimed))
            rows["nees"].append(error @ np.linalg.solve(claimed, error) / 2)
            rows["rate"].append(info["granted"])
            rows["requests"].append(info["granted"] | info["denied"])
            rows["tokens"].append(info["cost"])
            rows["denied"].append(info["denied"].sum())
            rows["returns"].append(reward)
            rows["diverged"].append(info["diverged"])
            late = (env.unwrapped.task.reward.state_weights[:, 0] @ info["squared_error"]) > 1.0
            rows["incorrect_age"].append((rows["incorrect_age"] or [0])[-1] + 1 if late else 0)
        assert len(rows["mse"]) == 12
        rows["age"], peaks = ages_of(np.array(rows["rate"]))
        rows["peak_age"] = [[np.mean(own) if own else np.nan for own in peaks]]
        rows["age_95"] = [np.quantile(rows["age"], 0.95, axis=0)]
        squared_error.append(rows.pop("squared_error"))
        for name, row in rows.items():
            expected = np.sum(row, 0) if name == "returns" else np.mean(row, 0)
            value = getattr(results, name)[episode]
            np.testing.assert_allclose(value, expected, rtol=1e-9, err_msg=name)
    np.testing.assert_allclose(results.squared_error, np.mean(squared_error, 0), rtol=1e-9)
    np.testing.assert_allclose(results.tokens, results.rate @ [3.0, 2.0, 1.0])
    assert results.episodes == 5


def ages_of(granted: Any) -> tuple[list[Any], list[list[int]]]:
    """Return ages (H, sensors) after grants (H, sensors), and the ages that each grant ended."""
    last, ages, peaks = [0] * granted.shape[1], [], [[] for _ in granted.T]  # type: ignore[var-annotated]
    for time, sent in enumerate(granted, 1):
        for sensor in np.flatnonzero(sent):
            peaks[sensor].append(time - last[sensor])
            last[sensor] = time
        ages.append(time - np.array(last))
    return ages, peaks


@pytest.mark.parametrize("delay", [0, 2, (1, 3)])
def test_age_of_information_counts_from_the_measurement(delay: Any) -> None:
    """The age is the time since the latest sending time of the packets that have arrived."""
    env = gymnasium.make("fusion_gym/LinearFusion-v2", delay=delay, tokens="unlimited")
    env.action_space.seed(1)
    env.reset(seed=3)
    newest, next_newest = np.zeros(2, dtype=int), np.zeros(2, dtype=int)
    for time in range(1, 60):
        sleeping = time % 4 > 0
        *_, info = env.step(np.zeros(2, np.int8) if sleeping else env.action_space.sample())
        newest = np.maximum(newest, next_newest)
        if delay == 0:
            newest[info["granted"]] = time
        else:
            late = env.unwrapped.task.network.late(env.unwrapped.batch.delivered.network)
            for back, sensor, _ in np.argwhere(late):
                next_newest[sensor] = max(next_newest[sensor], time - back)
                assert delay != 2 or back == 1
        np.testing.assert_array_equal(info["age"], time - newest)
    assert newest.all()


def test_results_do_not_depend_on_how_episodes_are_batched(
    task: Task, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = evaluate(task, "send_on_delta", 11)
    steps: list[int] = []
    monkeypatch.setattr("fusion_gym.evaluation.episodes.BATCH", 4)
    parts = run_episodes(task, make_policy("send_on_delta", task), 11, 10, steps.append)
    assert sum(steps) == 11 * 12
    for field in fields(EpisodeResults):
        part, expected = (getattr(results, field.name) for results in (parts, whole))
        if expected is None:
            continue
        np.testing.assert_allclose(part, expected, rtol=1e-9, atol=1e-12)
    assert not np.allclose(evaluate(task, "send_on_delta", 11, seed=500).mse, whole.mse)


def test_recorded_episode_is_the_evaluated_one(task: Task) -> None:
    results = evaluate(task, "send_on_delta", 3)
    for episode in range(3):
        path = record_episode(task, make_policy("send_on_delta", task), 10 + episode)
        assert path.truth.shape == path.mean.shape == path.variance.shape == (12, 2)
        assert path.local_mean.shape == (12, 3, 2)
        error = ((path.truth - path.mean) ** 2).sum(1).mean()
        assert error == pytest.approx(results.mse[episode], rel=1e-9)
        np.testing.assert_allclose(path.granted.mean(0), results.rate[episode])
        spent = path.granted @ np.array([3.0, 2.0, 1.0])
        level = 10.0
        for tokens, cost in zip(path.tokens, spent, strict=True):
            level = min(level + 2.0 - cost, 30.0)
            assert tokens == pytest.approx(level)
        assert (path.requested | ~path.granted).all()


def test_summary(task: Task) -> None:
    results = evaluate(task, "innovation_threshold", 40)
    summary = summarise(results)
    names = {"mse", "bound_trace", "nees", "tokens", "denied", "return"}
    assert summary.keys() == {name for name, metric in METRICS.items() if not metric.loop}
    for name in names:
        samples = getattr(results, "returns" if name == "return" else name)
        assert summary[name]["mean"] == pytest.approx(np.mean(samples))
        assert summary[name]["low"] < summary[name]["mean"] < summary[name]["high"]
    for name in ("rate", "requests"):
        assert summary[name] == pytest.approx(getattr(results, name).mean(0).tolist())
    # Σ_t √(mean over episodes of the squared error at t) / H, written out
    policy = make_policy("innovation_threshold", task)
    paths = [record_episode(task, policy, 10 + episode) for episode in range(40)]
    errors = [(path.truth - path.mean) ** 2 for path in paths]
    for state in range(2):
        total = 0.0
        for time in range(12):
            total += math.sqrt(sum(error[time, state] for error in errors) / 40)
        assert summary["armse"][state] == pytest.approx(total / 12, rel=1e-9)


@pytest.mark.parametrize("law", ["normal", "exponential"])
def test_interval_covers_the_mean_19_times_in_20(law: str) -> None:
    """400 samples of 50, each with the true mean 1; percentile intervals cover a little less."""
    rng = np.random.default_rng(17)
    hits = 0
    for _ in range(400):
        samples = rng.normal(1.0, 2.0, 50) if law == "normal" else rng.exponential(1.0, 50)
        mean, low, high = mean_interval(samples, seed=int(rng.integers(2**31)))
        assert mean == np.mean(samples)
        hits += low <= 1.0 <= high
    assert hits / 400 == pytest.approx(0.94 if law == "normal" else 0.92, abs=0.035)


def test_interval_is_reproducible_and_narrows() -> None:
    samples = np.random.default_rng(0).normal(size=1600)
    few, many = mean_interval(samples[:100]), mean_interval(samples)
    assert mean_interval(samples) == many
    ratio = (few.high - few.low) / (many.high - many.low)
    assert ratio == pytest.approx(4.0, rel=0.25)
    for same in ([3.5], [2.0, 2.0, 2.0], [0.0] * 50):
        assert mean_interval(np.array(same)) == (same[0],) * 3


def test_pairing_removes_the_noise_that_policies_share(task: Task) -> None:
    results = evaluate(task, "innovation_threshold:threshold=1", 300)
    other = evaluate(task, "innovation_threshold:threshold=1.1", 300)
    elsewhere = evaluate(task, "innovation_threshold:threshold=1.1", 300, seed=5000)
    paired, unpaired = paired_difference(results, other), paired_difference(results, elsewhere)
    assert paired.mean == pytest.approx(np.mean(results.mse - other.mse))
    assert (paired.high - paired.low) < 0.5 * (unpaired.high - unpaired.low)
    assert paired_difference(results, results) == (0.0, 0.0, 0.0)
    refused(lambda: paired_difference(results, evaluate(task, "never", 5)), "episodes = 300 and 5")


clouds = st.lists(st.tuples(st.integers(0, 20), st.integers(1, 40)), min_size=1, max_size=12).map(
    lambda points: {f"p{i}": (rate / 20, mse / 8) for i, (rate, mse) in enumerate(points)}
)


def envelope_at(hull: Any, rate: float) -> float:
    """The envelope by interpolation; to the right of its last point it stays level."""
    return float(np.interp(rate, [p.rate for p in hull], [p.mse for p in hull]))


@settings(deadline=None, max_examples=200)
@given(cloud=clouds)
def test_envelope_lies_below_every_policy_and_every_mixture(
    cloud: dict[str, tuple[float, float]],
) -> None:
    hull = lower_envelope({name: fake([mse], rate) for name, (rate, mse) in cloud.items()})
    for point in hull:
        assert (point.rate, point.mse) == pytest.approx(cloud[point.name])
    for rate, mse in cloud.values():
        assert envelope_at(hull, rate) <= mse + 1e-12
        assert rate >= hull[0].rate - 1e-12
    rates, errors = np.array([p.rate for p in hull]), np.array([p.mse for p in hull])
    assert (np.diff(rates) > 0).all()
    assert (np.diff(errors) < 0).all()
    assert (np.diff(np.diff(errors) / np.diff(rates)) > -1e-12).all()
    assert hull[-1].mse == pytest.approx(min(mse for _, mse in cloud.values()))


@settings(deadline=None, max_examples=60)
@given(cloud=clouds, rate=st.integers(0, 20), data=st.data())
def test_comparison_mixes_episode_by_episode(
    cloud: dict[str, tuple[float, float]], rate: int, data: st.DataObject
) -> None:
    noise = np.random.default_rng(data.draw(st.integers(0, 999))).normal(size=(13, 6))
    noise -= noise.mean(1, keepdims=True)
    baselines = {name: fake(mse + noise[i], r) for i, (name, (r, mse)) in enumerate(cloud.items())}
    hull = lower_envelope(baselines)
    own_rate = float(fake(noise[12], rate / 20).rate.mean())
    if own_rate < hull[0].rate:
        refused(lambda: envelope_error(baselines, own_rate), "below every policy")
        return
    error = envelope_error(baselines, own_rate)
    assert error.mean() == pytest.approx(envelope_at(hull, own_rate))
    assert min(np.ptp(error - own.mse) for own in baselines.values()) < np.ptp(noise)


def test_envelope_by_hand() -> None:
    baselines = {"never": fake([8.0, 4.0], 0.0), "inside": fake([5.0, 5.5], 0.2)}
    baselines |= {"good": fake([3.0, 1.0], 0.4), "worse": fake([3.0, 3.0], 0.6)}
    baselines |= {"always": fake([1.0, 1.0], 1.0), "wasteful": fake([1.5, 1.5], 1.0)}
    hull = lower_envelope(baselines)
    assert [point.name for point in hull] == ["never", "good", "always"]
    # At a rate of 0.1 three quarters never and one quarter good
    np.testing.assert_allclose(envelope_error(baselines, 0.1), [6.75, 3.25])
    # Exactly at a policy of the envelope, that policy alone, and the last one to its right
    np.testing.assert_allclose(envelope_error(baselines, 0.4), [3.0, 1.0])
    np.testing.assert_array_equal(envelope_error(baselines, 1.5), [1.0, 1.0])
    refused(lambda: envelope_error({"always": baselines["always"]}, 0.1), "add 'never'")
    refused(lambda: lower_envelope({}), "at least one")


@pytest.mark.slow
def test_the_zoo_the_evaluation_and_the_list_do_without_torch() -> None:
    lines = (
        "import sys, fusion_gym",
        "task = fusion_gym.make_task('fusion_gym/TobitOscillator-v1', horizon=3)",
        "fusion_gym.evaluation.run_episodes(task, fusion_gym.make_policy('always', task), 2, 0)",
        "assert fusion_gym.zoo.names() and fusion_gym.policy_names()",
        "import fusion_gym.commands.list as command; command.catalogue()",
        "assert not {'torch', 'stable_baselines3', 'scipy.stats'} & sys.modules.keys()",
    )
    subprocess.run([sys.executable, "-c", "; ".join(lines)], check=True)


def test_a_heavy_tail_is_warned_of() -> None:
    rng = np.random.default_rng(0)
    with pytest.warns(UserWarning, match="over 20% of their sum: the mean has a heavy tail"):
        mean_interval(np.exp(3.0 * rng.standard_normal(1000)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mean_interval(rng.exponential(size=1000))


class Breaking(Linear):
    """A plant that ends where its noise is large."""

    most = np.inf

    def move(self, state: Any, noise: Any) -> Any:
        return np.where(noise[0] > self.most, np.inf, super().move(state, noise))


def test_runs_that_diverge_leave_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their share is reported, and means name them; alone such a run has none."""

    def build(options: CommonOptions) -> Scenario:
        return Scenario(options, (system := Breaking()).plant, system.estimator)

    monkeypatch.setitem(ENVIRONMENTS, "me/Breaking-v0", build)
    task = make_task("me/Breaking-v0", horizon=20)
    whole = evaluate(task, "periodic:period=2", 200)
    monkeypatch.setattr(Breaking, "most", 3.2)
    with np.errstate(invalid="ignore"):
        results = evaluate(task, "periodic:period=2", 200)
    lost = np.isnan(results.mse)
    assert 0 < lost.sum() < 10
    for name in ("mse", "returns", "rate", "nees"):
        one, other = (getattr(result, name) for result in (results, whole))
        np.testing.assert_array_equal(one[~lost], other[~lost])
        assert np.isnan(one[lost]).all()
    assert np.isinf(results.cost(0.1)[lost]).all()
    assert robust_summary(results)["lost"] == lost.mean()
    assert np.isfinite(results.squared_error).all()
    with pytest.warns(UserWarning, match=f"{lost.sum()} of 200 episodes diverged"):
        summary = summarise(results)
    assert summary["mse"]["mean"] == pytest.approx(whole.mse[~lost].mean())
    with np.errstate(invalid="ignore"):
        alone = evaluate(task, "always", 1, 10 + int(lost.argmax()))
    assert np.isnan(alone.squared_error[-1]).all()
    refused(lambda: summarise(alone), "all 1 episodes diverged", kind=DivergenceError)
