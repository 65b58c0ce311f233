"""Every entry of every observation holds what its name says, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from cases import CASES, CORRELATED, JUMP, OWN_ID, Case, each_case, requests
from meanings import Seen, formula
from own_system import RandomWalk

from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.observation import ObservationLayout
from fusion_gym.core.system import Block

RUNS, STEPS = 7, 12


def assert_named_entries_hold_their_values(case: Case) -> list[dict[str, Any]]:
    """In every step of some runs; returns the blocks as observed, a dictionary a step."""
    task = case.task()
    batch, seen = case.batch(list(range(RUNS))), []
    wanted = requests(task, RUNS, STEPS)
    for step in range(STEPS):
        observation, see, first = batch.observe(), Seen.of(batch), 0
        seen.append({})
        for block in batch.layout.blocks:
            last = first + len(block.places)
            shown = observation[:, first:last].T
            assert shown.shape == (len(block.places), RUNS)
            low, high = block.bounds
            value = np.asarray(formula(task.system, block.name)(see), dtype=np.float64)
            assert value.shape == (*block.shape, RUNS), block.name
            expected = np.clip(value.reshape(-1, RUNS), low, high)
            np.testing.assert_allclose(shown, expected, rtol=2e-6, atol=2e-6, err_msg=block.name)
            seen[-1][block.name] = shown
            first = last
        assert first == observation.shape[1]
        batch.step(wanted[step])
    return seen


@each_case
def test_named_entries_hold_what_their_names_say(case: Case) -> None:
    """And no two blocks of one shape always agree, so that mixed-up blocks would be noticed.

    But for a lone sensor, whose node may know just what the centre knows.
    """
    seen = assert_named_entries_hold_their_values(case)
    for one, other in combinations(seen[0], 2):
        if seen[0][one].shape == seen[0][other].shape and case.task().sensors > 1:
            assert any(np.abs(now[one] - now[other]).max() > 1e-3 for now in seen), (one, other)


@pytest.mark.parametrize(
    ("env_id", "filter", "one", "other"),
    [
        (CORRELATED, None, "log_deviation", "estimate"),
        (CORRELATED, None, "whitened_innovation", "fused_innovation"),
        (JUMP, "centralised", "whitened_innovation", "difference"),
        (JUMP, "imm", "log_deviation", "mode_probability"),
    ],
)
def test_mixed_up_blocks_are_noticed(
    env_id: str, filter: str | None, one: str, other: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = next(c for c in CASES if c.env_id == env_id and c.options.get("filter") == filter)
    kind: Any = type(case.task().system)
    declared_by = kind.observation.fget

    def mixed_up(system: Any) -> tuple[Block, ...]:
        blocks = {block.name: block for block in declared_by(system)}
        swapped = {one: blocks[other].value, other: blocks[one].value}
        return tuple(replace(b, value=swapped.get(b.name, b.value)) for b in blocks.values())

    monkeypatch.setattr(kind, "observation", property(mixed_up))
    with pytest.raises(AssertionError, match=r"log_deviation|whitened_innovation"):
        assert_named_entries_hold_their_values(case)


@each_case
def test_names_and_bounds_of_the_entries(case: Case) -> None:
    layout = ObservationLayout(case.task())
    assert len(set(layout.names)) == len(layout.names) == len(layout.entries)
    assert layout.low.dtype == layout.high.dtype == np.float32
    assert (layout.low < layout.high).all()
    assert layout.names[0].startswith(layout.blocks[0].name)
    batch = case.batch(list(range(RUNS)))
    for wanted in requests(case.task(), RUNS, STEPS, rate=0.1):
        observation = batch.observe()
        assert observation.dtype == np.float32
        assert observation.shape == (RUNS, len(layout.names))
        assert ((observation >= layout.low) & (observation <= layout.high)).all()
        batch.step(wanted)


class Declared(RandomWalk):
    """A random walk whose observation is declared by the test."""

    blocks: tuple[Block, ...] = ()

    @property
    def observation(self) -> tuple[Block, ...]:
        return self.blocks


def declared(*blocks: Block) -> EpisodeBatch:
    """A batch of it, reset."""
    case = next(case for case in CASES if case.env_id == OWN_ID)
    system = Declared(0.5, 2.0)
    object.__setattr__(system, "blocks", blocks)
    batch = EpisodeBatch(replace(case.task(), system=system), 3)
    batch.reset()
    return batch


def test_a_block_of_another_shape_is_refused() -> None:
    def block(value: Any) -> Block:
        return Block("age", "steps", value, (("0",),), node="own")

    assert declared(block(lambda state: state.age)).observe().shape == (3, 2)
    for wrong in (lambda state: state.age[0], lambda state: state.age[:, None]):
        with pytest.raises(ValueError, match=r"'age' of shape .* must be \(1, 'N'\)"):
            declared(block(wrong)).observe()


def test_two_blocks_of_one_name_are_refused() -> None:
    own = Block("age", "steps", lambda state: state.age[0], node="told")
    with pytest.raises(ValueError, match="'age' is declared twice"):
        declared(own, own)
    with pytest.raises(ValueError, match="'tokens' is declared twice"):
        declared(replace(own, name="tokens"))
