"""The memory of N runs: measurements that were taken and not sent, and the beliefs they imply.

A memory state is the state of an estimator that has processed every measurement of its owner. The
scheduler has all measurements. A local sensor has its own measurements and the broadcasts:

- ``"none"``: It knows which of its packets arrived, and models a centre with its packets only.
- ``"estimate"``: It receives the centre's prediction with its covariance, and joins it with its own
  estimate by covariance intersection, because their cross-correlation is unknown.
- ``"packets"``: It receives every packet that arrived and knows everything that the centre knows.

x* is the best estimate of the memory's owner, x̂ the centre's estimate without a transmission, and
x̂(s) with a transmission of sensor s only. The value of a transmission is
v(s) = ‖x* - x̂‖² - E‖x* - x̂(s)‖², with the expectation over the arrival; it can be negative. With
memory x* uses all measurements and received packets of its owner,
without memory the centre's knowledge and the new measurements.

Sources: Y. Xu and J. P. Hespanha, "Optimal communication logics in networked control systems",
IEEE CDC 2004, and G. M. Lipsa and N. C. Martins, "Remote state estimation with communication costs
for first-order LTI systems", IEEE Trans. Automatic Control 56, 2011, who send when the two
estimates differ; A. Molin and S. Hirche, "On the optimality of certainty equivalence for
event-triggered control systems", IEEE Trans. Automatic Control 58, 2013, and T. Soleymani,
J. S. Baras and S. Hirche, "Value of information in feedback control: quantification", IEEE Trans.
Automatic Control 67, 2022, for its value.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal, NamedTuple, Self, cast, get_args

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array, Lazy, map_arrays, merge_runs, take_runs, value_of
from fusion_gym.core.control import inputs_of
from fusion_gym.core.estimator import Estimator, Reception
from fusion_gym.core.task import ONE_STEP, Task
from fusion_gym.errors import refusal
from fusion_gym.fusion.intersection import covariance_intersection
from fusion_gym.namespace import namespace

Owner = Literal["scheduler", "own"]
Kind = Literal["every", "own", "single"]
Packets = NDArray[np.bool_]


class MemoryPart(NamedTuple):
    """An estimator of the memory of N runs.

    It is of ``kind`` ``"every"`` with all measurements, ``"own"`` with one sensor's measurements
    and received packets, or ``"single"``, a centre with deliveries from that sensor only. Its state
    has ``copies`` · N columns, a sensor's runs adjacent. A ``private`` state has no packets of
    others. ``sensor`` is the only one that the estimator has; ``None`` is all. Runs with the same
    noise have different measurements where the loop is ``closed``.
    """

    kind: Kind
    estimator: Estimator[Any]
    copies: int
    private: bool
    sensor: int | None = None
    closed: bool = False

    @property
    def shared(self) -> bool:
        """Whether runs with the same noise have the same state."""
        return self.private and not self.estimator.reads_silence and not self.closed

    def rows(self, values: Any) -> Any:
        """Return the estimator's sensors among values (sensors, …)."""
        return values if self.sensor is None else values[self.sensor : self.sensor + 1]

    def itself(self, state: Any) -> Packets:
        """Return the packets of the owner's own measurements, with one column if all are equal."""
        sensors, columns = len(state.measurement), state.measurement.shape[-1]
        if self.copies > 1:
            eye = np.eye(sensors, dtype=np.bool_)
            return np.repeat(eye, columns // self.copies, axis=-1)
        for field in self.estimator.covariance_fields[:1]:
            columns = getattr(state, field).shape[-1]
        return np.ones((sensors, columns), dtype=np.bool_)

    def places(self, runs: NDArray[np.int64], num_envs: int) -> NDArray[np.int64]:
        """Return the columns (copies · R,) of the runs (R,) in a state of ``num_envs`` runs."""
        return (np.arange(self.copies)[:, None] * num_envs + runs).ravel()


MemoryStates = dict[str, Any]  # after sensing, by the name of the part


class MemoryColumns(NamedTuple):
    """The parts of a memory, their states, and the columns ``places`` (N,) of the runs.

    Shared states have one column for all runs with the same noise; without ``places`` every run
    has its own.
    """

    parts: Mapping[str, MemoryPart]
    states: MemoryStates
    places: NDArray[np.int64] | None

    def whole(self, num_envs: int) -> MemoryStates:
        """Return the states with a column for each of the ``num_envs`` runs."""
        result = dict(self.states)
        for name, state in self.states.items():
            part = self.parts[name]
            if part.shared and (self.places is not None or part.estimator.covariance_fields):
                columns = np.arange(num_envs) if self.places is None else self.places
                width = state.measurement.shape[-1] // part.copies
                result[name] = take_runs(state, part.places(columns, width))
        return result


@dataclass(frozen=True)
class Estimate:
    """A mean (k, n, N) and a covariance (k, n, n, N), with k = 1 or one estimate per sensor.

    Args:
        mean: (k, n, N).
        source: The covariance (k, n, n, N), or a function that computes it on first access.
    """

    mean: Array
    source: Array | Callable[[], Array]

    @cached_property
    def covariance(self) -> Array:
        """Covariance, computed on first access."""
        return self.source() if callable(self.source) else self.source

    def __iter__(self) -> Iterator[Array]:
        return iter((self.mean, self.covariance))

    def __reduce__(self) -> tuple[type[Estimate], tuple[Array, Array]]:
        """Pickle the computed covariance, because its function may not be picklable."""
        return Estimate, (self.mean, self.covariance)


class Beliefs(ABC):
    """The estimates of N runs before any transmission, each computed on first access.

    Args:
        task: The task.
        estimate: The estimator's state after observing.
        memory: The owner's memory states.
        arrival: Probability (sensors, N) that a packet sent now arrives; ``None`` is 1.
        best: x*, if it is known.
    """

    def __init__(
        self,
        task: Task,
        estimate: Any,
        memory: MemoryColumns,
        arrival: Array | None,
        best: Estimate | None = None,
    ) -> None:
        if best is not None:
            vars(self)["best"] = best
        self.task, self.arrival = task, arrival
        self._estimate, self._runs = estimate, estimate.measurement.shape[-1]
        self._memory, (self._parts, self._states, self._places) = memory, memory

    @property
    @abstractmethod
    def silent(self) -> Estimate:
        """x̂, the centre's estimate without a transmission, as the owner knows it."""

    @property
    @abstractmethod
    def sent(self) -> Estimate:
        """x̂(s), k = sensors, the centre's estimate if only the packet of s arrives."""

    @property
    @abstractmethod
    def best(self) -> Estimate:
        """x*, the estimate with all knowledge of the owner."""

    @cached_property
    def posteriors(self) -> MemoryStates:
        """Memory states of x* after the update with the owner's new measurements."""
        return {
            name: self.update(self._parts[name].estimator, state, self._parts[name].itself(state))
            for name, state in self._states.items()
            if self._parts[name].kind != "single"
        }

    @cached_property
    def memory_states(self) -> MemoryStates:
        """Memory states with a column for each run."""
        return self._memory.whole(self._runs)

    def update(self, estimator: Estimator[Any], state: Any, packets: Packets) -> Any:
        """Return the state after the arrival of these packets (sensors, …) and no others."""
        failure = None
        if estimator.reads_silence and self.arrival is not None:
            copies = packets.shape[-1] // self._runs
            failure = namespace(self.arrival).tile(1.0 - self.arrival, copies)
        packets = namespace(state.measurement).asarray(packets)
        return estimator.update(state, Reception(packets, failure=failure))

    def _of_parts(self, kind: Kind, updated: MemoryStates) -> Estimate:
        """Return the estimates of the parts of one kind, one after another."""
        each = [
            self._of_part(self._parts[name], state)
            for name, state in updated.items()
            if self._parts[name].kind == kind
        ]
        if len(each) == 1:
            return each[0]
        return _one_after_another(each)

    def _of_part(self, part: MemoryPart, updated: Any) -> Estimate:
        """Return an estimate per copy of a part."""

        def whole(values: Array) -> Array:
            xp = namespace(values)
            apart = xp.moveaxis(values.reshape(*values.shape[:-1], part.copies, -1), -2, 0)
            if part.shared and self._places is not None and apart.shape[-1] > 1:
                apart = apart[..., self._places]
            result: Array = xp.broadcast_to(apart, (*apart.shape[:-1], self._runs))
            return result

        estimator = part.estimator
        mean = whole(estimator.mean(updated))
        return Estimate(mean, lambda: whole(estimator.covariance(updated)))

    @cached_property
    def difference(self) -> Array:
        """x* - x̂ (k, n, N)."""
        return self.best.mean - self.silent.mean

    @cached_property
    def loss(self) -> Array:
        """‖x* - x̂‖² (k, N), weighted by ``task.relative_weights``."""
        return self._weighted(self.difference)

    @cached_property
    def value(self) -> Array:
        """v(s) (sensors, N), weighted by ``task.relative_weights``."""
        gain = self.loss - self._weighted(self.best.mean - self.sent.mean)
        return gain if self.arrival is None else self.arrival * gain

    def _weighted(self, difference: Array) -> Array:
        return linalg.weighted_square(difference, self.task.relative_weights)

    def _no_packets(self, runs: int) -> Packets:
        return np.zeros((self.task.sensors, runs), dtype=np.bool_)


class SchedulerBeliefs(Beliefs):
    """The beliefs of the scheduler, from all new measurements and the centre's knowledge."""

    @cached_property
    def silent(self) -> Estimate:
        """x̂, the centre's estimate without a transmission."""
        return _fused(self.task.estimator, self._silent)

    @cached_property
    def sent(self) -> Estimate:
        """x̂(s); with ``packet="estimate"`` it is x* for every s."""
        self.task.refuse_delay(ONE_STEP)
        if self.task.options.packet == "estimate":
            return Estimate(*(part.repeat(self.task.sensors, axis=0) for part in self.best))
        single = self.task.estimator.single_deliveries(self._estimate)
        if single is not None:
            return Estimate(*single)
        return _one_after_another([_fused(self.task.estimator, own) for own in self._sent])

    @cached_property
    def best(self) -> Estimate:
        """x*, the estimate with all knowledge of the scheduler."""
        if "every" in self._states:
            return self._of_parts("every", self.posteriors)
        everyone = ~self._no_packets(self._runs)
        return _fused(
            self.task.estimator, self.update(self.task.estimator, self._estimate, everyone)
        )

    @property
    def memory_posterior(self) -> Any:
        """Memory state after the update, with a column for each run."""
        return self._memory._replace(states=self.posteriors).whole(self._runs).get("every")

    @cached_property
    def _silent(self) -> Any:
        return self.update(self.task.estimator, self._estimate, self._no_packets(self._runs))

    @cached_property
    def _sent(self) -> list[Any]:
        """The centre's states after each sensor's packet only."""
        result = []
        for sensor in range(self.task.sensors):
            single = self._no_packets(self._runs)
            single[sensor] = True
            result.append(self.update(self.task.estimator, self._estimate, single))
        return result


class OwnBeliefs(Beliefs):
    """The beliefs of local sensors (k = sensors), from their measurements and received packets."""

    @cached_property
    def silent(self) -> Estimate:
        """x̂, the centre's estimate without a transmission, as each sensor knows it."""
        estimator, sensors = self.task.estimator, self.task.sensors
        if self.task.broadcast == "none":
            return self._single(sent=False)
        silence = self._no_packets(self._runs)
        received = _fused(estimator, self.update(estimator, self._estimate, silence))
        return Estimate(
            received.mean.repeat(sensors, axis=0),
            lambda: received.covariance.repeat(sensors, axis=0),
        )

    @cached_property
    def sent(self) -> Estimate:
        """x̂(s), the centre's estimate if only the packet of s arrives, as sensor s knows it."""
        estimator, sensors = self.task.estimator, self.task.sensors
        if any(part.kind == "single" for part in self._parts.values()):
            own = self._single(sent=True)
            return own if self.task.broadcast == "none" else _joined(self.silent, own)
        single = estimator.single_deliveries(self._estimate)
        if single is not None:
            return Estimate(*single)
        part = MemoryPart("own", estimator, sensors, private=False)
        state = take_runs(self._estimate, np.tile(np.arange(self._runs), sensors))
        return self._of_part(part, self.update(estimator, state, part.itself(state)))

    @cached_property
    def best(self) -> Estimate:
        """x*, the estimate with all knowledge of each sensor."""
        if self.task.memory_estimator is None:
            return self.sent
        own = self._of_parts("own", self.posteriors)
        if self.task.broadcast != "estimate":
            return own
        return _joined(self.sent if self.task.feedback else self.silent, own)

    def _single(self, sent: bool) -> Estimate:
        """Return the estimates of the centre after each sensor's own packet, or none."""
        updated = {}
        for name, state in self._states.items():
            part = self._parts[name]
            if part.kind == "single":
                packets = part.itself(state) & sent
                updated[name] = self.update(part.estimator, state, packets)
        self._known[sent] = updated
        return self._of_parts("single", updated)

    def delivered(self, arrived: Packets, name: str) -> Any:
        """Return the state of a part "single" after packets (sensors, N)."""
        part, state = self._parts[name], self._states[name]
        xp = namespace(arrived)
        packets = part.rows(xp.tile(arrived, part.copies)) & part.itself(state)
        if len(self._known) < 2 or part.estimator.reads_silence:
            return self.update(part.estimator, state, packets)
        choose = partial(xp.where, packets.any(0))
        return map_arrays(choose, self._known[True][name], self._known[False][name])

    @cached_property
    def _known(self) -> dict[bool, MemoryStates]:
        return {}


def _one_after_another(each: list[Estimate]) -> Estimate:
    xp = namespace(each[0].mean)
    return Estimate(
        xp.concatenate([estimate.mean for estimate in each]),
        lambda: xp.concatenate([estimate.covariance for estimate in each]),
    )


def _fused(estimator: Estimator[Any], updated: Any) -> Estimate:
    mean = estimator.mean(updated)[None]
    return Estimate(mean, lambda: estimator.covariance(updated)[None])


def _joined(first: Estimate, second: Estimate) -> Estimate:
    """Return the covariance intersection of two estimates of each sensor."""
    sensors, states, runs = first.mean.shape

    xp = namespace(first.mean)

    def flat(array: Array) -> Array:
        result: Array = xp.moveaxis(array, 0, -2).reshape(*array.shape[1:-1], sensors * runs)
        return result

    fused = covariance_intersection(
        flat(first.mean), flat(first.covariance), flat(second.mean), flat(second.covariance)
    )
    shape = (sensors, runs)
    return Estimate(
        xp.moveaxis(fused.mean.reshape(states, *shape), -2, 0),
        xp.moveaxis(fused.covariance.reshape(states, states, *shape), -2, 0),
    )


# Signals of a packet that arrives at once, which a delay excludes.
_AT_ONCE = ("transmission_value", "own_value", "variance_reduction", "greedy_variance")

_OWN = ("own_beliefs", "own_difference", "own_value")
_EVERY = ("beliefs", "belief_difference", "transmission_value")


class Memory:
    """The memory of a task's runs, which moves with them.

    Args:
        task: The task.
        owner: ``"scheduler"``, or ``"own"`` for every local sensor.

    A state that no transmission changes has one column for all runs with the same noise, and the
    ``covariance_fields`` of its estimator have one column for all runs that begin together.

    Attributes:
        parts: Parts of the memory, by name.
        places: Columns (N,) of the runs in the private parts' states; ``None`` is one per run.

    Raises:
        ConfigurationError: The owner is local, and packets hold the scheduler's estimate or may be
            late.
    """

    def __init__(self, task: Task, owner: Owner) -> None:
        validation.choice("owner", owner, get_args(Owner))
        self.task, self.owner = task, owner
        own = owner == "own"
        if own and task.options.packet == "estimate":
            why = "with local sensors, because the estimate belongs to the scheduler"
            raise refusal("packet", task.options.packet, f"'measurement' {why}")
        if own:
            reason = "their model of the centre has only packets that arrive at once"
            task.refuse_delay(reason, "with the memory of local sensors")
        self.parts: dict[str, MemoryPart] = {}
        broadcast = task.broadcast
        if task.memory_estimator is not None:
            if own:
                self._add("own", task.memory_estimator, private=broadcast != "packets")
            else:
                memory, closed = task.memory_estimator, task.controller is not None
                self.parts["every"] = MemoryPart("every", memory, 1, private=True, closed=closed)
        if own and (broadcast == "none" or (broadcast == "estimate" and not task.feedback)):
            self._add("single", task.estimator, private=False)
        self.keeps_every = "every" in self.parts
        self.states = {}
        self.places: NDArray[np.int64] | None = None
        self._first: NDArray[np.int64] | None = None  # a run of each column
        self._beliefs: Beliefs | None = None

    @property
    def states(self) -> MemoryStates:
        """The parts' states after sensing, by name."""
        states: MemoryStates = value_of(self._states)
        return states

    @states.setter
    def states(self, states: Any) -> None:
        self._states = states

    def _add(self, kind: Kind, estimator: Any, private: bool) -> None:
        """Add a part for each sensor where the estimator allows it, else one with copies."""
        alone = [estimator.select_sensor(i) for i in range(self.task.sensors)]
        closed = self.task.controller is not None
        if (private or kind == "single") and None not in alone:
            for sensor, own in enumerate(alone):
                self.parts[f"{kind} {sensor}"] = MemoryPart(kind, own, 1, private, sensor, closed)
        else:
            copies = self.task.sensors
            self.parts[kind] = MemoryPart(kind, estimator, copies, private, closed=closed)

    def begin(
        self,
        first: Array,
        announcement: Any,
        measurement: Array,
        runs: NDArray[np.int64],
        keys: Sequence[Any],
        num_envs: int,
        control: Array | None = None,
    ) -> None:
        """Start in the R runs ``runs``, and observe.

        Args:
            first: Measurements (sensors, m, R) at time 0.
            announcement: The plant's announcement of the start.
            measurement: Measurements (sensors, m, R) of the first sensing.
            runs: Numbers of the runs (R,).
            keys: Keys of the runs' noise (R,).
            num_envs: Number of all runs.
            control: Input (k, R) between the two measurements, with a controller.
        """
        together, old = len(runs) == num_envs, self.whole(num_envs)
        self.places = self._first = self._beliefs = None
        if together and len(column := {key: place for place, key in enumerate(keys)}) < num_envs:
            self._first = np.sort(list(column.values()))
            self.places = np.searchsorted(self._first, [column[key] for key in keys])
        self.states = {}
        for name, part in self.parts.items():
            start = part.estimator.start(part.rows(first), announcement)
            columns = np.arange(len(runs))
            if part.shared and self._first is not None:
                columns = self._first
            state = take_runs(start, np.tile(columns, part.copies))
            if together and part.shared and part.copies == 1:
                fields = part.estimator.covariance_fields
                first_run = np.zeros(1, dtype=np.int64)
                values = {field: take_runs(getattr(state, field), first_run) for field in fields}
                state = replace(state, **values)
            self.states[name] = state
        self.observe(measurement, control)
        if not together:
            for name, state in self.states.items():
                places = self.parts[name].places(runs, num_envs)
                self.states[name] = merge_runs(old[name], state, places)

    def beliefs(self, estimate: Any, arrival: Array | None) -> Beliefs:
        """Return the owner's beliefs before any transmission.

        Args:
            estimate: The estimator's state after observing.
            arrival: Probability (sensors, N) that a packet sent now arrives; ``None`` is 1.
        """
        if self._beliefs is None:
            self._beliefs = self._make_beliefs(estimate, arrival)
        return self._beliefs

    def update(self, beliefs: Callable[[], Beliefs], arrived: NDArray[np.bool_]) -> None:
        """Update the memory after the packets (sensors, N) that arrive.

        Args:
            beliefs: Function that returns the beliefs before the transmission.
            arrived: (sensors, N) bool.
        """
        if self.states:
            self.states = self._updated(beliefs(), arrived)

    def observe(self, measurement: Array, control: Array | None = None) -> None:
        """Predict with the input (k, N), and take the new measurements (sensors, m, N)."""
        states, self._beliefs = {}, None
        for name, state in self.states.items():
            part, own = self.parts[name], self.parts[name].rows(measurement)
            if part.shared and self._first is not None:
                own = own[..., self._first]
            moving: Any = inputs_of(control)
            if part.copies > 1:
                own, *moving = (namespace(own).tile(item, part.copies) for item in (own, *moving))
            states[name] = part.estimator.observe(part.estimator.predict(state, *moving), own)
        self.states = states

    def forget(self) -> None:
        """Forget the beliefs of the step before."""
        self._beliefs = None

    def whole(self, num_envs: int) -> MemoryStates:
        """Return the states with a column for each of the ``num_envs`` runs."""
        return self._columns.whole(num_envs)

    def branch(self, runs: NDArray[np.int64] | None, num_envs: int) -> Self:
        """Return an independent memory of ``runs`` of the ``num_envs`` runs, by default of all."""
        if runs is None:
            return copy.copy(self)
        return self.with_states(
            {
                name: take_runs(state, self.parts[name].places(runs, num_envs))
                for name, state in self.whole(num_envs).items()
            }
        )

    def with_states(self, states: MemoryStates | Lazy) -> Self:
        """Return a memory of other runs with these states, a column for each run."""
        result = copy.copy(self)
        result.states = states
        result.places = result._first = result._beliefs = None
        return result

    def with_best(self, estimate: Any, arrival: Array | None, best: Estimate) -> Self:
        """Return a memory of runs with known x*."""
        result = self.with_states({})
        result._beliefs = result._make_beliefs(estimate, arrival, best)
        return result

    def signals(self, beliefs: Callable[[], Beliefs]) -> Mapping[str, Callable[[], Any]]:
        """Return the owner's beliefs and ``MEMORY_SIGNALS`` by name, as functions."""
        own = self.owner == "own"
        values = (
            beliefs,
            lambda: beliefs().difference if own else beliefs().difference[0],
            lambda: beliefs().value,
        )
        return dict(zip(_OWN if own else _EVERY, values, strict=True))

    @property
    def missing_signals(self) -> Mapping[str, str]:
        """Names of the signals that are not computed, and the reasons for their absence."""
        late = "is absent, because the network has a delay and"
        names = _AT_ONCE if self.task.delayed else ()
        hidden = {name: f"signal {name!r} {late} {ONE_STEP}" for name in names}
        why = (
            "is absent, because this batch does not compute it: a policy that reads beliefs must "
            "declare the attribute memory_owner = 'scheduler' or 'own'"
        )
        absent = _EVERY if self.owner == "own" else _OWN
        return {name: f"signal {name!r} {why}" for name in absent} | hidden

    def _make_beliefs(
        self, estimate: Any, arrival: Array | None, best: Estimate | None = None
    ) -> Beliefs:
        kind = OwnBeliefs if self.owner == "own" else SchedulerBeliefs
        return kind(self.task, estimate, self._columns, arrival, best)

    @property
    def _columns(self) -> MemoryColumns:
        return MemoryColumns(self.parts, self.states, self.places)

    def _updated(self, beliefs: Beliefs, arrived: NDArray[np.bool_]) -> MemoryStates:
        result, own = {}, cast(OwnBeliefs, beliefs)
        for name, state in self.states.items():
            part = self.parts[name]
            if part.private:
                result[name] = beliefs.posteriors[name]
                continue
            if part.kind == "single":
                result[name] = own.delivered(arrived, name)
                continue
            packets = namespace(arrived).tile(arrived, part.copies) | part.itself(state)
            result[name] = beliefs.update(part.estimator, state, packets)
        return result
