"""Laws of knowledge: nobody sees the truth, or what others measured and did not send to them."""

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, get_args

import numpy as np
import pytest
from cases import FREE, Array, Case, each_case, each_id, read, requests, skip_closed_loop

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.estimator import Reception
from fusion_gym.core.knowledge import SignalError, Signals, covers
from fusion_gym.core.plant import Plant
from fusion_gym.core.runs import Outcome, Runs
from fusion_gym.core.task import Broadcast, Task
from fusion_gym.envs.registration import present_id
from fusion_gym.envs.views import SensorView
from fusion_gym.fusion.intersection import covariance_intersection
from fusion_gym.validation import ConfigurationError

STEPS = 3


# --- the truth ------------------------------------------------------------------------------------


@dataclasses.dataclass(slots=True)
class Replaced:
    """A plant's state behind other values of its truth."""

    actual: Any
    truth: Array
    measurement: Array


class OtherTruth(Plant[Replaced]):
    """A plant whose measurements stay while its truth is replaced."""

    sensor_count = property(lambda self: self.plant.sensor_count)
    noise_channels = property(lambda self: self.plant.noise_channels)
    start_channels = property(lambda self: self.plant.start_channels)

    def __init__(self, plant: Plant[Any]) -> None:
        self.plant, self.draws = plant, np.random.default_rng(3)
        self.state_names, self.nature = plant.state_names, plant.nature

    def start(self, noise: Array) -> tuple[Replaced, Any]:
        state, announcement = self.plant.start(noise)
        return self._replaced(state), announcement

    def sense(self, state: Replaced, noise: Array) -> Replaced:
        return self._replaced(self.plant.sense(state.actual, noise))

    def available(self, state: Replaced) -> Any:
        return self.plant.available(state.actual)

    def open_loop(self, horizon: int) -> Array:
        return self.plant.open_loop(horizon)

    def _replaced(self, state: Any) -> Replaced:
        other = 1e3 * self.draws.standard_normal(self.plant.truth(state).shape)
        return Replaced(state, other, self.plant.measurement(state))


def leaves(part: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """The arrays of a state, a memory or a tuple of them, by name."""
    if dataclasses.is_dataclass(part):
        parts = {field.name: getattr(part, field.name) for field in dataclasses.fields(part)}
    elif isinstance(part, dict):
        parts = part
    elif isinstance(part, tuple):
        parts = dict(enumerate(part))
    else:
        yield name, part
        return
    for key, value in parts.items():
        yield from leaves(value, f"{name}.{key}")


OF_ERRORS = ("reward", "reward_error", "error", "squared_error", "incorrect_age", "diverged")


def shown(batch: EpisodeBatch, outcome: Outcome | None) -> dict[str, Any]:
    """The estimator's states, signals, observation and infos, without what the error decides."""
    signals = batch.signals()
    beliefs = ("beliefs", "own_beliefs")
    parts = {name: signals[name] for name in signals if name not in beliefs}
    infos = {} if outcome is None else outcome._asdict()
    parts |= {name: value for name, value in infos.items() if name not in OF_ERRORS}
    own = {"estimate": batch.state.estimate, "memory": batch.memory.states, "signal": parts}
    return dict(leaves(own))


@pytest.mark.parametrize("owner", ["scheduler", "own"])
@each_case
def test_nothing_shown_depends_on_the_truth(case: Case, owner: Any) -> None:
    """Neither states of estimators, signals, observation nor infos, behind equal measurements."""
    if owner == "own" and not case.local_memory:
        return
    task = case.task(**FREE)
    skip_closed_loop(task)
    other = dataclasses.replace(task, plant=OtherTruth(task.plant))
    batches = [EpisodeBatch.seeded(own, 3, 0, owner) for own in (task, other)]
    outcomes: list[Outcome | None] = [None, None]
    for request in requests(task, 3, STEPS):
        actual, replaced = map(shown, batches, outcomes)
        assert actual.keys() == replaced.keys()
        for name, value in actual.items():
            np.testing.assert_array_equal(value, replaced[name], err_msg=name)
        outcomes = [batch.step(request) for batch in batches]
        assert outcomes[0] is not None
        assert outcomes[1] is not None
        assert (outcomes[0].error != outcomes[1].error).any()


@each_id
def test_the_centre_is_shown_nothing_of_the_sensors(env_id: str) -> None:
    """Their signals are refused by name; who decides by itself cannot see through the centre."""
    task = fusion_gym.make_task(env_id, information="centre")
    signals, hidden = EpisodeBatch.seeded(task, 2, 0).signals(), 0
    for signal in task.estimator.signals:
        if covers("centre", signal.knowledge):
            assert signal.name in signals
            continue
        assert signal.name not in set(signals)
        with pytest.raises(SignalError, match=f"'{signal.name}'.*information='centre'"):
            signals[signal.name]
        hidden += 1
    assert hidden
    assert "estimate" not in signals
    with pytest.raises(ConfigurationError, match="information = 'centre'"):
        SensorView(task)


# --- what a sensor measured -----------------------------------------------------------------------


@each_case
def test_what_is_measured_and_not_sent_is_its_sensors_own(case: Case) -> None:
    """Groups of runs on one noise, but for one normal each that reaches the measurements of one
    sensor alone. That sensor sends nothing: neither the centre nor another sensor notices."""
    batch = case.batch(1, owner="own" if case.local_memory else None, **FREE)
    task, view = batch.task, SensorView(batch.task) if case.local_memory else None
    channels = np.arange(task.plant.noise_channels)
    reached = np.zeros((task.sensors, len(channels)), dtype=np.bool_)
    for signals, runs in steps(batch, np.append(-1, channels), np.zeros((STEPS, task.sensors, 1))):
        reached |= differs(signals["measurement"], 0)[:, 1:]
        reached &= ~differs(runs.admitted(), 0)[:, 1:].any(0)  # who has a reading is no secret
    groups: list[tuple[int, int, int]] = []  # sensor, first run of its group, changed normal
    for sensor, single in enumerate(reached & (reached.sum(0) == 1)):
        first = len(groups)
        groups += [(sensor, first, c) for c in (-1, *np.flatnonzero(single)[:2].tolist())]
    sensor, base, changed = np.array(groups).T
    others, noticed = np.arange(task.sensors)[:, None] != sensor, False
    sent = requests(task, 1, STEPS) & others[None] & (task.options.packet == "measurement")
    for signals, runs in steps(batch, changed, sent):
        for signal in task.estimator.signals:
            value = signals[signal.name]
            if not covers("centre", signal.knowledge):
                apart = differs(value, base) & others if signal.axes.startswith("(sen") else False
                assert not np.any(apart), signal.name
            else:
                assert not differs(value[None], base).any(), signal.name
        if view is not None:
            rows = view.rows(runs.observe(local=True)).reshape(len(sensor), task.sensors, -1)
            own = [rows.transpose(1, 2, 0)]
            own += [runs.signals()[name] for name in ("own_difference", "own_value")]
            for value in own:
                apart = differs(value, base)
                assert not (apart & others).any()
                noticed |= bool(apart.any())
        elif task.options.information == "centre":
            assert not differs(runs.observe().T[None], base).any()
    assert (changed >= 0).any()
    assert noticed or view is None


def steps(batch: EpisodeBatch, changed: Array, sent: Array) -> Iterator[tuple[Signals, Runs]]:
    """Branches of a run, after each step with requests ``sent`` (steps, sensors, N), on a noise of
    which each has the normal ``changed`` (N,) turned over, or none."""
    runs, draw = batch.branch(np.zeros(len(changed), dtype=np.int64)), np.random.default_rng(1)
    turned = np.flatnonzero(changed >= 0)
    for request in np.broadcast_to(sent, (*sent.shape[:2], len(changed))):
        noise = np.repeat(draw.standard_normal((runs.channels, 1)), len(changed), axis=1)
        noise[changed[turned], turned] *= -1.5
        runs.step(request.astype(np.bool_), noise)
        yield Signals(runs.read()), runs


def differs(value: Array, base: Any) -> Array:
    """Whose values (sensors, …, N) differ from those of the runs ``base``, (sensors, N)."""
    apart = value != (value[..., base] if np.ndim(base) else value[..., :1])
    return np.asarray(apart.reshape(len(value), -1, value.shape[-1]).any(1))


# --- what a delivery brings -----------------------------------------------------------------------


def after(estimator: Any, batch: EpisodeBatch, *sensors: int) -> tuple[Array, Array]:
    """The centre's mean and covariance after the arrival of these packets."""
    arrived = np.zeros((batch.task.sensors, batch.num_envs), dtype=np.bool_)
    arrived[list(sensors)] = True
    updated = estimator.update(batch.state.estimate, Reception(arrived))
    return estimator.mean(updated), estimator.covariance(updated)


def fused_trace(batch: EpisodeBatch, weights: Array, *sensors: int) -> Array:
    """The weighted trace (N,) after these packets."""
    variances = np.einsum("iir->ir", after(batch.task.estimator, batch, *sensors)[1])
    return np.asarray((weights.reshape(-1, 1) * variances).sum(0))


def check_greedy(greedy: Array, trace: Callable[..., Array]) -> None:
    """The best sensors come first, with the trace before each; those without a sample are zero."""
    for run, order in enumerate(np.argsort(-greedy, axis=0).T):
        for place, sensor in enumerate(order):
            if greedy[sensor, run] > 0.0:
                assert greedy[sensor, run] == pytest.approx(trace(*order[:place])[run], rel=1e-7)
                each = [trace(*order[:place], other)[run] for other in order[place:]]
                assert each[0] == pytest.approx(min(each), rel=1e-7)


def deterministic_variance(case: Case) -> bool:
    """Whether covariances do not depend on what is measured, lost, late, or was fused before."""
    settings = case.task().settings
    return (
        "Biased" not in case.env_id
        and settings.get("filter") not in ("adf", "imm", "truncated")
        and settings.get("channel", "perfect") == "perfect"
        and not settings["delay"]
        and not ("UnknownInput" in case.env_id and settings["fusion"] == "ci")
    )


@each_case
def test_variance_signals_are_what_a_delivery_brings(case: Case) -> None:
    """The traces if nobody delivers, if one sensor does, and those before it in greedy order."""
    batch = case.batch(**FREE)
    estimator: Any = batch.task.estimator
    if not deterministic_variance(case) or "variance_reduction" not in read(batch):
        return
    for request in requests(batch.task, 3, 2 * STEPS):
        signals, weights = read(batch), getattr(estimator, "state_weights", np.ones(1))
        assert (weights == 1.0).all() or np.all(weights == batch.task.reward.state_weights.ravel())
        silent = signals["silent_variance"]
        np.testing.assert_allclose(silent, fused_trace(batch, weights), rtol=1e-9)
        each = [fused_trace(batch, weights, sensor) for sensor in range(batch.task.sensors)]
        np.testing.assert_allclose(signals["variance_reduction"], silent - each, 1e-7, 1e-9)
        if "greedy_variance" in signals:
            prior, greedy = signals["prior_covariance"], np.array(signals["greedy_variance"])
            np.testing.assert_array_equal(prior, after(estimator, batch)[1])
            np.testing.assert_allclose(greedy.max(0), signals["centre_variance"], rtol=1e-9)
            check_greedy(greedy, partial(fused_trace, batch, np.ones_like(weights)))
        batch.step(request)


# Filters that are exact, or nearly: the input of the second is one that its filter knows.
EXACT: list[tuple[str, dict[str, Any]]] = [
    ("TobitOscillator", {"filter": "kalman", "censoring_threshold": -np.inf}),
    (
        "UnknownInput",
        {"input_signal": "random_walk", "input_amplitude": 0.7, "input_period": 10.0}
        | {"input_memory": np.exp(-0.1), "input_change": 0.7 * (1.0 - np.exp(-0.2)) ** 0.5}
        | {"input_deviation": 0.7},
    ),
    ("CorrelatedTracking", {}),
    *(("MarkovJumpTracking", {"filter": kind}) for kind in ("local", "centralised", "imm")),
    ("BiasedOscillator", {"filter": "adf"}),
    ("BiasedTracking", {}),
    ("LinearFusion", {}),
    ("RemoteEstimation", {"coefficient": 0.9, "initial_deviation": 3.0}),
]


@pytest.mark.parametrize(("name", "options"), EXACT)
def test_innovations_have_the_variance_that_is_claimed(name: str, options: dict[str, Any]) -> None:
    """Under random requests: the mean square of each channel that is sampled at a step is 1."""
    task = fusion_gym.make_task(present_id(name), **options)
    batch, squares = EpisodeBatch.seeded(task, 8000, 0), []
    for request in requests(task, 8000, 12, rate=0.3):
        signals = read(batch)
        deviation = np.broadcast_to(signals["innovation_deviation"], signals["innovation"].shape)
        unknown = (deviation < 1e-6) | ~np.array(signals.get("sampled", request | True))[:, None]
        assert np.abs(signals["innovation"][deviation < 1e-9]).max(initial=0.0) < 1e-6
        whitened = np.ma.array(signals["innovation"] / np.maximum(deviation, 1e-9), mask=unknown)
        squares.append((whitened**2).mean(-1).compressed())
        batch.step(request)
    every = np.concatenate(squares)
    np.testing.assert_allclose(every, 1.0, atol=0.07)  # a standard error is about 0.016
    assert every.mean() == pytest.approx(1.0, abs=0.015)


# --- beliefs --------------------------------------------------------------------------------------


def joined(item: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
    """By covariance intersection."""
    fused = covariance_intersection(*item, *other)
    return fused.mean, fused.covariance


class Beside:
    """A batch, and plain ones on its seeds whose packets follow from its grants."""

    def __init__(self, task: Task, owner: Any) -> None:
        self.task, self.owner = task, owner
        self.batch = EpisodeBatch.seeded(task, 3, 4, owner)
        self.others: list[tuple[EpisodeBatch, Callable[[Array], Array]]] = []

    def add(self, estimator: Any, sent: Callable[[Array], Array]) -> EpisodeBatch:
        """One with this filter that gets the packets ``sent`` (sensors, N)."""
        options = dataclasses.replace(self.task.options, memory=False, memory_filter=None)
        plain = dataclasses.replace(
            self.task, estimator=estimator, options=options, memory_estimator=None
        )
        self.others.append((EpisodeBatch.seeded(plain, 3, 4), sent))
        return self.others[-1][0]

    def step(self, request: Array) -> None:
        """All move on."""
        granted = self.batch.step(request).granted
        for other, sent in self.others:
            other.step(sent(granted))


@pytest.mark.parametrize("broadcast", get_args(Broadcast))
@each_id
def test_a_sensor_believes_by_what_it_measured_and_received(env_id: str, broadcast: str) -> None:
    """x*, x̂ and x̂(s) are estimates of runs in which just that is delivered."""
    more = {"filter": "tobit"} if "TobitOscillator" in env_id else {}
    if broadcast == "none" and fusion_gym.make_task(env_id, **more).feedback:
        with pytest.raises(ConfigurationError, match="broadcast = 'none'"):
            fusion_gym.make_task(env_id, broadcast=broadcast)
        return
    task = fusion_gym.make_task(env_id, memory=True, broadcast=broadcast, **FREE, **more)
    skip_closed_loop(task)
    beside, own, single, packets = Beside(task, "own"), [], [], broadcast == "packets"
    for itself in (np.arange(task.sensors)[:, None] == s for s in range(task.sensors)):
        if task.memory_estimator is not None:
            own.append(beside.add(task.memory_estimator, lambda g, i=itself: (g & packets) | i))
        single.append(beside.add(task.estimator, lambda g, i=itself: g & i))
    distant = broadcast == "none" or (broadcast == "estimate" and not task.feedback)
    for request in requests(task, 3, STEPS):
        batch = beside.batch
        signals = batch.signals()
        for sensor in range(task.sensors):
            centre = single[sensor] if broadcast == "none" else batch
            silent = after(task.estimator, centre)
            sent = after(task.estimator, single[sensor] if distant else batch, sensor)
            if broadcast == "estimate" and distant:
                sent = joined(silent, sent)
            best = sent
            if own:
                best = after(task.memory_estimator, own[sensor], sensor)
                if broadcast == "estimate":
                    best = joined(sent if task.feedback else silent, best)
            check(signals["own_difference"][sensor], best[0] - silent[0])
            value = worth(task, best[0], silent[0], sent[0]) * chance(batch)[sensor]
            check(signals["own_value"][sensor], value)
        beside.step(request)


@each_id
def test_a_scheduler_believes_by_everything_measured(env_id: str) -> None:
    """x* is the estimate of runs in which everything is delivered."""
    more = {"filter": "tobit"} if "TobitOscillator" in env_id else {}
    task = fusion_gym.make_task(env_id, memory=True, **FREE, **more)
    skip_closed_loop(task)
    beside = Beside(task, "scheduler")
    whole = (
        beside.add(task.memory_estimator, lambda granted: granted | True)
        if task.memory_estimator
        else None
    )
    for request in requests(task, 3, STEPS):
        batch = beside.batch
        most = (task.estimator, batch) if whole is None else (task.memory_estimator, whole)
        best = after(*most, *range(task.sensors))[0]
        silent = after(task.estimator, batch)
        check(batch.signals()["belief_difference"], best - silent[0])
        for sensor in range(task.sensors):
            sent = after(task.estimator, batch, sensor)
            value = worth(task, best, silent[0], sent[0]) * chance(batch)[sensor]
            check(batch.signals()["transmission_value"][sensor], value)
        beside.step(request)


def worth(task: Task, best: Array, silent: Array, sent: Array) -> Array:
    """By how much a packet brings the centre nearer to x*, in weights of mean 1."""
    weights = task.reward.state_weights / task.reward.state_weights.mean()
    return np.asarray((weights * ((best - silent) ** 2 - (best - sent) ** 2)).sum(0))


def chance(batch: EpisodeBatch) -> Array:
    """Probability (sensors, N) that a packet sent now arrives."""
    arrival = batch.arrival_probability()
    return np.ones((batch.task.sensors, batch.num_envs)) if arrival is None else arrival


def check(values: Array, expected: Array) -> None:
    """To rounding."""
    np.testing.assert_allclose(values, expected, rtol=1e-9, atol=1e-9)
