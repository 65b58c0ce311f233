"""Noise: what a seed fixes, where it may come from, how much of it is kept, and its units."""

import functools
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest

import fusion_gym
from fusion_gym.core import batch as batch_module
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.noise import PhiloxNoise

TOBIT = "fusion_gym/TobitOscillator-v1"
REMOTE = "fusion_gym/RemoteEstimation-v1"
DRAWN: Any = {"cost_weight": "random", "price_range": (0.001, 1.0), "access": "random"}
SEEDS = [0, 1, 2**32, 2**63, 2**64 - 1, 2**64, 2**64 + 1, 2**128, 2**128 + 1, 3**200]


@pytest.mark.parametrize("channels", [0, 1, 3, 7, 250, 256, 257, 2000])
def test_any_part_of_an_episode_is_drawn_by_itself(channels: int) -> None:
    source, draw = PhiloxNoise(), np.random.default_rng(channels)
    whole = source.steps(9, 4, 0, 600, channels)
    assert whole.shape == (600, channels)
    for first, last in np.sort(draw.integers(0, 600, (30, 2)), axis=1):
        source.start(int(first), 1, 5)  # what was asked before means nothing
        part = source.steps(9, 4, int(first), int(last - first), channels)
        np.testing.assert_array_equal(part, whole[first:last])


def test_seeds_episodes_and_purposes_are_independent_streams() -> None:
    source, draws = PhiloxNoise(), 4096
    streams = [
        source.steps(seed, episode, 0, draws, 1)[:, 0] for seed in SEEDS for episode in (0, 1)
    ]
    streams += [source.start(seed, episode, draws) for seed in SEEDS[:5] for episode in (0, 2**40)]
    correlation = np.corrcoef(streams) - np.eye(len(streams))
    assert np.abs(correlation).max() < 5.5 / np.sqrt(draws)
    assert np.abs(np.mean(streams, axis=1)).max() < 5 / np.sqrt(draws)
    assert np.abs(np.var(streams, axis=1) - 1).max() < 5 * np.sqrt(2 / draws)
    uniform = np.array([source.uniform(seed, 0) for seed in range(draws)])
    assert ((uniform >= 0) & (uniform < 1)).all()
    assert abs(uniform.mean() - 0.5) < 5 * np.sqrt(1 / 12 / draws)
    first = [source.steps(seed, 0, 0, 1, 1)[0, 0] for seed in range(draws)]
    assert abs(np.corrcoef(first[1:], first[:-1])[0, 1]) < 5 / np.sqrt(draws)


def played(batch: EpisodeBatch, steps: int = 17) -> list[Any]:
    """What runs brought, some of which begin anew in the middle."""
    draw, result = np.random.default_rng(0), []
    for step in range(steps):
        outcome = batch.step(draw.random((batch.task.sensors, batch.num_envs)) < 0.5)
        result += [batch.normals(), outcome.error, outcome.reward, batch.price, batch.admitted()]
        begin = outcome.ended | ((np.arange(batch.num_envs) % 3 == 1) & (step == 4))
        if begin.any():
            batch.reset(np.flatnonzero(begin))
        result = [np.copy(part) for part in result]
    return result


@pytest.mark.parametrize("env_id", [TOBIT, REMOTE])
def test_nothing_depends_on_the_length_of_a_block(
    env_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = fusion_gym.make_task(env_id, horizon=6, **DRAWN)
    whole = played(EpisodeBatch.seeded(task, 7, 3))
    for most, together in ((1, 1), (20, 2), (35, 256)):
        monkeypatch.setattr(batch_module, "_BLOCK_OF_RUN", most)
        monkeypatch.setattr(batch_module, "_TOGETHER", together)
        for part, other in zip(whole, played(EpisodeBatch.seeded(task, 7, 3)), strict=True):
            np.testing.assert_array_equal(part, other)


class Recording:
    """A source that keeps what another one gives, and alone gives that again."""

    def __init__(self) -> None:
        self.live: PhiloxNoise | None = PhiloxNoise()
        self.kept: dict[Any, Any] = {}

    def __getattr__(self, name: str) -> Callable[..., Any]:
        return functools.partial(self._call, name)

    def _call(self, *key: Any) -> Any:
        if self.live is not None:
            self.kept[key] = getattr(self.live, key[0])(*key[1:])
        return self.kept[key]


class Constant:
    """A source without any chance."""

    def start(self, seed: int, episode: int, channels: int) -> Any:
        return np.zeros(channels)

    def steps(self, seed: int, episode: int, first: int, count: int, channels: int) -> Any:
        return (
            np.full((count, channels), 1.0 * seed + 100 * episode)
            + np.arange(first, first + count)[:, None]
        )

    def uniform(self, seed: int, episode: int) -> float:
        return 0.5


@pytest.mark.parametrize("env_id", [TOBIT, REMOTE])
def test_noise_may_come_from_elsewhere(env_id: str) -> None:
    task, recording, results = fusion_gym.make_task(env_id, horizon=6, **DRAWN), Recording(), []
    for source in (None, recording, recording, Constant()):
        batch = EpisodeBatch(task, 5, noise=source)
        batch.seed(np.arange(5), [8, 9, 10, 11, 12])
        batch.reset()
        results.append(played(batch))
        if source is recording:
            recording.live = None
    for plain, kept, again in zip(*results[:3], strict=True):
        np.testing.assert_array_equal(plain, kept)
        np.testing.assert_array_equal(plain, again)
    for step, noise in enumerate(results[3][:20:5], start=1):
        np.testing.assert_array_equal(noise[0], np.arange(8, 13) + step)


def test_an_episode_does_not_depend_on_the_length_of_the_one_before() -> None:
    task = fusion_gym.make_task(TOBIT, horizon=9, **DRAWN)
    batch, nobody = EpisodeBatch.seeded(task, 2, 5), np.zeros((task.sensors, 2), dtype=np.bool_)
    first = batch.normals().copy()
    for lengths in ((2, 1), (1, 5)):
        for run, length in enumerate(lengths):
            for _ in range(length):
                batch.step(nobody)
            batch.reset(np.array([run]))
    other = EpisodeBatch.seeded(task, 2, 5)
    for _ in range(2):
        other.reset()
    batch.step(nobody), other.step(nobody)
    assert (first != other.normals()).all()
    np.testing.assert_array_equal(batch.price, other.price)
    np.testing.assert_array_equal(batch.normals()[:, 1], other.normals()[:, 1])


@pytest.mark.parametrize("seed", SEEDS)
def test_a_seed_may_be_any_whole_number(seed: int) -> None:
    env = gymnasium.make(TOBIT)
    many: Any = gymnasium.make_vec(TOBIT, 2, vectorization_mode="vector_entry_point")
    first = env.reset(seed=seed)[0]
    np.testing.assert_array_equal(first, many.reset(seed=[7, seed])[0][1])
    assert env.unwrapped.np_random_seed == seed
    second = env.reset()[0]
    assert (first != second).any()
    np.testing.assert_array_equal(second, many.reset()[0][1])
    np.testing.assert_array_equal(first, env.reset(seed=seed)[0])


def test_without_a_seed_noise_is_random_and_a_generator_of_the_users_decides() -> None:
    envs: list[Any] = [gymnasium.make(TOBIT).unwrapped for _ in range(2)]
    assert (envs[0].reset()[0] != envs[1].reset()[0]).any()
    known = [env.reset(seed=env.np_random_seed)[0] for env in envs]
    assert (known[0] != known[1]).any()
    for env in envs:
        env.np_random = np.random.default_rng(4)
    np.testing.assert_array_equal(envs[0].reset()[0], envs[1].reset()[0])
    np.testing.assert_array_equal(envs[0].reset()[0], envs[1].reset()[0])


def test_blocks_are_small_and_a_snapshot_goes_on_bitwise() -> None:
    large = fusion_gym.make_task(REMOTE, sensors=1000)
    for runs in (1, 40):
        batch = EpisodeBatch.seeded(large, runs, 0)
        assert batch._block.nbytes < 1e5 * runs
    for runs in (1, 1000, 200_000):
        assert EpisodeBatch(fusion_gym.make_task(TOBIT), runs)._block.nbytes <= 2**26
    first, other = (EpisodeBatch.seeded(fusion_gym.make_task(TOBIT), 3, seed) for seed in (0, 50))
    played(first, 3)
    other.restore({key: np.copy(part) if isinstance(part, np.ndarray) else part
                   for key, part in first.snapshot().items()})  # fmt: skip
    for part, same in zip(played(first, 150), played(other, 150), strict=True):
        np.testing.assert_array_equal(part, same)


def scaled(options: dict[str, Any], states: Any, measured: float) -> dict[str, Any]:
    """The same problem with each state in a unit of its own, and the measurements in another."""
    result, by = dict(options), np.asarray(states)
    for name in ("process_covariance", "initial_covariance"):
        if name in options:
            result[name] = np.asarray(options[name]) * np.outer(by, by)
    for name in ("process_gain", "initial_mean"):
        if name in options:
            result[name] = np.asarray(options[name]) * by
    for name in ("measurement_variance", "measurement_covariances"):
        if name in options:
            result[name] = options[name] * measured**2
    result["transition"] = np.asarray(options["transition"]) * by[:, None] / by
    result["measurement_matrices"] = np.asarray(options["measurement_matrices"]) / by * measured
    result["state_weights"] = np.asarray(options["state_weights"]) / by**2
    return result


PAIR = {
    "transition": [[0.9, 0.3], [-0.2, 0.8]],
    "initial_mean": [5.0, 0.5],
    "initial_covariance": [[0.1, 0.02], [0.02, 0.3]],
    "measurement_matrices": [[[1.0, 0.5], [0.2, 1.0]], [[0.3, 1.0], [1.0, 0.0]]],
    "state_weights": [1.0, 0.5],
}
CHAIN = {
    "transition": [[1.0, 0.5, 0.125], [0.0, 1.0, 0.5], [0.0, 0.0, 0.9]],
    "process_covariance": [[0.3, 0.1, 0.0], [0.1, 0.2, 0.05], [0.0, 0.05, 0.1]],
    "initial_mean": [1.0, 0.5, -0.3],
    "initial_covariance": [[1.0, 0.3, 0.1], [0.3, 0.8, 0.2], [0.1, 0.2, 0.5]],
    "measurement_matrices": [[[1.0, 0.0, 0.5]], [[0.0, 1.0, 0.2]]],
    "measurement_covariances": 0.25,
    "state_weights": [1.0, 0.5, 0.25],
}
RANK_ONE = {"process_gain": [0.16, 0.18], "measurement_variance": 0.5}
FULL = {"process_covariance": [[0.3, 0.1], [0.1, 0.2]], "measurement_covariances": 0.25}
LINEAR = "fusion_gym/LinearFusion-v2"


@pytest.mark.parametrize("powers", [(3, 3, 3), (-7, 4, 11), (12, 0, -9)])
@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        (LINEAR, PAIR | FULL),
        (LINEAR, PAIR | FULL | {"censoring_threshold": 0.0, "filter": "tobit"}),
        (LINEAR, CHAIN),
        (LINEAR, CHAIN | {"process_covariance": np.outer([0.1, 0.2, 0.4], [0.1, 0.2, 0.4])}),
        (TOBIT, PAIR | RANK_ONE | {"event_error": False}),
        (TOBIT, PAIR | RANK_ONE | {"filter": "tobit"}),
        (TOBIT, PAIR | RANK_ONE | {"filter": "kalman"}),
    ],
)
def test_units_of_single_states_change_nothing(
    env_id: str, options: dict[str, Any], powers: tuple[int, ...]
) -> None:
    """Powers of two bitwise: the noise, the truth, the errors, the rewards."""
    by = 2.0 ** np.array(powers[: len(options["initial_mean"])])
    batches = [
        EpisodeBatch.seeded(fusion_gym.make_task(env_id, horizon=40, **made), 3, 0)
        for made in (options, scaled(options, by, 0.125))
    ]
    draw = np.random.default_rng(1)
    for _ in range(40):
        request = draw.random((batches[0].task.sensors, 3)) < 0.5
        one, other = (batch.step(request) for batch in batches)
        np.testing.assert_array_equal(one.granted, other.granted)
        np.testing.assert_array_equal(one.error * by[:, None], other.error)
        truth, moved = (batch.task.plant.truth(batch.state.plant) for batch in batches)
        np.testing.assert_array_equal(truth * by[:, None], moved)
        np.testing.assert_allclose(one.reward, other.reward, rtol=1e-12)
