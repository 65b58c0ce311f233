"""With the numbers that its meaning speaks of, an observation gives back what was measured."""

from typing import Any

import numpy as np
import pytest

import fusion_gym
from fusion_gym.arrays import Array
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import Block, Signals
from fusion_gym.core.observation import block_entries
from fusion_gym.envs.registration import ENVIRONMENTS

COMMON = {"tokens": "limited", "token_rate": 0.5, "clock": True}
COMMON |= {"cost_weight": "random", "price_range": (0.01, 1.0)}


def batch_of(env_id: str, **options: Any) -> EpisodeBatch:
    task = fusion_gym.make_task(env_id, **COMMON, belief_features=True, **options)
    batch = EpisodeBatch.seeded(task, 40, 0)
    for _ in range(7):
        batch.step(batch.signals()["step"] % 3 == np.arange(task.sensors)[:, None])
    return batch


def visible_entries(batch: EpisodeBatch) -> dict[str, tuple[Block, Array]]:
    """Blocks by name with their entries, (…, N), nan where they are clipped."""
    rows, place, result = batch.observe(), 0, {}
    for block in batch.layout.blocks:
        count = len(block_entries(block))
        entries = rows[:, place : place + count].T.astype(np.float64)
        low, high = block.bounds
        entries[(entries == low) | (entries == high)] = np.nan
        result[block.name] = block, entries.reshape(*block.shape, -1)
        place += count
    return result


def diagonal(covariance: Array) -> Array:
    return np.einsum("iin->in", covariance)


def difference(entries: Array, constant: Any, signals: Signals) -> tuple[Array, Array]:
    return entries * constant, signals["measurement"] - signals["held"]


# For each word of a constant and block what the entries stand for, from signals.
PHYSICAL: dict[tuple[str, str], Any] = {
    ("estimate", "root mean square"): lambda e, c, s: (e * c, s["prior_mean"]),
    ("log_variance", "open-loop mean"):
        lambda e, c, s: (np.exp(e) * c, diagonal(s["prior_covariance"])),
    ("log_deviation", "open-loop deviation"):
        lambda e, c, s: (np.exp(e) * c, np.sqrt(diagonal(s["prior_covariance"]))),
    ("held_difference", "two noise deviations"): difference,
    ("held_difference", "√2 noise deviations"): difference,
    ("error", "error_scale"): lambda e, c, s: (e * c, s["innovation"][:, 0]),
    ("belief_difference", "nominal deviations"):
        lambda e, c, s: (np.sinh(e) / 4.0 * c, s["belief_difference"]),
    ("tokens", "capacity"): lambda e, c, s: (e * c, s["tokens"]),
    ("transmission_value", "nominal error"):
        lambda e, c, s: (np.sign(e[1:]) * (e[1:] / 2.0) ** 2 * c, s["transmission_value"]),
}  # fmt: skip


LAST = ("fusion_gym/UnknownInput-v1", "log_deviation", "open-loop deviation")


def check(batch: EpisodeBatch, env_id: str) -> set[tuple[str, str]]:
    signals: Signals = batch.signals()
    done = set()
    for name, (block, entries) in visible_entries(batch).items():
        for word, value in block.constants.items():
            # In UnknownInput-v1 that is of the last estimate, which no signal has.
            if (name, word) not in PHYSICAL or (env_id, name, word) == LAST:
                continue
            column = np.asarray(value)[..., None] if np.ndim(value) else value
            ours, theirs = PHYSICAL[name, word](entries, column, signals)
            size = min(len(ours), len(theirs))  # an input stands behind the states
            ours, theirs = ours[:size], theirs[:size]
            observed = np.isfinite(ours)
            theirs = np.broadcast_to(theirs, ours.shape)[observed]
            np.testing.assert_allclose(ours[observed], theirs, rtol=2e-5, atol=2e-5, err_msg=name)
            if observed.any():
                done.add((name, word))
    return done


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_entries_give_back_what_was_measured(env_id: str) -> None:
    done = check(batch_of(env_id), env_id)
    assert ("belief_difference", "nominal deviations") in done
    assert ("transmission_value", "nominal error") in done
    blocks = batch_of(env_id).layout.blocks
    constants = {(block.name, word) for block in blocks for word in block.constants}
    assert constants & PHYSICAL.keys() <= done | {LAST[1:]}


def test_the_clock_and_the_price_are_decoded() -> None:
    batch = batch_of("fusion_gym/TobitOscillator-v1")
    result = visible_entries(batch)
    block, left = result["time_left"]
    np.testing.assert_allclose(left * block.constants["horizon"], 100 - 7, rtol=1e-6)
    block, place = result["price"]
    low, high = np.asarray(block.constants["range"])
    np.testing.assert_allclose(low * (high / low) ** place, batch.price, rtol=1e-5)
