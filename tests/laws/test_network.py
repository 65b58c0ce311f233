"""Laws of the network: who is served, what it costs, what the reward pays."""

import dataclasses

import numpy as np
import pytest
from cases import IDS, SCARCE, Case, Options, each_case, each_id, read, requests, short

import fusion_gym
from fusion_gym.core.access import ACCESS
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

STEPS = 6
THREE = {
    "LinearFusion": {"measurement_matrices": [[1, 0], [0, 1], [1, 1]]},
    "RemoteEstimation": {"sensors": 3},
    "RecordedFusion": {"source": "normal"},
}
NOT_ADOPTING = ("MarkovJumpTracking", "UnknownInput", "RemoteEstimation", "RandomWalk")


@each_case
def test_a_denied_request_changes_nothing(case: Case) -> None:
    """What follows is bitwise what follows without it."""
    batch, denied = case.batch(**SCARCE), 0
    for request in requests(batch.task, 3, STEPS, rate=0.8):
        grantable, other = batch.grantable(), batch.branch()
        assert not (batch.answer(request).granted & ~grantable).any()
        outcome = batch.step(request)
        denied += int((request & ~outcome.granted).sum())
        result = other.step(outcome.granted, batch.normals())
        for name in set(outcome._fields) - {"requested"}:
            np.testing.assert_array_equal(getattr(result, name), getattr(outcome, name), name)
        np.testing.assert_array_equal(other.observe(), batch.observe())
        np.testing.assert_array_equal(other.tokens, batch.tokens)
    assert denied


@each_case
def test_grantable_is_what_the_network_grants_alone(case: Case) -> None:
    for scarce in ({}, SCARCE | {"token_cost": 4.0}, SCARCE | {"sharing": "fixed"}):
        batch = case.batch(**scarce)
        for request in requests(batch.task, 3, STEPS, rate=0.8):
            grantable = batch.grantable()
            for sensor, single in enumerate(np.eye(batch.task.sensors, dtype=np.bool_)):
                alone = np.repeat(single[:, None], 3, axis=1)
                granted = batch.answer(alone).granted[sensor]
                np.testing.assert_array_equal(granted, grantable[sensor])
            batch.step(request)


@pytest.mark.parametrize("access", ACCESS)
@each_id
def test_only_who_is_admitted_is_granted(env_id: str, access: str) -> None:
    """With tokens without end, exactly those that are admitted and ask."""
    task = fusion_gym.make_task(env_id, access=access, tokens="unlimited")
    batch, turns = EpisodeBatch.seeded(task, 40, 0), np.zeros(task.sensors)
    for step, target in enumerate(np.random.default_rng(0).random((STEPS, task.sensors, 40)) < 0.7):
        admitted = batch.signals()["admitted"]
        available = task.plant.available(batch.state.plant)
        sampled = True if available is None else available[0]
        granted = batch.step(target).granted
        if ACCESS[access].limited:
            np.testing.assert_array_equal(granted.sum(0), (target & sampled).any(0))
            assert not (granted & ~target).any()
            continue
        np.testing.assert_array_equal(granted, target & admitted)
        turns += admitted.sum(1)
        if available is not None:
            assert not (admitted & ~sampled).any()
            continue
        if access == "round_robin":
            assert (admitted == (np.arange(task.sensors) == step % task.sensors)[:, None]).all()
        else:
            assert (admitted.sum(0) == (1 if ACCESS[access].turn else task.sensors)).all()
    if access == "random" and available is None:
        mean = turns.sum() / task.sensors
        assert (np.abs(turns - mean) < 4.0 * np.sqrt(mean) * (task.sensors > 1) + 1e-9).all()


@pytest.mark.parametrize("rate", [0.5, 1.0, 2.0, 4.5])
@each_id
def test_sensors_that_request_alike_are_granted_alike(env_id: str, rate: float) -> None:
    """In every window their grants differ by at most one, by default and with one grant a step."""
    if "Dropouts" in env_id:  # who has a reading asks
        return
    batch = Case(env_id, THREE.get(short(env_id), {})).batch(**SCARCE | {"token_rate": rate})
    for access in ("any", "single"):
        task = batch.task.with_options(access=access)
        for name in ("always", "round_robin"):
            policy, batch = make_policy(name, task), EpisodeBatch.seeded(task, 1, 0)
            grants = np.array([batch.step(policy(batch.signals())).granted for _ in range(60)])
            ahead = np.cumsum(grants[:, :, None] * 1 - grants[:, None], axis=0)
            assert (np.ptp(np.concatenate((0 * ahead[:1], ahead)), axis=0) <= 1).all()
            assert grants.any(0).all()


@each_case
def test_only_grants_cost_tokens_and_the_balance_closes(case: Case) -> None:
    for scarce in ({}, SCARCE):
        batch = case.batch(**scarce)
        selection, cost = batch.task.settings, batch.signals()["token_cost"][:, 0]
        rate, capacity = selection["token_rate"], selection["token_capacity"]
        for request in requests(batch.task, 3, STEPS):
            network, own = batch.state.network, selection["budget"] == "sensor"
            before, gained = network.energy.copy(), network.draws.harvest
            gained = gained if network.token_rate is None else network.token_rate
            outcome = batch.step(request)
            assert not (outcome.granted & ~request).any()
            np.testing.assert_allclose(outcome.cost, cost @ outcome.granted)
            if selection["tokens"] == "limited":
                spent = outcome.granted * cost[:, None] if own else outcome.cost
                assert (before + 1e-9 >= spent).all()
                gained = np.reshape(rate, (-1, 1)) if gained is None else gained
                before = np.minimum(capacity, before - spent + gained)
            total = before.sum(0) if own else before[0]
            np.testing.assert_allclose(batch.signals()["energy"], before, atol=1e-9)
            np.testing.assert_allclose(batch.signals()["tokens"], total, atol=1e-9)


@each_case
def test_the_reward_is_minus_weighted_error_and_price(case: Case) -> None:
    batch = case.batch()
    task, selection, price = batch.task, batch.task.settings, batch.signals()["price"].copy()
    if selection["cost_weight"] == "random":
        assert len(set(price)) == 3
        assert (np.array(selection["price_range"])[[0]] <= price).all()
        assert (np.array(selection["price_range"])[[1]] >= price).all()
    else:
        assert (price == selection["cost_weight"]).all()
    for request in requests(task, 3, STEPS):
        outcome = batch.step(request)
        truth, estimate, *_ = batch.delivered
        covariance = task.estimator.covariance(estimate)
        actual = task.plant.truth(truth) - task.estimator.mean(estimate)
        if (available := task.plant.available(truth)) is not None:
            actual *= available[1]
        np.testing.assert_allclose(outcome.error, actual)
        size = outcome.error**2
        if selection["error"] == "trace":
            size = np.einsum("iir->ir", covariance)
        if selection.get("intersample_error"):  # of the steps between samples, too
            continue
        weighted = task.reward.state_weights * size
        error = weighted.max(0) if selection["error"] == "maximum" else weighted.sum(0)
        if task.objective == "control":
            error = task.reward.control_scale * outcome.control_cost
        np.testing.assert_allclose(outcome.reward_error, -selection["error_weight"] * error)
        np.testing.assert_allclose(outcome.reward_communication, -price * outcome.cost)
        np.testing.assert_array_equal(
            outcome.reward, outcome.reward_error + outcome.reward_communication
        )
        np.testing.assert_array_equal(batch.signals()["price"], price)


@each_case
def test_a_delivery_begins_age_and_held_value_anew(case: Case) -> None:
    """And nothing else does. A packet may be lost, or hold nothing where nothing is sampled."""
    if "delay" in case.options:
        return
    batch = case.batch()
    deliveries = 0
    for request in requests(batch.task, 3, STEPS):
        before = read(batch)
        age, new, held = (np.copy(before[name]) for name in ("age", "measurement", "held"))
        arrived = batch.step(request).arrived
        after = read(batch)
        fresh = arrived & (after["age"] == 1)
        assert fresh[arrived & before.get("sampled", True)].all()
        assert (after["age"][~fresh] == age[~fresh] + 1).all()
        sent = np.broadcast_to(fresh[:, None], held.shape)
        np.testing.assert_array_equal(after["held"], np.where(sent, new, held))
        deliveries += int(fresh.sum())
    assert deliveries


@each_id
def test_an_estimate_is_adopted_where_a_packet_arrives(env_id: str) -> None:
    """Where requests are denied or nobody asks, the centre goes on by itself."""
    more = {"filter": "tobit"} if "TobitOscillator" in env_id else {}
    options = {"memory": True, "packet": "estimate"} | SCARCE | more
    if short(env_id) in NOT_ADOPTING:
        with pytest.raises(ConfigurationError, match="packet = 'estimate'"):
            fusion_gym.make_task(env_id, **options)
        return
    task = fusion_gym.make_task(env_id, **options)
    batch, denied, adopted = EpisodeBatch.seeded(task, 3, 5), 0, 0
    for request in requests(task, 3, 2 * STEPS, rate=0.7):
        best, silent = batch.beliefs().best, batch.beliefs().silent
        granted = batch.step(request).granted.any(0)
        estimate = batch.delivered.estimate
        mean, covariance = task.estimator.mean(estimate), task.estimator.covariance(estimate)
        np.testing.assert_allclose(mean, np.where(granted, best.mean[0], silent.mean[0]))
        expected = np.where(granted, best.covariance[0], silent.covariance[0])
        np.testing.assert_allclose(covariance, expected, atol=1e-12)
        adopted += int((granted & (best.mean[0] != silent.mean[0]).any(0)).sum())
        denied += int((request.any(0) & ~granted).sum())
    assert denied
    assert adopted


UNCERTAIN: list[Options] = [
    {"channel": "independent", "true_drop_probability": (0.1, 0.9)},
    {"channel": "gilbert_elliott"},
    {"access": "collision", "channels": 2},
    {"delay": (0, 3)},
    {"budget": "sensor", "harvest": "bernoulli"} | SCARCE,
]


@pytest.mark.parametrize("options", UNCERTAIN, ids=lambda options: next(iter(options)))
@each_id
def test_nothing_shown_knows_what_becomes_of_the_next_packet(env_id: str, options: Options) -> None:
    """Neither its loss, its delay, its channel, the true probability of a loss nor the harvest."""
    more: Options = THREE.get(short(env_id), {}) if "channels" in options else {}
    if "channels" in options and "RandomWalk" in env_id:  # one sensor has one channel
        return
    task = fusion_gym.make_task(env_id, **{"tokens": "unlimited"} | options | more)
    batch = EpisodeBatch.seeded(task, 60, 0)
    for request in requests(task, 60, 4):
        batch.step(request)
    branch, everyone = batch.branch(), np.ones((task.sensors, 60), dtype=np.bool_)
    noise = np.random.default_rng(1).standard_normal((task.network.draw_channels, 60))
    network = dataclasses.replace(branch.state.network)
    if network.true_drop is not None:
        network.true_drop = 1.0 - network.true_drop
    branch.state = branch.state._replace(network=task.network.draw(network, noise))
    assert set(batch.signals()) == set(branch.signals())
    for name in set(batch.signals()) - {"beliefs", "estimate", "observation"}:
        np.testing.assert_array_equal(batch.signals()[name], branch.signals()[name], err_msg=name)
    np.testing.assert_array_equal(batch.observe(), branch.observe())
    np.testing.assert_array_equal(batch.grantable(), branch.grantable())
    fates = [(runs.deliver(everyone).arrived, runs.delivered.network.energy)
             for runs in (batch, branch)]  # fmt: skip
    assert any((one != two).any() for one, two in zip(*fates, strict=True))


def test_every_environment_is_under_the_laws() -> None:
    assert set(fusion_gym.envs.registration.ENVIRONMENTS) == set(IDS)
