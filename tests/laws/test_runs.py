"""Laws of runs: the noise, the batch, branches, and what an observation holds."""

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from cases import Array, Case, actions, each_case, read, requests, skip_closed_loop

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import Signals
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.envs.single import FusionEnv
from fusion_gym.systems.markov_jump.system import MarkovJumpEstimator
from fusion_gym.systems.nonlinear import NonlinearEstimator

RUNS, STEPS = 4, 6


@each_case
def test_noise_is_the_same_whatever_is_requested(case: Case) -> None:
    """Truth, measurements, price and access too, over episodes that are cut short."""
    silent, busy = (case.batch(horizon=6) for _ in range(2))
    skip_closed_loop(silent.task)
    apart = False
    for step, request in enumerate(requests(silent.task, 3, 2 * STEPS, rate=0.6)):
        for latent in zip(*map(hidden, (silent, busy)), strict=True):
            np.testing.assert_array_equal(*latent)
        outcomes = silent.step(request & False), busy.step(request)
        apart |= bool((outcomes[0].error != outcomes[1].error).any())
        begin = outcomes[0].ended | (np.arange(3) == (1 if step in (2, 7) else -1))
        if begin.any():
            for batch in (silent, busy):
                batch.reset(np.flatnonzero(begin))
    assert apart


def hidden(batch: EpisodeBatch) -> list[Array]:
    """What no policy can change."""
    signals, plant = read(batch), batch.state.plant
    measured = np.where(signals.get("sampled", True), np.moveaxis(signals["measurement"], 1, 0), 0)
    result = [
        batch.normals(),
        batch.task.plant.truth(plant),
        batch.price,
        batch.admitted(),
        measured,
    ]
    return [np.copy(part) for part in result]


@each_case
def test_a_run_is_the_same_by_itself_and_in_a_batch(case: Case) -> None:
    """Bitwise that of the single environment, though it begins later and others anew."""
    batch = case.batch(40, 100, horizon=6)
    env: Any = FusionEnv(case.task(horizon=6))
    request, run = requests(batch.task, 40, 2 * STEPS), 29  # on no boundary of a vector register
    for requested in request[:2]:
        batch.step(requested)
    batch.seed(np.array([run]), [5])
    batch.reset(np.array([run]))
    visible, _ = env.reset(seed=5)
    for step, requested in enumerate(request[2:]):
        np.testing.assert_array_equal(batch.observe()[run], visible, strict=True)
        outcome = batch.step(requested)
        visible, reward, *ended, info = env.step(actions(batch.task, requested)[run])
        assert (reward, any(ended)) == (outcome.reward[run], outcome.ended[run])
        assert ended[0] == (outcome.ended[run] and batch.task.options.clock)
        for name in ("cost", "granted", "squared_error", "reward_error", "diverged"):
            np.testing.assert_array_equal(info[name], getattr(outcome, name)[..., run])
        begin = outcome.ended.copy()
        begin[: 7 * (step == 8)] = True
        if begin.any():
            batch.reset(np.flatnonzero(begin))
        if begin[run]:
            visible, _ = env.reset()


@each_case
def test_a_pickled_batch_steps_as_the_batch(case: Case) -> None:
    batch = case.batch(3)
    other = pickle.loads(pickle.dumps(batch))
    for request in requests(batch.task, 3, 2):
        for first, second in zip(batch.step(request), other.step(request), strict=True):
            np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("owner", ["scheduler", "own"])
@each_case
def test_a_branch_takes_the_step_that_would_have_been(case: Case, owner: Any) -> None:
    """Of any runs in any order, and without moving the batch."""
    if owner == "own" and not case.local_memory:
        return
    batch, taken = case.batch(RUNS, owner=owner), np.array([3, 1, 1])
    draw = np.random.default_rng(0)
    for request in requests(batch.task, RUNS, 2):
        before = contents(batch)
        branch, some, elsewhere = batch.branch(), batch.branch(taken), batch.branch()
        assert contents(branch) == before
        elsewhere.step(~request, draw.standard_normal((batch.channels, RUNS)))
        assert contents(batch) == before != contents(elsewhere)
        outcome = batch.step(request)
        for first, two in zip(branch.step(request, batch.normals()), outcome, strict=True):
            np.testing.assert_array_equal(first, two)
        some.step(request[:, taken], batch.normals()[:, taken])
        assert contents(branch) == contents(batch)
        np.testing.assert_array_equal(some.observe(), batch.observe()[taken])


def contents(runs: Any) -> list[bytes]:
    """All that is shown of runs."""
    observation = [
        runs.observe(),
        runs.tokens,
        runs.price,
        runs.steps,
        runs.admitted(),
        runs.state.network.queue,
    ]
    beliefs = runs.beliefs()
    late = runs.task.delayed
    observation += [beliefs.best.mean, beliefs.difference if late else beliefs.value]
    return [np.ascontiguousarray(part).tobytes() for part in observation]


# --- the observation ------------------------------------------------------------------------------


@each_case
def test_an_observation_is_finite_within_its_bounds_and_declared(case: Case) -> None:
    """So are signals, with the axes that are declared; also long after the last delivery."""
    batch = case.batch(RUNS)
    layout, declared_signals = ObservationLayout(batch.task), batch.task.estimator.signals
    assert len(set(layout.names)) == len(layout.names) == len(layout.low)
    assert (layout.low < layout.high).all()
    for step, request in enumerate(requests(batch.task, RUNS, 24)):
        observation = batch.observe()
        assert observation.dtype == layout.low.dtype == np.float32
        assert observation.shape == (RUNS, len(layout.names))
        assert ((observation >= layout.low) & (observation <= layout.high)).all()
        sizes, signals = {"N": RUNS, "sensors": batch.task.sensors}, read(batch)
        assert set(signals) == {signal.name for signal in declared_signals}
        for signal in declared_signals if step in (0, 20, 21) else ():
            axes = [axis for axis in signal.axes.strip("()").replace(" ", "").split(",") if axis]
            value = signals[signal.name]
            assert np.isfinite(value).all(), signal.name
            for axis, size in zip(axes, value.shape, strict=True):
                declared = int(axis) if axis.isdigit() else sizes.setdefault(axis, size)
                assert size == declared, f"{signal.name}: {axis}"
        outcome = batch.step(request & (step >= 20))
        assert np.isfinite(outcome.reward).all()


# Blocks that say the same of every system, from signals; `constant` are known to a factor.
FORMULAS: dict[str, Callable[[EpisodeBatch, Signals], Array]] = {
    "whitened_innovation": lambda b, s: s["innovation"] / s["innovation_deviation"],
    "surprise": lambda b, s: s["innovation"] / s["innovation_deviation"],
    "age": lambda b, s: 1.0 - 10.0 / (s["age"] + 10.0),
    "uncensored_probability": lambda b, s: s["uncensored_probability"],
    "tokens": lambda b, s: b.tokens / b.task.settings["token_capacity"],
    "admitted": lambda b, s: b.admitted(),
    "queue": lambda b, s: b.state.network.queue / b.task.sensors,
    "token_rate": lambda b, s: b.state.network.token_rate / b.task.settings["token_rate"][1],
    "time_left": lambda b, s: 1.0 - b.steps / b.task.horizon,
    "price": lambda b, s: place(b.price, *b.task.settings["price_range"]),
}
CONSTANT: dict[str, Callable[[EpisodeBatch, Signals], Array]] = {
    "estimate": lambda b, s: s["prior_mean"],
    "held_difference": lambda b, s: s["measurement"] - s["held"],
    "difference": lambda b, s: s["measurement"] - s["held"],
    "error": lambda b, s: s["innovation"],
}
# That of the node, not of the packet; that over a deviation.
DIFFERING = {"whitened_innovation": MarkovJumpEstimator, "held_difference": NonlinearEstimator}


def place(price: Array, low: float, high: float) -> Array:
    """Of a price in its range, in the logarithm."""
    return np.asarray(np.log(price / low) / np.log(high / low))


@each_case
def test_blocks_that_every_system_may_have_mean_the_same(case: Case) -> None:
    batch, result = case.batch(RUNS), 0
    ratios: dict[str, list[Array]] = {}
    kind = type(batch.task.estimator)
    for request in requests(batch.task, RUNS, STEPS):
        observation, signals, first = batch.observe(), read(batch), 0
        for block in batch.layout.blocks:
            visible = observation[:, first : first + len(block.places)].T
            first += len(block.places)
            low, high = block.bounds
            if DIFFERING.get(block.name) == kind:
                continue
            if block.name in FORMULAS:
                value = FORMULAS[block.name](batch, signals).reshape(-1, RUNS)
                np.testing.assert_allclose(
                    visible, np.clip(value, low, high), rtol=2e-6, atol=2e-6, err_msg=block.name
                )
                result += 1
            elif block.name in CONSTANT:
                value = CONSTANT[block.name](batch, signals).reshape(-1, RUNS)
                size = len(value)
                inside = (np.abs(visible[:size]) < high) & (np.abs(value) > 1e-3)
                ratio = np.divide(
                    visible[:size], value, out=np.full(value.shape, np.nan), where=inside
                )
                ratios.setdefault(block.name, []).append(ratio)
        batch.step(request)
    for name, each in ratios.items():
        together = np.concatenate(each, axis=-1)
        together = together[np.isfinite(together).any(-1)]  # a channel may be missing
        middle = np.nanmedian(together, axis=-1, keepdims=True)
        assert (middle > 0.0).all(), name
        assert np.nanmax(np.abs(together / middle - 1.0)) < 1e-2, name
    assert result
