"""Laws of medium access: slots, try-once-discard and collisions."""

from typing import Any

import numpy as np
import pytest
from cases import IDS, QUALITY, each_id, requests, short
from refusals import refused

import fusion_gym
from fusion_gym.core.access import collisions, first_requests, place_of
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.policies.rollout import Imagination
from fusion_gym.validation import ConfigurationError


def task_of(name: str, **options: Any) -> Any:
    """A task of the present version, with tokens without end."""
    env_id = next(env_id for env_id in IDS if short(env_id) == name)
    return fusion_gym.make_task(env_id, **{"tokens": "unlimited"} | options)


# --- slotted ALOHA --------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("rate", [0.05, 0.1, 0.3])
def test_slotted_aloha_delivers_by_its_formula(rate: float, channels: int) -> None:
    """n p (1 - p/k)^(n - 1) packets per step of n sensors on k channels, and all n p are paid."""
    sensors, runs, steps = 12, 400, 60
    task = task_of("RemoteEstimation", sensors=sensors, access="collision", channels=channels)
    policy = make_policy(f"random:rate={rate}", task)
    batch, sent, arrived, tokens = EpisodeBatch.seeded(task, runs, 0), 0, 0, 0.0
    policy.reset(runs, 7)
    for _ in range(steps):
        outcome = batch.step(policy(batch.signals()))
        np.testing.assert_array_equal(outcome.granted, outcome.requested)
        sent, arrived = sent + outcome.granted.sum(), arrived + outcome.arrived.sum()
        tokens += outcome.cost.sum()
    expected = sensors * rate * (1.0 - rate / channels) ** (sensors - 1)
    deviation = 4.0 * np.sqrt(expected / (runs * steps))
    assert arrived / (runs * steps) == pytest.approx(expected, abs=deviation)
    assert sent / (runs * steps) == pytest.approx(sensors * rate, rel=0.02)
    assert tokens == pytest.approx(sent * task.network.bucket.cost[0, 0])


def test_two_packets_on_a_channel_destroy_each_other() -> None:
    granted = np.array([[1, 1, 1, 0], [1, 1, 0, 0], [1, 0, 0, 0]], dtype=bool)
    frequency = np.array([[0, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0]])
    expected = [[0, 1, 0, 0], [1, 1, 0, 0], [1, 0, 0, 0]]
    np.testing.assert_array_equal(collisions(granted, frequency, 2), expected)


def test_a_lone_packet_always_arrives() -> None:
    """Whatever the channel that the network draws for it."""
    task = task_of("CorrelatedTracking", access="collision", channels=2)
    batch = EpisodeBatch.seeded(task, 50, 0)
    for step in range(9):
        lone = np.repeat(np.arange(3)[:, None] == step % 3, 50, axis=1)
        np.testing.assert_array_equal(batch.step(lone).arrived, lone)
        assert batch.arrival_probability() is None


# --- slots ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("slots", [1, 2, 3])
@each_id
def test_slots_grant_as_many_requests_as_there_are(env_id: str, slots: int) -> None:
    """The first in the queue; who always requests is granted as often as any other."""
    sensors = fusion_gym.make_task(env_id).sensors
    if slots > sensors:
        with pytest.raises(ConfigurationError, match=rf"slots = {slots} .* <= {sensors}"):
            fusion_gym.make_task(env_id, access="slots", slots=slots)
        return
    task = fusion_gym.make_task(env_id, access="slots", slots=slots, tokens="unlimited")
    batch, grants = EpisodeBatch.seeded(task, 4, 0), []
    for request in requests(task, 4, 12, rate=0.7):
        queue, available = batch.signals()["queue"].copy(), task.plant.available(batch.state.plant)
        present = request if available is None else request & available[0]
        granted = batch.step(request).granted
        for run in range(4):
            order = [sensor for sensor in np.argsort(queue[:, run]) if present[sensor, run]]
            assert sorted(order[:slots]) == np.flatnonzero(granted[:, run]).tolist()
    if task.plant.available(batch.state.plant) is None:
        everyone = np.ones((sensors, 4), dtype=np.bool_)
        grants = np.cumsum([batch.step(everyone).granted for _ in range(20)], axis=0)
        assert np.ptp(grants, axis=1).max() <= 2


# --- try-once-discard -----------------------------------------------------------------------------


@pytest.mark.parametrize("weights", [1.0, (0.2, 1.0, 5.0)])
@pytest.mark.parametrize("slots", [1, 2])
@pytest.mark.parametrize("kind", ["innovation", "held"])
def test_try_once_discard_grants_the_largest_discrepancies(
    kind: str, slots: int, weights: Any
) -> None:
    """Of those that request, by the sensors' own signals."""
    options = {"discrepancy": kind, "slots": slots, "discrepancy_weights": weights}
    task = task_of("CorrelatedTracking", access="try_once_discard", **options)
    batch, runs = EpisodeBatch.seeded(task, 6, 0), range(6)
    for request in requests(task, 6, 10, rate=0.8):
        signals = batch.signals()
        difference = signals["innovation"]
        if kind == "held":
            difference = signals["measurement"] - signals["held"]
        size = (difference**2).sum(1) * np.broadcast_to(weights, 3)[:, None]
        granted = batch.step(request).granted
        for run in runs:
            asking = np.flatnonzero(request[:, run])
            largest = asking[np.argsort(-size[asking, run])][:slots]
            assert sorted(largest) == np.flatnonzero(granted[:, run]).tolist()


def test_equal_discrepancies_follow_the_queue() -> None:
    queue = np.array([[2], [0], [1]])
    place = place_of(np.array([[3.0], [3.0], [5.0]]), queue)
    np.testing.assert_array_equal(place, [[2], [1], [0]])
    everyone = np.ones((3, 1), dtype=np.bool_)
    np.testing.assert_array_equal(first_requests(everyone, place, 2), [[False], [True], [True]])


def test_a_sensor_that_does_not_learn_of_losses_competes_by_what_it_sent() -> None:
    """Its discrepancy is that of its own last packet, lost or not."""
    lossy = {"channel": "independent", "drop_probability": 0.5, "acknowledgements": "none"}
    task = task_of("RemoteEstimation", sensors=3, **lossy | HELD)
    batch, sent, apart = EpisodeBatch.seeded(task, 40, 0), np.zeros((3, 40)), 0
    everyone = np.ones((3, 40), dtype=np.bool_)
    for _ in range(30):
        signals = batch.signals()
        value, held = signals["measurement"][:, 0], signals["held"][:, 0]
        granted = batch.step(everyone).granted
        np.testing.assert_array_equal(granted.argmax(0), np.abs(value - sent).argmax(0))
        apart += int((np.abs(value - held).argmax(0) != granted.argmax(0)).sum())
        sent = np.where(granted, value, sent)
    assert apart


TURNS, INNOVATION = {"access": "round_robin"}, {"access": "try_once_discard"}
HELD = INNOVATION | {"discrepancy": "held"}
# Mean squared errors of round robin and of both discrepancies at one packet per step.
ROWS = {
    "BiasedTracking": (1.591, 1.668, 1.368),
    "UnknownInput": (0.105, 0.099, 0.098),
    "CorrelatedTracking": (0.573, 0.518, 0.390),
    "BiasedOscillator": (2.99, 2.88, 2.65),
}


@pytest.mark.parametrize("name", ROWS)
def test_try_once_discard_has_its_errors_at_equal_rate(name: str) -> None:
    """And an innovation says more than a difference from the held value."""
    more = {"filter": "adf"} if name == "BiasedOscillator" else {}
    tasks = [task_of(name, **options | more) for options in (TURNS, HELD, INNOVATION)]
    results = [run_episodes(task, make_policy("always", task), 300) for task in tasks]
    means = [item.mse.mean() for item in results]
    errors = [item.mse.std() / 300**0.5 for item in results]
    rates = [item.rate.mean() for item in results]
    assert rates == pytest.approx([rates[0]] * 3)
    for mean, error, expected in zip(means, errors, ROWS[name], strict=True):
        assert mean == pytest.approx(expected, abs=4.0 * error)
    gain = results[1].mse - results[2].mse
    assert gain.mean() > -2.0 * gain.std() / 300**0.5
    assert np.median(results[2].mse) < np.median(results[0].mse)


# --- interfaces -----------------------------------------------------------------------------------

NAMES = ("LinearFusion", "CorrelatedTracking", "RemoteEstimation")
PAIRS: dict[str, Any] = {"access": "assignment", "channels": 2}
LOSSY = PAIRS | {"channel": "independent", "drop_probability": QUALITY}
FADING = PAIRS | {"channel": "gilbert_elliott"}
COLLISION = {"access": "collision", "channels": 2, "channel": "independent"}
CHANNELS = np.array([[2], [1], [2]])  # asked for by number, or left to the network
BACKEND_CASES: list[tuple[str, dict[str, Any], Any]] = [
    *((name, {"access": "slots", "slots": 2}, None) for name in NAMES),
    *((name, INNOVATION, None) for name in NAMES),
    *((name, COLLISION, None) for name in NAMES),
    *((NAMES[2], options, asked) for options in (LOSSY, FADING) for asked in (None, CHANNELS)),
]
EACH_BACKEND = [
    pytest.param(case, marks=pytest.mark.slow if case[0] == "CorrelatedTracking" else ())
    for case in BACKEND_CASES
]


@pytest.mark.parametrize("case", EACH_BACKEND, ids=str)
def test_access_in_compiled_code_is_that_of_numpy(case: tuple[str, dict[str, Any], Any]) -> None:
    pytest.importorskip("llvmlite")
    name, options, asked = case
    more: dict[str, Any] = {"sensors": 3} if name == "RemoteEstimation" else {}
    tasks = [task_of(name, backend=kind, **options | more) for kind in ("numpy", "compiled")]
    batches = [EpisodeBatch.seeded(task, 4, 3) for task in tasks]
    for request in requests(tasks[0], 4, 8, rate=0.8):
        outcomes = [batch.step(request if asked is None else request * asked) for batch in batches]
        for part in ("requested", "granted", "arrived"):
            np.testing.assert_array_equal(*(getattr(outcome, part) for outcome in outcomes))
        np.testing.assert_allclose(*(outcome.error for outcome in outcomes), atol=1e-12)
        np.testing.assert_allclose(*(batch.observe() for batch in batches), atol=1e-6)
    if options["access"] == "assignment":
        refused(lambda: batches[1].step(np.full((3, 4), 3)), "channels from 1 to 2")


def test_simulations_compare_discrepancies_from_their_first_step() -> None:
    """A rollout begins in a network that grants what the present one grants."""
    task = task_of("LinearFusion", access="try_once_discard", memory=True, packet="measurement")
    batch = EpisodeBatch.seeded(task, 5, 0)
    everyone = np.ones((2, 5), dtype=np.bool_)
    imagination = Imagination(task, batch.memory, batch.layout)
    for _ in range(6):
        normals = np.zeros((imagination.channels(1), 5))
        branch, _ = imagination.begin(batch.signals(), np.arange(5), normals)
        granted = batch.step(everyone).granted
        np.testing.assert_array_equal(branch.deliver(everyone).granted, granted)


def test_simulations_refuse_what_sensors_suppose() -> None:
    lossy = {"channel": "independent", "acknowledgements": "none", "memory": True}
    task = task_of("CorrelatedTracking", **lossy)
    with pytest.raises(ConfigurationError, match=r"acknowledgements = 'none' .*simulations"):
        make_policy("rollout:base=never", task)
