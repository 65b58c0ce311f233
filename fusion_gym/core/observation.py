"""The layout of the agent's observation: names, bounds and values of its entries."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg
from fusion_gym.arrays import Array
from fusion_gym.core.channel import STATES
from fusion_gym.core.knowledge import Block, Knowledge, covers, numbered
from fusion_gym.core.memory import Beliefs, Owner
from fusion_gym.core.task import Task
from fusion_gym.namespace import namespace
from fusion_gym.validation import ConfigurationError

# Odd functions of the beliefs: they resolve small differences and do not saturate.
_DIFFERENCE, _DIFFERENCE_LIMIT = 4.0, 10.0
_VALUE, _VALUE_LIMIT = 2.0, 20.0


class ObservationEntry(NamedTuple):
    """One number of an observation.

    Attributes:
        name: Name of the entry.
        own_name: Name in the observation of ``sensor``.
        sensor: The local sensor that observes the entry, or ``None``.
        broadcast: Whether every sensor receives it.
        centre: Whether the centre knows it.
    """

    name: str
    own_name: str
    sensor: int | None
    broadcast: bool
    centre: bool


def network_blocks(task: Task) -> tuple[Block, ...]:
    """Return the network's blocks, whose values are functions of `Runs`."""
    bucket, channel, price = task.network.bucket, task.network.channel, task.reward.price
    capacity, nodes = bucket.capacity, numbered(task.sensors)
    own, shared = partial(Block, node="own"), partial(Block, node="broadcast")
    links = (numbered(task.network.slots),) if task.network.rule.by_channel else ()
    channels = own(
        "channel",
        "state of the channel at the step before, one-hot",
        lambda runs: runs.channel_state()[..., None, :] == np.arange(len(STATES))[:, None],
        (nodes, *links, STATES),
    )
    tokens = shared(
        "tokens",
        "tokens over the capacity",
        lambda runs: runs.tokens / capacity,
        constants={"capacity": capacity},
    )
    energy = own(
        "energy",
        "tokens of the sensor's own bucket over its capacity",
        lambda runs: runs.state.network.energy / capacity,
        (nodes,),
        constants={"capacity": np.ravel(capacity)},
    )
    admitted = own(
        "admitted",
        "whether the access rule admits the sensor in this step",
        lambda runs: runs.admitted(),
        (nodes,),
    )
    queue = own(
        "queue",
        "place in the queue over the number of sensors, 0 for the head",
        lambda runs: runs.state.network.queue / task.sensors,
        (nodes,),
        constants={"sensors": task.sensors},
    )
    left = shared(
        "time_left",
        "remaining steps over the horizon",
        lambda runs: (runs.limit - runs.steps) / task.horizon,
        constants={"horizon": task.horizon},
    )
    block = shared(
        "price",
        "log(price/low) / log(high/low) of the price range",
        lambda runs: price.encode(runs.price),
        constants={} if price.span is None else {"range": price.span},
    )
    high = max(bucket.rate_range or (1.0,))
    rate = shared(
        "token_rate",
        "tokens per step over the high end of the range",
        lambda runs: runs.state.network.token_rate / high,
        constants={"high": high},
    )
    queues = bucket.sharing == "turns" and not bucket.unlimited
    return (
        *((channels,) if channel is not None and channel.states > 1 else ()),
        energy if bucket.per_sensor else tokens,
        *((admitted,) if task.network.rule.turn is not None else ()),
        *((queue,) if queues else ()),
        *((left,) if task.options.clock else ()),
        *((rate,) if bucket.rate_range is not None else ()),
        *((block,) if price.span is not None else ()),
    )


def belief_blocks(task: Task, owner: Owner) -> tuple[Block, ...]:
    """Return the blocks of the owner's beliefs, whose values are functions of `Beliefs`."""
    if not task.belief_features:
        return ()
    nominal = task.open_loop if task.nominal_error is None else task.nominal_error[:, None]
    deviation = np.sqrt(np.where(nominal > 0.0, nominal, 1.0))
    weights = task.relative_weights
    whole = float(((weights if weights.ndim == 2 else linalg.diagonal(weights)) * nominal).sum())

    def difference(beliefs: Beliefs) -> Array:
        scaled = _DIFFERENCE * beliefs.difference / deviation
        return cast(Array, namespace(scaled).arcsinh(scaled))

    def value(beliefs: Beliefs) -> Array:
        xp, runs = namespace(beliefs.loss), beliefs.loss.shape[-1]
        silent = xp.broadcast_to(beliefs.loss, (task.sensors, runs))
        both = xp.stack((silent, beliefs.value), axis=1) / whole
        root = _VALUE * xp.sqrt(abs(both))
        return cast(Array, xp.where(both < 0.0, -root, root))

    states, nodes = task.plant.state_names, numbered(task.sensors)
    differences = partial(
        Block,
        meaning=f"arsinh({_DIFFERENCE:g} (x* − x̂)/σ), σ the nominal deviations",
        limit=_DIFFERENCE_LIMIT,
        constants={"nominal deviations": deviation[:, 0]},
    )
    values = partial(
        Block,
        meaning=f"{_VALUE:g} sign(u) √|u|, u the squared norm of x* − x̂ (nobody) or v(m), over the "
        "nominal error",
        limit=_VALUE_LIMIT,
        constants={"nominal error": whole, "squared norm": weights[..., 0]},
    )
    if owner == "own":
        own: Any = {"knowledge": "own_memory" if task.options.memory else "own", "node": "own"}
        each, itself = (nodes, states), (nodes, ("nobody", "itself"))
        result = {
            "difference": differences("own_difference", value=difference, labels=each, **own),
            "value": values("own_value", value=value, labels=itself, **own),
        }
    else:
        known: Knowledge = "scheduler_memory" if task.options.memory else "scheduler"

        def scheduler_values(beliefs: Beliefs) -> Array:
            silent, sent = value(beliefs).swapaxes(0, 1)
            return cast(Array, namespace(sent).concatenate((silent[:1], sent)))

        result = {
            "difference": differences(
                "belief_difference",
                value=lambda beliefs: difference(beliefs)[0],
                labels=(states,),
                knowledge=known,
            ),
            "value": values(
                "transmission_value",
                value=scheduler_values,
                labels=(("nobody", *nodes),),
                knowledge=known,
            ),
        }
    return tuple(result[name] for name in task.belief_features)


class ObservationLayout:
    """The names, bounds and values of the entries of an agent's observation.

    Args:
        task: The task.
        owner: Owner of the beliefs: ``"scheduler"``, or ``"own"`` for every local sensor.

    Attributes:
        blocks: The visible blocks of the task's information mode, the network's last.
        entries: One :class:`ObservationEntry` per number.
        names: Names of the entries.
        low: Lower bounds (entries,) float32.
        high: Upper bounds (entries,) float32.

    Raises:
        ConfigurationError: Two blocks have the same name.
    """

    def __init__(self, task: Task, owner: Owner = "scheduler") -> None:
        def visible(blocks: tuple[Block, ...]) -> tuple[Block, ...]:
            return tuple(block for block in blocks if covers(task.knowledge, block.knowledge))

        self._task, self._owner = task, owner
        self._own = visible(task.estimator.observation)
        self._network = visible(network_blocks(task))
        self._memory = visible(belief_blocks(task, owner))
        self.blocks = self._own + self._memory + self._network
        names = [block.name for block in self.blocks]
        for name in names:
            if names.count(name) > 1:
                raise ConfigurationError(f"observation block {name!r} is declared twice")
        self.entries = tuple(entry for block in self.blocks for entry in block_entries(block))
        self.names = tuple(entry.name for entry in self.entries)
        bounds = [block.bounds for block in self.blocks for _ in block.places]
        self.low, self.high = np.array(bounds, dtype=np.float32).T.copy()

    def __reduce__(self) -> tuple[type[ObservationLayout], tuple[Task, Owner]]:
        """Pickle the task and the owner, because the blocks' functions may not be picklable."""
        return ObservationLayout, (self._task, self._owner)

    def encode(self, runs: Any, estimate: Any) -> NDArray[np.float32]:
        """Return observations (N, entries) float32, clipped to their bounds.

        Args:
            runs: ``Runs`` after sensing.
            estimate: The estimator's state, as the owner of the observation knows it.
        """
        filled = [block.fill(estimate) for block in self._own]
        filled += [block.fill(runs.beliefs()) for block in self._memory]
        filled += [block.fill(runs) for block in self._network]
        xp = namespace(runs.tokens)
        rows = xp.concatenate(filled, dtype=np.float64)
        if xp is not np:
            return xp.clip(rows.T.astype(np.float32), self.low, self.high)
        with np.errstate(over="ignore"):  # an overflow exceeds every bound
            result = np.ascontiguousarray(rows.T, dtype=np.float32)
        np.maximum(result, self.low, out=result)
        return np.minimum(result, self.high, out=result)

    def replace_beliefs(
        self, observation: NDArray[np.float32], beliefs: Beliefs
    ) -> NDArray[np.float32]:
        """Return observations (N, entries) with belief entries in this layout's scale."""
        rows = np.concatenate([block.fill(beliefs) for block in self._memory])
        first = sum(len(block.places) for block in self._own)
        places, result = slice(first, first + len(rows)), observation.copy()
        result[:, places] = np.clip(rows.T, self.low[places], self.high[places])
        return result


def block_entries(block: Block) -> list[ObservationEntry]:
    """Return the entries of a block."""
    result = []
    for place in block.places:
        own, rest = block.node == "own", place[1:] if block.node == "own" else place
        result.append(
            ObservationEntry(
                name=_named(block.name, place),
                own_name=_named(block.name, rest),
                sensor=block.labels[0].index(place[0]) if own else None,
                broadcast=block.node == "broadcast",
                centre=covers("centre", block.knowledge),
            )
        )
    return result


def _named(kind: str, place: tuple[str, ...]) -> str:
    return f"{kind}[{','.join(place)}]" if place else kind
