"""Other values of what must not matter to a policy, and what does matter to it.

A policy's copies watch the same episodes, and each is shown other values of what it must not know;
the network answers to the policy itself. Other values come from the plant: the same delivered
state, moved and measured with other noise.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from fusion_gym.arrays import merge_runs, take_runs
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.control import inputs_of
from fusion_gym.core.knowledge import MEMORY_SIGNALS, NETWORK_SIGNALS, Knowledge, Signals, covers
from fusion_gym.core.memory import Beliefs, Estimate, Memory
from fusion_gym.core.task import Task
from fusion_gym.policies.base import Policy, owner_of

Values = dict[str, Any]
RUNS, STEPS = 6, 7
TIME = ("step", "start", "token_cost")  # all runs know the costs, which never change
CLOCK = (*TIME, "queue")
OWN_ROW = ("admitted", "grantable", "queue")
TOLD = (*TIME, "tokens", "price", "control")


class Believed:
    """Beliefs as plain arrays (…, N), so that some of them can be changed, beside the states that
    they were made of."""

    parts = ("difference", "best", "silent", "sent", "value", "loss")
    states = ("memory_posterior", "memory_states")

    def __init__(self, values: Values, made_of: Values) -> None:
        self.values, self.made_of = values, made_of

    @classmethod
    def from_beliefs(cls, beliefs: Any) -> Believed:
        """All that a policy may ask of beliefs."""
        values = {name: getattr(beliefs, name) for name in cls.parts}
        made_of = {
            name: getattr(beliefs, name)
            for name in cls.states
            if beliefs.task.memory_estimator and hasattr(beliefs, name)
        }
        return cls(values, made_of)

    def with_each(self, change: Callable[..., Any], *others: Believed) -> Believed:
        """``change`` of every array, and of the others' of the same name."""
        result: Values = {}
        for name, value in self.values.items():
            parts = (value, *(other.values[name] for other in others))
            if isinstance(value, Estimate):
                result[name] = type(value)(*(change(*same) for same in zip(*parts, strict=True)))
            else:
                result[name] = change(*parts)
        return Believed(result, self.made_of)

    def __getattr__(self, name: str) -> Any:
        if name in self.parts:
            return self.values[name]
        if name in self.states:
            return self.made_of.get(name, {})
        raise AttributeError(name)


def read(signals: Signals, policy: Any) -> Values:
    """All signals; beliefs only for a policy that reads them, because they take long."""
    beliefs = ("beliefs", "own_beliefs", *(signal.name for signal in MEMORY_SIGNALS))
    believes = owner_of(policy) is not None
    result: Values = {name: signals[name] for name in signals if believes or name not in beliefs}
    return {n: Believed.from_beliefs(v) if isinstance(v, Beliefs) else v for n, v in result.items()}


def with_states(batch: EpisodeBatch, state: Any, memory: Memory) -> EpisodeBatch:
    """The batch with another state and memory."""
    result = copy.copy(batch)
    result.state, result.memory = state, memory
    return result


def moved_otherwise(
    batch: EpisodeBatch, memory_posterior: Memory, rng: np.random.Generator
) -> EpisodeBatch:
    """The same history, but the last move and all new measurements are made of other noise.

    ``memory_posterior`` is what there was before the last move.
    """
    if batch.delivered is None:
        return batch
    task, before = batch.task, batch.delivered
    noise = rng.standard_normal((task.plant.noise_channels, batch.num_envs))
    moving = inputs_of(before.control)
    plant = task.plant.sense(before.plant, noise, *moving)
    measurement = task.plant.measurement(plant)
    memory_posterior.observe(measurement, *moving)
    predicted = task.estimator.predict(before.estimate, *moving)
    estimate = task.estimator.observe(predicted, measurement)
    state = batch.state._replace(plant=plant, estimate=estimate)
    return with_states(batch, state, memory_posterior)


def forgotten(batch: EpisodeBatch) -> EpisodeBatch:
    """Without what was measured and not sent."""
    states = batch.memory.states
    memory = Memory(dataclasses.replace(batch.task, memory_estimator=None), batch.memory.owner)
    states = {name: state for name, state in states.items() if name.startswith("single")}
    return with_states(batch, batch.state, memory.with_states(states))


def with_other_truth(batch: EpisodeBatch, rng: np.random.Generator) -> EpisodeBatch:
    """The truth behind the measurements is changed, and so are coming losses."""
    state = batch.state
    kept = batch.task.plant.measurement(state.plant)
    plant = differing(state.plant, rng, lambda name, value: np.shares_memory(value, kept))
    hidden = ("following", "lost", "delay")
    draws = differing(state.network.draws, rng, lambda name, value: name not in hidden)
    network = dataclasses.replace(state.network, draws=draws)
    return with_states(batch, state._replace(plant=plant, network=network), batch.memory)


def differing(state: Any, rng: np.random.Generator, kept: Callable[[str, Any], bool]) -> Any:
    """A state with other values of what is not kept."""
    changed = {}
    for field in dataclasses.fields(state):
        value = getattr(state, field.name)
        if value is None or kept(field.name, value):
            continue
        if value.dtype == np.bool_:
            changed[field.name] = ~value
        elif value.dtype == np.float64:
            other = rng.standard_normal(value.shape)
            changed[field.name] = value * np.exp(other) if (value > 0.0).all() else value + other
        else:
            changed[field.name] = np.roll(value, 1, axis=-1)
    return dataclasses.replace(state, **changed)


def other_runs(values: Values, rng: np.random.Generator) -> Values:
    """Every value is another run's, numbers moved besides."""
    result = {}
    for name, value in values.items():
        if name == "estimate":
            result[name] = value
            continue
        if isinstance(value, Believed):
            result[name] = value.with_each(lambda array: np.roll(1.5 * array, 1, axis=-1))
            continue
        rolled = np.roll(value, 1, axis=0 if name == "observation" else -1)
        if rolled.dtype == np.bool_:
            rolled = ~rolled
        elif rolled.dtype.kind == "f":
            rolled = rolled + rng.standard_normal(rolled.shape).astype(rolled.dtype)
        result[name] = np.abs(rolled) if name == "price" else rolled
    return result


def of_sensor(sensor: int, true: Values, other: Values, batch: EpisodeBatch) -> Values:
    """``true`` where the sensor has it or everyone is told, ``other`` elsewhere."""
    signals = (*batch.task.estimator.signals, *MEMORY_SIGNALS, *NETWORK_SIGNALS)
    own = {signal.name for signal in signals if signal.known_to("own_memory")}

    def with_own(all_other: Any, all_true: Any) -> Any:
        result = all_other.copy()
        result[sensor] = all_true[sensor]
        return result

    result = {name: true[name] if name in TOLD else other[name] for name in true}
    for name, value in true.items():
        if name in OWN_ROW or name in own:
            result[name] = with_own(result[name], value)
        elif name == "own_beliefs":
            result[name] = other[name].with_each(with_own, value)
    known = [entry.broadcast or entry.sensor == sensor for entry in batch.layout.entries]
    result["observation"] = np.where(known, true["observation"], other["observation"])
    return result


def in_runs(runs: np.ndarray[Any, Any], true: Values, other: Values) -> Values:
    """``other`` in these runs, ``true`` in all others."""
    result = dict(true)
    for name, value in true.items():
        if name == "observation":
            result[name] = merge_runs(value.T, other[name][runs].T, runs).T
        elif isinstance(value, Believed):
            result[name] = value.with_each(
                lambda array, another: merge_runs(array, another[..., runs], runs), other[name]
            )
            if name == "beliefs":
                result[name].made_of = {
                    what: merge_runs(stored, take_runs(other[name].made_of[what], runs), runs)
                    for what, stored in value.made_of.items()
                }
        elif name == "estimate":
            result[name] = merge_runs(value, take_runs(other[name], runs), runs)
        elif name not in CLOCK:
            result[name] = merge_runs(value, other[name][..., runs], runs)
    return result


# --- what matters to a policy -------------------------------------------------------------------

ANYTHING = "anything but the clock"
MEASUREMENTS = "new measurements"
OTHERS = "what other sensors and the centre know"
PAST = "what was measured and not delivered"
HIDDEN = "the truth or coming losses"


CHARACTERISTIC: dict[Knowledge, set[str]] = {
    "clock": set(),
    "centre": {ANYTHING},
    "own": {MEASUREMENTS},
    "scheduler": {MEASUREMENTS, OTHERS},
    "own_memory": {MEASUREMENTS, PAST},
    "scheduler_memory": {MEASUREMENTS, OTHERS, PAST},
}


def may_matter(knowledge: Knowledge) -> set[str]:
    result = set()
    if knowledge != "clock":
        result.add(ANYTHING)
    if covers(knowledge, "own"):
        result.add(MEASUREMENTS)
    if covers(knowledge, "centre"):
        result.add(OTHERS)
    if covers(knowledge, "own_memory"):
        result.add(PAST)
    return result


def what_matters(policy: Policy, task: Task) -> set[str]:
    """Play episodes with the policy and see which changes move its copies' requests."""
    rng, seed = np.random.default_rng(1), 3
    batch = EpisodeBatch.seeded(task, RUNS, seed, owner_of(policy))
    memory_posterior = batch.memory
    timed, blind, without_memory, honest, *single = (
        copy.deepcopy(policy) for _ in range(4 + task.sensors)
    )
    for each in (policy, timed, blind, without_memory, honest, *single):
        each.reset(RUNS, seed)
    result: set[str] = set()

    def compare(what: str, answer: Any, expected: Any) -> None:
        if not np.array_equal(answer, expected):
            result.add(what)

    for step in range(STEPS):
        signals = batch.signals()
        requests = policy(signals)
        elsewhere = moved_otherwise(batch, memory_posterior, rng)
        true, other = (read(item.signals(), policy) for item in (batch, elsewhere))
        foreign = other_runs(other, rng)
        clock = {name: true[name] if name in CLOCK else foreign[name] for name in true}
        compare(ANYTHING, timed(Signals(clock)), requests)
        compare(MEASUREMENTS, blind(elsewhere.signals()), requests)
        compare(HIDDEN, honest(with_other_truth(batch, rng).signals()), requests)
        for sensor, each in enumerate(single):
            answer = each(Signals(of_sensor(sensor, true, foreign, batch)))
            compare(OTHERS, answer[sensor], requests[sensor])
        if task.memory_estimator is not None:
            compare(PAST, copy.deepcopy(without_memory)(forgotten(batch).signals()), requests)
        memory_posterior, state = batch.memory.branch(None, batch.num_envs), batch.state
        beliefs = partial(memory_posterior.beliefs, state.estimate, batch.arrival_probability())
        granted = batch.step(requests).granted
        delivery = task.network.deliver(state.network, granted)[1]
        memory_posterior.update(beliefs, delivery.reception.arrived)
        if step % 2 == 0:
            compare(PAST, without_memory(signals), requests)
        else:
            silent = np.flatnonzero(~granted.any(0))
            without_memory(Signals(in_runs(silent, true, other)))
    return result
