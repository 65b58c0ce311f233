"""The network: who may transmit, what it costs, and what arrives."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_gym import linalg, validation
from fusion_gym.arrays import Array
from fusion_gym.core.access import (
    ACCESS,
    AccessOptions,
    AccessRow,
    assign,
    check_requests,
    collisions,
    first_requests,
)
from fusion_gym.core.channel import (
    Channel,
    ChannelOptions,
    make_acknowledgement,
    make_delay,
)
from fusion_gym.core.estimator import Reception
from fusion_gym.core.token_bucket import BucketOptions, Grants, Queue, TokenBucket
from fusion_gym.declaration import plain_options
from fusion_gym.errors import forbidden
from fusion_gym.namespace import namespace, ndtr

_MOST_CHANNELS = 64  # of an assignment to fewer sensors


@dataclass(slots=True)
class Draws:
    """What a network draws for a step, which nobody knows before it; ``None`` is absent.

    ``following`` (l, N), the channels' present state · ``lost`` (l, N) bool, whether a packet sent
    now is lost · ``delay`` (l, N), its delay in steps · ``unreported`` (l, N) bool, whether its
    sender does not learn if it arrives · ``frequency`` (l, N), its channel · ``harvest`` (l, N)
    bool, the tokens that the sensors gain. With k channels for an assignment ``following`` and
    ``lost`` have l·k rows, k adjacent ones for each sensor.
    """

    following: NDArray[np.int64] | None = None
    lost: NDArray[np.bool_] | None = None
    delay: NDArray[np.int64] | None = None
    unreported: NDArray[np.bool_] | None = None
    frequency: NDArray[np.int64] | None = None
    harvest: NDArray[np.bool_] | None = None


@dataclass(slots=True)
class NetworkState:
    """The network of N runs before the requests of a step; l sensors, delays of at most D steps.

    ``tokens`` (N,), or (l, N) of each sensor's own bucket · ``queue`` (l, N), the place of each
    sensor · ``admitted`` (l, N) bool, the sensors with a reading that the access rule admits ·
    ``channel`` (l, N), the channels' state at the step before, which is fed back, as
    ``Draws.following`` · ``place`` (l, N), 0 for the largest discrepancy · ``token_rate`` (N,) of
    an episode. Hidden are ``draws``, ``due`` (D, l, N), the delay of the packet that was sent 1, …,
    D steps ago, 0 without one, and ``true_drop`` (N,), the true probability of a loss. ``None`` is
    absent.
    """

    tokens: Array
    queue: Queue
    admitted: NDArray[np.bool_]
    channel: NDArray[np.int64] | None = None
    place: NDArray[np.int64] | None = None
    due: NDArray[np.int64] | None = None
    true_drop: Array | None = None
    token_rate: Array | None = None
    draws: Draws = field(default_factory=Draws)

    @property
    def energy(self) -> Array:
        """Tokens (l, N) that pay for the packets of each sensor."""
        energy: Array = namespace(self.tokens).broadcast_to(self.tokens, self.queue.shape)
        return energy

    @property
    def total(self) -> Array:
        """Tokens (N,) of all buckets."""
        return self.tokens if self.tokens.ndim == 1 else linalg.total(self.tokens)


class Delivery(NamedTuple):
    """The network's response to the requests of a step.

    Attributes:
        granted: Sensors (l, N) bool.
        spent: Tokens spent (N,).
        reception: Packets that arrive at once.
        supposed: Packets (l, N) bool that the sensors suppose to arrive at once; ``None`` is those
            that arrive.
    """

    granted: NDArray[np.bool_]
    spent: Array
    reception: Reception
    supposed: NDArray[np.bool_] | None = None

    @property
    def known(self) -> NDArray[np.bool_]:
        """Packets (l, N) bool that arrive at once, as far as the sensors know."""
        return self.reception.arrived if self.supposed is None else self.supposed


@dataclass(frozen=True)
class NetworkOptions(ChannelOptions, BucketOptions, AccessOptions):
    """The options of medium access, tokens, losses, acknowledgements and delays."""


@dataclass(frozen=True)
class Network:
    """Medium access, tokens, losses and delays, with noise of its own.

    Args:
        options: The options.
        sensors: Number of sensors.

    Source: M. Nourian, A. S. Leong, S. Dey and D. E. Quevedo, "An optimal transmission strategy for
    Kalman filtering over packet dropping links with imperfect acknowledgements", IEEE Trans.
    Control of Network Systems 1, 2014, for acknowledgements.

    Raises:
        ConfigurationError: An option is not allowed, or has no use.

    Example:
        >>> from fusion_gym.core.network import Network, NetworkOptions
        >>> network = Network(NetworkOptions(token_rate=1.0, token_cost=1.0), sensors=2)
        >>> network.bucket.rate, network.noise_channels
        (1.0, 0)
    """

    options: NetworkOptions
    sensors: int

    def __post_init__(self) -> None:
        options, rule = self.options, self.rule
        for name, used in (
            ("slots", rule.limited and not rule.by_channel and options.access != "single"),
            ("channels", rule.contended or rule.by_channel),
            ("discrepancy", rule.by_discrepancy),
            ("discrepancy_weights", rule.by_discrepancy),
        ):
            value, default = getattr(options, name), getattr(type(options), name)
            if not used and plain_options(value) != default:
                where = f"with access={options.access!r}"
                raise forbidden(name, value, "it has no use", where)
        for name in ("slots", "channels"):
            most = max(self.sensors, _MOST_CHANNELS) if rule.by_channel else self.sensors
            validation.integer(name, getattr(options, name), at_least=1, at_most=most)
        for part in ("weights", "bucket", "channel", "delay", "acknowledgement"):
            getattr(self, part)  # which checks it

    @property
    def rule(self) -> AccessRow:
        """The rule of medium access."""
        return ACCESS[self.options.access]

    @cached_property
    def slots(self) -> int:
        """Most grants in a step of a rule with slots; channels of an assignment."""
        return self.options.channels if self.rule.by_channel else self.options.slots

    @cached_property
    def weights(self) -> Array:
        """Weights (l, 1) of the discrepancies."""
        weights = self.options.discrepancy_weights
        return validation.positive("discrepancy_weights", weights, (self.sensors,))[:, None]

    @cached_property
    def bucket(self) -> TokenBucket:
        """The token bucket."""
        return TokenBucket(self.options, self.sensors)

    @cached_property
    def channel(self) -> Channel | None:
        """Losses; ``None`` loses nothing."""
        channels = self.options.channels if self.rule.by_channel else None
        channel = Channel(self.options, self.sensors, channels)
        return None if self.options.channel == "perfect" else channel

    @cached_property
    def delay(self) -> Array:
        """Probabilities (l, D + 1) of a delay of 0, 1, … steps, drawn for each packet."""
        return make_delay(self.options, self.sensors)

    @cached_property
    def acknowledgement(self) -> float:
        """Probability that a sender learns whether its packet arrives; else it supposes so."""
        return make_acknowledgement(self.options)

    @property
    def start_channels(self) -> int:
        """Number of standard normals that :meth:`start` takes per run."""
        own = 0 if self.channel is None else self.channel.start_channels
        return own + (self.bucket.rate_range is not None)

    @property
    def draw_channels(self) -> int:
        """Number of standard normals that :meth:`draw` takes per run."""
        return sum(self._normals.values())

    @property
    def noise_channels(self) -> int:
        """Number of standard normals that :meth:`advance` takes per run."""
        return self.rule.random + self.draw_channels

    @cached_property
    def _normals(self) -> dict[str, int]:
        """Numbers of normals of the parts of :class:`Draws` that the network draws."""
        channel, sensors, links = self.channel, self.sensors, self.sensors * self._channels
        sizes = {
            "following": links * (channel is not None and channel.states > 1),
            "lost": links * (channel is not None and channel.loses),
            "delay": sensors * (self.longest_delay > 0),
            "unreported": sensors * (0.0 < self.acknowledgement < 1.0),
            "frequency": sensors * (self.rule.contended and self.options.channels > 1),
            "harvest": sensors * (self.bucket.draws_harvest and not self.bucket.unlimited),
        }
        return {name: size for name, size in sizes.items() if size}

    @cached_property
    def _channels(self) -> int:
        """Number of links of each sensor."""
        return self.slots if self.rule.by_channel else 1

    @cached_property
    def longest_delay(self) -> int:
        """Largest delay D, in steps."""
        return self.delay.shape[1] - 1

    @cached_property
    def _delay_quantiles(self) -> Array:
        """Uniform numbers (D, l, 1) from which on a delay is longer than 0, …, D - 1 steps."""
        possible = self.delay[:, :0:-1].cumsum(1)[:, ::-1] > 0.0
        return np.where(possible, self.delay.cumsum(1)[:, :-1], 2.0).T[..., None]

    def start(self, noise: Array) -> NetworkState:
        """Return the state at time 0.

        Args:
            noise: Standard normals (start_channels, N).
        """
        runs, longest = noise.shape[-1], self.longest_delay
        channel = true_drop = None
        if self.channel is not None:
            own = noise[: self.channel.start_channels]
            channel = self.channel.start(own) if "following" in self._normals else None
            true_drop = self.channel.begin(own)
        due = np.zeros((longest, self.sensors, runs), dtype=np.int64) if longest else None
        everyone = np.ones((self.sensors, runs), dtype=np.bool_)
        bucket = self.bucket
        tokens, queue = bucket.start(runs), bucket.start_queue(runs)
        rest = true_drop, bucket.start_rate(noise), Draws(channel)
        return NetworkState(tokens, queue, everyone, channel, None, due, *rest)

    def advance(
        self,
        state: NetworkState,
        noise: Array,
        step: NDArray[np.int64],
        readings: NDArray[np.bool_] | None = None,
    ) -> NetworkState:
        """Return the state before the requests of the next step.

        Args:
            state: Any state.
            noise: Standard normals (noise_channels, N).
            step: Steps taken so far (N,).
            readings: Sensors (l, N) with a reading, which may request; ``None`` is all.
        """
        admitted, turn = state.admitted if readings is None else readings, self.rule.turn
        if turn is not None:
            own = np.arange(self.sensors)[:, None] == turn(self.sensors, step, noise)
            admitted = own if readings is None else own & readings
        noise = noise[1:] if self.rule.random else noise
        following = state.draws.following
        old = state.tokens, state.queue, state.due, state.true_drop, state.token_rate
        moved = _moved(*old, admitted, following, following)
        return self.draw(moved, noise) if len(noise) else moved

    def draw(self, state: NetworkState, noise: Array) -> NetworkState:
        """Return a state with new hidden parts, from the channels' state that was fed back.

        Args:
            state: Any state.
            noise: Standard normals (draw_channels, N).
        """
        own, end, draws = {}, 0, Draws(state.channel)
        for name, size in self._normals.items():
            own[name], end = noise[end : end + size], end + size
        if self.channel is not None and state.channel is not None:
            draws.following = self.channel.advance(state.channel, own["following"])
        if self.channel is not None and "lost" in own:
            nothing = np.zeros(own["lost"].shape, dtype=np.int64)
            present = nothing if draws.following is None else draws.following
            draws.lost = self.channel.lost(present, own["lost"], state.true_drop)
        if "delay" in own:
            draws.delay = (ndtr(own["delay"]) >= self._delay_quantiles).sum(0)
        if "unreported" in own:
            draws.unreported = ndtr(own["unreported"]) >= self.acknowledgement
        if "frequency" in own:
            drawn = (ndtr(own["frequency"]) * self.options.channels).astype(np.int64)
            draws.frequency = namespace(drawn).minimum(drawn, self.options.channels - 1)
        if "harvest" in own:
            draws.harvest = ndtr(own["harvest"]) < self.bucket.rate
        return replace(state, draws=draws)

    def grant(self, state: NetworkState, requests: NDArray[Any], runs: Any = slice(None)) -> Grants:
        """Return the grants for requests (l, R) of the R ``runs``."""
        check_requests(requests, self._channels * self.rule.by_channel)
        queue = state.queue[:, runs]
        requests = requests * state.admitted[:, runs]
        if self.rule.limited:
            place = queue if state.place is None else state.place[:, runs]
            requests = first_requests(requests, place, self.slots)
        gained = state.draws.harvest if state.token_rate is None else state.token_rate
        gained = None if gained is None else gained[..., runs]
        return self.bucket.grant(state.tokens[..., runs], requests, queue, gained)

    def deliver(
        self, state: NetworkState, requests: NDArray[Any], reads_silence: bool = False
    ) -> tuple[NetworkState, Delivery]:
        """Return the state after the requests of a step, and what is delivered.

        Args:
            state: State before the requests.
            requests: Sensors (l, N) bool, or with an assignment their channels from 1, 0 for none.
            reads_silence: Whether the reception has what silence may mean.
        """
        granted, spent, tokens, queue = self.grant(state, requests)
        lost = self._lost(state, requests, granted)
        left = granted if lost is None else granted & ~lost
        if self.rule.contended:
            frequency = 0 if state.draws.frequency is None else state.draws.frequency
            left = left & ~collisions(granted, frequency, self.options.channels)
        reception, due, supposed = Reception(left), state.due, None
        if self.acknowledgement < 1.0:
            unreported = True if state.draws.unreported is None else state.draws.unreported
            supposed = granted & (left | unreported)
        delay = state.draws.delay
        if due is not None and delay is not None:
            due = np.concatenate(((left * delay)[None], due[:-1]))
            reception = Reception(left & (delay == 0))
        if reads_silence:
            before = state.tokens if self.bucket.sharing == "equal" else state.tokens - spent
            possible = state.admitted & self.bucket.affordable(before)
            if self.rule.limited:
                possible = possible & (granted.sum(0) < self.slots)
            arrival = self.link_probability(state)
            failure = None if arrival is None else 1.0 - arrival[:, 0]
            reception = reception._replace(possible=possible, failure=failure)
        constant = state.true_drop, state.token_rate, state.admitted
        moved = _moved(tokens, queue, due, *constant, state.channel, state.draws.following)
        return moved, Delivery(granted, spent, reception, supposed)

    def _lost(
        self, state: NetworkState, requests: NDArray[Any], granted: NDArray[np.bool_]
    ) -> NDArray[np.bool_] | None:
        """Return whether a packet (l, N) on its channel is lost; ``None`` if none is."""
        probability = self.link_probability(state) if self.rule.by_channel else None
        drawn = state.draws.lost
        if drawn is None or probability is None:
            return drawn
        if requests.dtype == np.bool_:
            requests = assign(granted, state.queue, probability)
        sensor, run = np.ogrid[: self.sensors, : requests.shape[1]]
        lost: NDArray[np.bool_] = drawn.reshape(probability.shape)
        return lost[sensor, requests - 1, run]

    def late(self, state: NetworkState) -> NDArray[np.bool_] | None:
        """Return the packets (D, l, N) of 1, …, D steps ago that arrive now; ``None`` if never.

        Args:
            state: State after :meth:`deliver`, before the next step.
        """
        steps = np.arange(1, self.longest_delay + 1)
        return None if state.due is None else state.due == steps[:, None, None]

    def link_probability(self, state: NetworkState, late: bool = False) -> Array | None:
        """Return the probability (l, k, N) that a packet sent now, alone, arrives now.

        It follows from the channels' state that was fed back; ``None`` is 1. k is the number of
        channels of an assignment, and otherwise 1.

        Args:
            state: State before the requests.
            late: Whether later arrivals count.
        """
        if "lost" not in self._normals and (late or not self.longest_delay):
            return None
        runs = state.queue.shape[-1]
        arrival: Any = np.ones((self.sensors * self._channels, runs))
        if self.channel is not None and state.channel is not None:
            link = np.arange(len(arrival))[:, None]
            loss = (self.channel.transition @ self.channel.drop.T[..., None])[..., 0]
            arrival = 1.0 - namespace(state.channel).asarray(loss)[link, state.channel]
        elif self.channel is not None:
            arrival = arrival - self.channel.drop[0][:, None]
        if self.longest_delay and not late:
            arrival = np.repeat(self.delay[:, :1], self._channels, axis=0) * arrival
        return arrival.reshape(self.sensors, -1, runs)


def _moved(
    tokens: Array,
    queue: Queue,
    due: Any,
    true_drop: Any,
    token_rate: Any,
    admitted: Any,
    channel: Any,
    following: Any,
) -> NetworkState:
    """Return a state without draws of its own, by its constructor, which is faster than a copy."""
    rest = due, true_drop, token_rate, Draws(following)
    return NetworkState(tokens, queue, admitted, channel, None, *rest)


def warn_of_uneven_grants(network: Network) -> None:
    """Warn if the bucket cannot pay for all sensors at once, or favours some of them."""
    bucket, access, sensors = network.bucket, network.options.access, network.sensors
    whole = float(bucket.cost.sum())
    if not bucket.unlimited and not bucket.per_sensor and bucket.capacity < whole:
        warnings.warn(
            f"token_capacity = {bucket.capacity:g} is below {whole:g}, the cost of one packet "
            f"of each of the {sensors} sensors: they cannot all transmit in one step",
            stacklevel=2,
        )
    if access == "round_robin" and bucket.resonates:
        warnings.warn(
            f"token_rate = {bucket.rate:g} and token_cost = {bucket.cost.max():g} with "
            f"access='round_robin' favour some of the {sensors} sensors if all request; "
            "access='any' with sharing='turns' does not",
            stacklevel=2,
        )
    if access in ("round_robin", "random") and bucket.favours_cheaper:
        warnings.warn(
            f"token_rate = {bucket.rate:g} is below token_cost, up to {bucket.cost.max():g}, "
            f"with access={access!r}: a sensor without enough tokens loses its turn, so "
            "dearer sensors get fewer grants; access='any' with sharing='turns' is even",
            stacklevel=2,
        )
