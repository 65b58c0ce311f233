"""What the network says of arrivals and silence, and which noise its parts draw from."""

import dataclasses
import operator
from typing import Any

import numpy as np

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch

Options = dict[str, Any]


def test_a_packet_arrives_by_the_channel_and_the_delay() -> None:
    options = {"channel": "gilbert_elliott", "drop_probability": (0.8, 0.1), "delay": (0, 1)}
    matrix = np.array([[0.7, 0.3], [0.1, 0.9]])
    task = fusion_gym.make_task(
        "fusion_gym/LinearFusion-v2", channel_transition=matrix, tokens="unlimited", **options
    )
    signals = EpisodeBatch.seeded(task, 40, 0).signals()
    expected = 0.5 * (1.0 - matrix @ [0.8, 0.1])[signals["channel_state"]]
    np.testing.assert_allclose(signals["arrival_probability"], expected)


def test_what_else_was_possible_is_by_slots_and_tokens() -> None:
    """A silent sensor could have sent if a slot was free, and tokens after the others' packets."""
    options = {"tokens": "limited", "token_cost": 3.0, "initial_tokens": 9.0, "sensors": 3}
    options |= {"token_capacity": 9.0}
    for sharing, slots, expected in (
        ("turns", 1, [False, False, False]),
        ("turns", 2, [True, True, True]),
        ("fixed", 2, [True, True, True]),
        ("equal", 2, [True, True, True]),
    ):
        task = fusion_gym.make_task(
            "fusion_gym/RemoteEstimation-v1",
            access="slots",
            slots=slots,
            sharing=sharing,
            **options,
        )
        network = EpisodeBatch.seeded(task, 1, 0).state.network
        request = np.array([[True], [False], [False]])
        _, delivery = task.network.deliver(network, request, reads_silence=True)
        assert delivery.reception.possible[:, 0].tolist() == expected
        poor = dataclasses.replace(network, tokens=network.tokens - 5.0)
        _, delivery = task.network.deliver(poor, request, reads_silence=True)
        assert not delivery.reception.possible.any()


def test_whose_turn_it_is_and_what_is_lost_have_noise_of_their_own() -> None:
    options = {"access": "random", "channel": "independent", "drop_probability": 0.5, "sensors": 3}
    task = fusion_gym.make_task("fusion_gym/RemoteEstimation-v1", **options)
    state = EpisodeBatch.seeded(task, 50, 0).state.network
    rng, steps = np.random.default_rng(0), np.zeros(50, dtype=np.int64)
    noise = rng.standard_normal((task.network.noise_channels, 50))
    before = task.network.advance(state, noise, steps)
    lost, admitted = (operator.attrgetter(name) for name in ("draws.lost", "admitted"))
    for part, kept, changed in ((slice(1), lost, admitted), (slice(1, None), admitted, lost)):
        other = noise.copy()
        other[part] = rng.standard_normal(other[part].shape)
        after = task.network.advance(state, other, steps)
        np.testing.assert_array_equal(kept(after), kept(before))
        assert (changed(after) != changed(before)).any()
