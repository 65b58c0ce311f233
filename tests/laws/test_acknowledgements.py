"""What sensors know of their packets without acknowledgements."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from cases import FREE, requests
from numpy.typing import NDArray

import fusion_gym
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.knowledge import covers
from fusion_gym.core.network import Network, NetworkState
from fusion_gym.core.task import Task
from fusion_gym.envs.privileged import PrivilegedVecEnv
from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.envs.views import SensorView
from fusion_gym.evaluation import run_episodes
from fusion_gym.policies.base import decide, owner_of
from fusion_gym.policies.registry import make_policy, policy_names
from fusion_gym.validation import ConfigurationError

Array = NDArray[Any]
LOSSY = {"channel": "independent", "drop_probability": 0.4}
LOCAL = ["RemoteEstimation", "CorrelatedTracking", "UnknownInput", "MarkovJumpTracking"]
each_local = pytest.mark.parametrize("name", LOCAL)
each_probability = pytest.mark.parametrize("probability", ["none", 0.5])


def present(name: str) -> str:
    """The id of the present version."""
    return next(env_id for env_id in ENVIRONMENTS if f"/{name}-" in env_id)


def make(name: str, acknowledgements: Any, **options: Any) -> Task:
    """A task in which packets are lost."""
    more = LOSSY | {"acknowledgements": acknowledgements} | options
    return fusion_gym.make_task(present(name), **more)


class OtherLosses(Network):
    """A network that differs in all losses that no sensor learns of."""

    def draw(self, state: NetworkState, noise: Array) -> NetworkState:
        """Lose what arrives, and the reverse."""
        drawn = super().draw(state, noise)
        draws = drawn.draws
        assert draws.lost is not None
        unreported = True if draws.unreported is None else draws.unreported
        return replace(drawn, draws=replace(draws, lost=draws.lost ^ unreported))


def other(task: Task) -> Task:
    """The task with other losses."""
    result = replace(task)
    vars(result)["network"] = OtherLosses(task.options, task.sensors)
    return result


@pytest.mark.parametrize("memory", [False, True])
@each_probability
@each_local
def test_a_sensor_notices_no_loss_of_which_nobody_tells(
    name: str, probability: Any, memory: bool
) -> None:
    """Its observation, signals, masks and infos are the same; the centre's are not."""
    task = make(name, probability, memory=memory, **FREE)
    envs = [fusion_gym.FusionParallelEnv(part) for part in (task, other(task))]
    batches = [EpisodeBatch.seeded(part, 4, 3, "own") for part in (task, other(task))]
    signals = [signal for signal in task.estimator.signals if signal.known_to("own")]
    names = {signal.name for signal in signals} | {"own_difference", "own_value", "grantable"}
    seen = [env.reset(seed=3) for env in envs]
    view, apart = SensorView(task), False
    for request in requests(task, 4, 8):
        np.testing.assert_equal(*seen)
        nodes = [batch.signals().nodes for batch in batches]
        for signal in names:
            np.testing.assert_array_equal(*(part[signal] for part in nodes if part is not None))
        rows = [view.rows(batch.observe(local=True)) for batch in batches]
        np.testing.assert_array_equal(*rows)
        selection = dict(zip(envs[0].agents, request[:, 0].astype(int), strict=True))
        both = [env.step(selection) for env in envs]
        seen = [(result[0], result[-1]) for result in both]
        outcomes = [batch.step(request) for batch in batches]
        apart |= bool((outcomes[0].arrived != outcomes[1].arrived).any())
    assert apart
    assert (batches[0].observe() != batches[1].observe()).any()


@each_local
def test_with_acknowledgements_a_sensor_notices_a_loss(name: str) -> None:
    task = fusion_gym.make_task(present(name), **LOSSY | FREE)
    batch = EpisodeBatch.seeded(task, 4, 3)
    for request in requests(task, 4, 8, rate=0.9):
        outcome = batch.step(request)
        assert batch.signals().nodes is None
        age = batch.signals()["age"]
        assert (age[outcome.arrived] == 1).all()
        assert (age[outcome.granted & ~outcome.arrived] > 1).all()


@each_probability
@each_local
def test_no_rule_of_a_sensor_notices_a_loss_of_which_nobody_tells(
    name: str, probability: Any
) -> None:
    """Every rule that a sensor can follow requests the same."""
    task = make(name, probability, horizon=12, **FREE)
    followed = 0
    for rule in policy_names():
        try:
            policy = make_policy(rule, task)
        except ConfigurationError:
            continue
        if covers(policy.knowledge, "centre") or policy.knowledge == "clock":
            continue
        each = []
        for part in (task, other(task)):
            batch, selected = EpisodeBatch.seeded(part, 3, 1, owner_of(policy)), []
            for request in decide(policy, batch, 1):
                selected.append(request)
                batch.step(request)
            each.append(np.array(selected))
        np.testing.assert_array_equal(*each, err_msg=rule)
        followed += 1
    assert followed >= 3


@each_probability
def test_alternatives_in_training_have_what_the_sensors_suppose(probability: Any) -> None:
    task = make("RemoteEstimation", probability, sensors=2, **FREE)
    env = PrivilegedVecEnv(task, 5, local=True)
    env.seed(3)
    env.reset()
    for request in requests(task, 5, 6):
        branch, silent = env.batch.branch(), np.zeros_like(request)
        (rows, *_), branched = env.step_alternatives(
            request.T.ravel().astype(int), np.stack([request, silent])
        )
        branch.step(silent, env.batch.normals())
        for row, expected in ((0, rows), (1, env.view.rows(branch.observe(local=True)))):
            np.testing.assert_array_equal(env.view.rows(branched.observation[row]), expected)


@pytest.mark.parametrize("probability", [0.0, 0.3, 1.0])
def test_a_sensor_supposes_what_it_is_not_told(probability: float) -> None:
    """It holds its last packet but for those that it knows to be lost, 1 - p q of them."""
    task = make("RemoteEstimation", probability, sensors=2, **FREE)
    batch, sent, supposed = EpisodeBatch.seeded(task, 300, 0), 0, 0
    held = np.zeros((2, 300))
    for request in requests(task, 300, 40):
        value = batch.signals()["measurement"][:, 0]
        outcome = batch.step(request)
        nodes = batch.signals().nodes or batch.signals()
        new = nodes["age"] == 1
        assert (new >= outcome.arrived).all()
        assert (new <= outcome.granted).all()
        held = np.where(new, value, held)
        np.testing.assert_array_equal(nodes["held"][:, 0], held)
        sent, supposed = sent + outcome.granted.sum(), supposed + new.sum()
    assert supposed / sent == pytest.approx(1.0 - 0.4 * probability, abs=0.015)


def test_send_on_delta_without_acknowledgements_goes_by_what_it_sent() -> None:
    """It sends less and errs more than a rule that learns of its losses."""
    results = []
    for acknowledgements in ("perfect", "none"):
        task = make("RemoteEstimation", acknowledgements, **FREE)
        results.append(run_episodes(task, make_policy("send_on_delta:threshold=1.0", task), 200))
    perfect, none = results
    assert none.rate.mean() < 0.95 * perfect.rate.mean()
    assert none.mse.mean() > 1.1 * perfect.mse.mean()


@pytest.mark.parametrize(
    ("name", "options", "reason"),
    [
        ("LinearFusion", {}, "broadcast='estimate' acknowledges"),
        ("TobitOscillator", {}, "broadcast='estimate' acknowledges"),
        ("RemoteEstimation", {"broadcast": "packets"}, "broadcast='packets' acknowledges"),
        ("RemoteEstimation", {"channel": "perfect", "drop_probability": None}, "no packet is lost"),
        ("RemoteEstimation", {"acknowledgements": 1.2}, "acknowledgements = 1.2"),
        ("RemoteEstimation", {"acknowledgements": "some"}, "'perfect', 'none' or a number"),
        ("MarkovJumpTracking", {"filter": "imm"}, "innovation needs the packets of all"),
        (
            "RemoteEstimation",
            {"filter": "truncated", "trigger": "send_on_delta", "trigger_threshold": 1.0},
            "innovation needs the packets",
        ),
    ],
)
def test_what_acknowledges_by_itself_is_refused(
    name: str, options: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ConfigurationError, match=reason):
        fusion_gym.make_task(present(name), **LOSSY | {"acknowledgements": "none"} | options)
