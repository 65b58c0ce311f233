"""Policies look at nothing outside the class that they declare: it is changed, requests are not.

A policy's copies watch the same episodes, and each is shown other values of what it must not know;
the network answers to the policy itself. Other values come from the system: the same delivered
state, moved and measured with other noise.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import fusion_gym
from fusion_gym import zoo
from fusion_gym.arrays import merge_runs, take_runs
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.core.beliefs import Beliefs
from fusion_gym.core.memory import Memory, Owner, Shadows
from fusion_gym.core.signals import MEMORY_SIGNALS
from fusion_gym.core.system import Knowledge, Signals, covers
from fusion_gym.core.task import Task
from fusion_gym.policies import registry
from fusion_gym.policies.base import Policy, Rule, owner_of
from fusion_gym.policies.registry import make_policy, policy_names, register_policy
from fusion_gym.validation import ConfigurationError

Values = dict[str, Any]
RUNS, STEPS = 6, 10

ENVIRONMENTS: dict[str, tuple[str, Values]] = {
    "tobit": ("TobitOscillator-v0", {"filter": "tobit", "random_start": True}),
    "tobit, centre": ("TobitOscillator-v0", {"filter": "tobit", "information": "centre"}),
    "correlated": ("CorrelatedTracking-v0", {"token_rate": 1.0}),
    "markov": ("MarkovJumpTracking-v0", {"token_rate": 1.0}),
    "markov, imm": ("MarkovJumpTracking-v0", {"filter": "imm", "tokens": "unlimited"}),
    "unknown input": ("UnknownInput-v0", {"token_rate": 0.5}),
    "biased": ("BiasedTracking-v0", {"access": "random"}),
    "remote, losses": (
        "RemoteEstimation-v0",
        {"sensors": 2, "cost_weight": 3.0, "channel": "gilbert_elliott"},
    ),
    "remote, one link": (
        "RemoteEstimation-v0",
        {"sensors": 2, "cost_weight": 0.3, "access": "single", "noise_deviation": (1.0, 1.5)},
    ),
}
# What a sensor remembers and hears, and what a coordinator does.
REMEMBERING: dict[str, tuple[str, Values]] = {
    "tobit, memory": ("TobitOscillator-v0", {"filter": "tobit", "memory": True}),
    "biased, memory, estimates": ("BiasedTracking-v0", {"memory": True, "packet": "estimate"}),
    "correlated, memory, told": (
        "CorrelatedTracking-v0",
        {"token_rate": 1.0, "memory": True, "broadcast": "estimate"},
    ),
    "correlated, memory, overheard": (
        "CorrelatedTracking-v0",
        {"token_rate": 1.0, "memory": True, "broadcast": "packets"},
    ),
    "correlated, told": ("CorrelatedTracking-v0", {"token_rate": 1.0, "broadcast": "estimate"}),
    "remote, losses, memory": (
        "RemoteEstimation-v0",
        {"sensors": 2, "channel": "gilbert_elliott", "memory": True},
    ),
}
# Policies that look at what is believed are tried where that differs.
BELIEVING = (
    "estimate_difference", "kullback_leibler", "lookahead", "rollout", "value_of_information",
)  # fmt: skip
BELIEVED = (*REMEMBERING, "tobit", "tobit, centre", "correlated", "remote, one link")
POLICIES: dict[str, list[str]] = {
    "adaptive_innovation": ["", "threshold=3,sensitivity=0.9", "sensitivity=0"],
    "adaptive_threshold": ["", "scale=20,rho_initial=0", "rho_bar=0.5,rho_initial=0.5"],
    "always": [""],
    "centre_variance": ["threshold=0.5", "threshold=0.5,at_most=1"],
    "dynamic_event": ["threshold=1,decay=0.9", "threshold=0.3,decay=0"],
    "estimate_difference": ["threshold=0.3", "threshold=1,whitened=true,own=true"],
    "information_gain": ["threshold=0.1", "threshold=0.02,at_most=none"],
    "innovation_threshold": [
        "",
        "threshold=0.7,whitened=true",
        "threshold=0.5,at_most=1",
        "threshold=0.3,whitened=true,at_most=2",
    ],
    "kullback_leibler": ["threshold=0.3,at_most=1", "threshold=0.3,own=true"],
    "local_variance": ["", "m=0.3"],
    "lookahead": ["price=0.02,steps=1"],
    "model": [f"{zoo.model_path('tobit_oscillator_sensors')}"],
    "never": [""],
    "optimal": ["", "criterion=average"],
    "paced": ["rate=0.3"],
    "periodic": ["", "period=3,staggered=false"],
    "periodic_optimum": ["packets=2,period=2"],
    "random": ["rate=0.4"],
    "rollout": ["samples=2,steps=1,base=innovation_threshold:threshold=0.5"],
    "round_robin": ["", "period=2"],
    "send_on_delta": ["", "threshold=0.4"],
    "stochastic_event": ["", "weight=0.4,whitened=true"],
    "value_of_information": [
        "threshold=0.03,at_most=1",
        "price=0.003,steps=3",
        "threshold=0.03,own=true",
    ],
    "variance_threshold": ["threshold=0.2", "threshold=0.4,at_most=none"],
    "whittle": ["", "at_most=1"],
    "zoo": [f"tobit_oscillator_{mode}" for mode in ("sensors", "local", "centre")],
}
CLOCK = ("step", "start", "token_cost")  # all runs know the costs, which never change
TOLD = (*CLOCK, "tokens", "price")


@functools.cache
def task_of(name: str) -> Task:
    env_id, options = (ENVIRONMENTS | REMEMBERING)[name]
    return fusion_gym.make_task(f"fusion_gym/{env_id}", **options)


# --- other values of what must not matter -------------------------------------------------------


class Believed:
    """Beliefs as plain arrays (…, N), so that some of them can be changed, beside the states that
    they were made of."""

    parts = ("difference", "best", "silent", "sent")
    states = ("remembered", "shadows")

    def __init__(self, values: Values, made_of: Values) -> None:
        self.values, self.made_of = values, made_of

    @classmethod
    def of(cls, beliefs: Any, steps: int) -> Believed:
        """All that a policy may ask of beliefs, over so many steps."""
        values = {name: getattr(beliefs, name) for name in cls.parts}
        made_of = {name: getattr(beliefs, name) for name in cls.states if beliefs.task.shadow}
        return cls(values | {"value": beliefs.value(steps), "loss": beliefs.loss(steps)}, made_of)

    def with_each(self, change: Callable[..., Any], *others: Believed) -> Believed:
        """``change`` of every array, and of the others' of the same name."""
        result: Values = {}
        for name, value in self.values.items():
            parts = (value, *(other.values[name] for other in others))
            if isinstance(value, tuple):
                result[name] = type(value)(*(change(*same) for same in zip(*parts, strict=True)))
            else:
                result[name] = change(*parts)
        return Believed(result, self.made_of)

    def __getattr__(self, name: str) -> Any:
        if name in self.parts:
            return self.values[name]
        if name in self.states:
            return self.made_of.get(name, Shadows())
        raise AttributeError(name)

    def value(self, steps: int = 1) -> Any:
        """As of the beliefs."""
        return self.values["value"]

    def loss(self, steps: int = 1) -> Any:
        """As of the beliefs."""
        return self.values["loss"]


def read(signals: Signals, policy: Any) -> Values:
    """All signals; what is believed only for a policy that looks at it, for it takes long."""
    beliefs = ("beliefs", "own_beliefs", *(signal.name for signal in MEMORY_SIGNALS))
    believes, steps = owner_of(policy) is not None, getattr(policy, "steps", 1)
    found: Values = {name: signals[name] for name in signals if believes or name not in beliefs}
    return {n: Believed.of(v, steps) if isinstance(v, Beliefs) else v for n, v in found.items()}


def with_shadows(batch: EpisodeBatch, state: Any, shadows: Shadows | None) -> EpisodeBatch:
    """The batch with another state and memory."""
    result = copy.copy(batch)
    result.state, result.shadows, result._beliefs = state, shadows, None
    return result


def moved_otherwise(
    batch: EpisodeBatch, remembered: Shadows | None, rng: np.random.Generator
) -> EpisodeBatch:
    """The same history, but the last move and all new measurements are made of other noise.

    ``remembered`` is what there was before the last move.
    """
    if batch.delivered is None:
        return batch
    noise = rng.standard_normal((batch.task.system.noise_channels, batch.num_envs))
    shadows = None if remembered is None else batch.memory.sense(remembered, noise)
    return with_shadows(batch, batch.task.system.sense(batch.delivered, noise), shadows)


def forgotten(batch: EpisodeBatch) -> EpisodeBatch:
    """Without what was measured and not sent."""
    task = dataclasses.replace(batch.task, shadow=None)
    shadows = None if batch.shadows is None else Shadows(alone=batch.shadows.alone)
    result = with_shadows(batch, batch.state, shadows)
    result.memory = Memory(task, batch.memory.owner)
    return result


def with_other_truth(batch: EpisodeBatch, rng: np.random.Generator) -> EpisodeBatch:
    """All that the system's visible state hides is changed: the truth, coming losses."""
    system, kept = batch.task.system, batch.shadows
    state, shadows = tampered(system, batch.state, rng), kept
    if kept is not None:
        shadow = batch.task.shadow
        shadows = Shadows(
            tampered(shadow, kept.every, rng),
            tampered(shadow, kept.own, rng),
            tampered(system, kept.alone, rng),
        )
    return with_shadows(batch, state, shadows)


def tampered(system: Any, state: Any, rng: np.random.Generator) -> Any:
    """A state with other values of what the visible one hides."""
    if state is None:
        return None
    visible = system.visible(state)
    changed = {}
    for field in dataclasses.fields(state):
        value = getattr(state, field.name)
        if value is None or value is getattr(visible, field.name):
            continue
        if value.dtype == np.bool_:
            changed[field.name] = ~value
        elif value.dtype == np.float64:
            other = rng.standard_normal(value.shape)
            changed[field.name] = value * np.exp(other) if (value > 0.0).all() else value + other
        else:
            changed[field.name] = np.roll(value, 1, axis=-1)
    assert changed
    return dataclasses.replace(state, **changed)


def other_runs(values: Values, rng: np.random.Generator) -> Values:
    """Every value is another run's, numbers moved besides."""
    result = {}
    for name, value in values.items():
        if name == "model":
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
        result[name] = rolled
    return result


def of_sensor(sensor: int, true: Values, other: Values, batch: EpisodeBatch) -> Values:
    """``true`` where the sensor knows it by itself or everyone is told, ``other`` elsewhere."""
    own = [signal for signal in MEMORY_SIGNALS if signal.knowledge == "own_memory"]
    signals = (*batch.task.system.signals, *own)
    declared = {signal.name: signal.axes for signal in signals if signal.name in true}

    def with_own(all_other: Any, all_true: Any) -> Any:
        result = all_other.copy()
        result[sensor] = all_true[sensor]
        return result

    result = {name: true[name] if name in TOLD else other[name] for name in true}
    for name, value in true.items():
        if name in ("admitted", "grantable") or declared.get(name, "").startswith("(sensors"):
            result[name] = with_own(result[name], value)
        elif name == "own_beliefs":
            result[name] = other[name].with_each(with_own, value)
    known = [entry.told or entry.sensor == sensor for entry in batch.layout.entries]
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
                    what: merge_runs(kept, take_runs(other[name].made_of[what], runs), runs)
                    for what, kept in value.made_of.items()
                }
        elif name == "model":
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
    "coordinator": {MEASUREMENTS, OTHERS},
    "own_memory": {MEASUREMENTS, PAST},
    "coordinator_memory": {MEASUREMENTS, OTHERS, PAST},
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
    remembered = None
    timed, blind, forgetful, honest, *alone = (
        copy.deepcopy(policy) for _ in range(4 + task.sensors)
    )
    for each in (policy, timed, blind, forgetful, honest, *alone):
        each.reset(RUNS, seed)
    found: set[str] = set()

    def compare(what: str, answer: Any, expected: Any) -> None:
        if not np.array_equal(answer, expected):
            found.add(what)

    for step in range(STEPS):
        signals = batch.signals()
        asked = policy(signals)
        elsewhere = moved_otherwise(batch, remembered, rng)
        true, other = (read(one.signals(), policy) for one in (batch, elsewhere))
        foreign = other_runs(other, rng)
        clock = {name: true[name] if name in CLOCK else foreign[name] for name in true}
        compare(ANYTHING, timed(Signals(clock)), asked)
        compare(MEASUREMENTS, blind(elsewhere.signals()), asked)
        compare(HIDDEN, honest(with_other_truth(batch, rng).signals()), asked)
        for sensor, each in enumerate(alone):
            answer = each(Signals(of_sensor(sensor, true, foreign, batch)))
            compare(OTHERS, answer[sensor], asked[sensor])
        if task.shadow is not None:
            compare(PAST, copy.deepcopy(forgetful)(forgotten(batch).signals()), asked)
        believed, granted = batch.beliefs(), batch.step(asked).granted
        remembered = batch.memory.deliver(believed, granted)
        if step % 2 == 0:
            compare(PAST, forgetful(signals), asked)
        else:
            silent = np.flatnonzero(~granted.any(0))
            forgetful(Signals(in_runs(silent, true, other)))
    return found


@functools.cache
def tried(name: str) -> list[tuple[str, Knowledge, set[str]]]:
    """(where and what, declared class, what matters) of a policy in all environments."""
    results = []
    for place in BELIEVED if name in BELIEVING else ENVIRONMENTS:
        for text in POLICIES[name]:
            spec = f"{name}:{text}" if text else name
            try:
                policy = make_policy(spec, task_of(place))
            except ConfigurationError:
                continue
            found = what_matters(policy, task_of(place))
            results.append((f"{place}: {spec}", policy.knowledge, found))
    return results


def test_every_policy_is_held_to_its_class() -> None:
    assert sorted(POLICIES) == policy_names()


@pytest.mark.parametrize("name", POLICIES)
def test_it_looks_at_nothing_outside_its_class(name: str) -> None:
    results = tried(name)
    assert results
    for where, knowledge, found in results:
        assert found <= may_matter(knowledge), (where, knowledge)


@pytest.mark.parametrize("name", POLICIES)
def test_its_class_is_the_least(name: str) -> None:
    """What sets its class apart from the one below matters somewhere: it claims no more."""
    by_class: dict[Knowledge, set[str]] = {}
    for _, knowledge, found in tried(name):
        by_class.setdefault(knowledge, set()).update(found)
    for knowledge, found in by_class.items():
        assert CHARACTERISTIC[knowledge] <= found, knowledge


# --- policies that lie --------------------------------------------------------------------------


class Liar(Rule):
    """Requests where a number is positive, and declares whatever it likes."""

    def __init__(
        self,
        knowledge: Knowledge,
        number: Callable[[Signals], Any],
        remember: Owner | None = None,
    ) -> None:
        self.declared, self.number, self.remember = knowledge, number, remember

    @property
    def knowledge(self) -> Knowledge:
        return self.declared

    def __call__(self, signals: Signals) -> Any:
        shape = (len(signals["token_cost"]), len(signals["tokens"]))
        return np.broadcast_to(self.number(signals), shape) > 0.0


class Rememberer(Liar):
    def reset(self, runs: int, seed: int = 0) -> None:
        self.last: Any = 0.0

    def __call__(self, signals: Signals) -> Any:
        asked = np.broadcast_to(self.last, signals["measurement"][:, 0].shape) > 0.0
        self.last = signals["measurement"][:, 0]
        return asked


def dug_up(signals: Signals, name: str) -> Any:
    """A field of the whole state, by way of a method that knows it; zeros where there is none."""
    batch: Any = getattr(signals._values["observation"], "__self__", None)
    return 0.0 if batch is None else np.asarray(getattr(batch.state, name)[0], dtype=float)


LIARS: dict[str, tuple[Liar, str]] = {
    "tells_time": (Liar("clock", lambda s: s["age"] - 2.0), ANYTHING),
    "sees_measurements": (Liar("centre", lambda s: s["innovation"][:, 0]), MEASUREMENTS),
    "sees_others": (Liar("own", lambda s: s["innovation"][::-1, 0]), OTHERS),
    "sees_the_centre": (Liar("own", lambda s: s["prior_mean"][0]), OTHERS),
    "remembers": (Rememberer("own", lambda s: 0.0), PAST),
    "remembers_all": (Rememberer("coordinator", lambda s: 0.0), PAST),
    "keeps_what_it_measured": (Liar("own", lambda s: s["own_value"] - 0.1, "own"), PAST),
    "keeps_what_all_measured": (
        Liar("coordinator", lambda s: s["transmission_value"] - 0.1, "coordinator"),
        PAST,
    ),
    "believes_with_others": (
        Liar("own_memory", lambda s: s["own_value"][::-1] - 0.1, "own"),
        OTHERS,
    ),
    "remembers_with_all": (
        Liar("own_memory", lambda s: s["transmission_value"] - 0.1, "coordinator"),
        OTHERS,
    ),
    "knows_the_truth": (Liar("coordinator", lambda s: dug_up(s, "truth")), HIDDEN),
    "knows_losses": (Liar("coordinator_memory", lambda s: dug_up(s, "lost")), HIDDEN),
}


@pytest.fixture
def _own_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_ROWS", dict(registry._ROWS))


@pytest.mark.usefixtures("_own_table")
@pytest.mark.parametrize("name", LIARS)
def test_a_policy_that_lies_is_caught(name: str) -> None:
    liar, what = LIARS[name]
    register_policy(name, lambda: copy.deepcopy(liar))
    task = task_of("remote, losses" if name == "knows_losses" else "tobit")
    if liar.remember is not None:
        task = task_of("tobit, memory")
    found = what_matters(make_policy(name, task), task)
    assert what in found
    assert what not in may_matter(liar.knowledge)


# --- a user's own -------------------------------------------------------------------------------


@dataclasses.dataclass
class Mine(Rule):
    threshold: float = 0.5
    knowledge = "own"

    def __call__(self, signals: Signals) -> Any:
        return signals["measurement"][:, 0] > self.threshold


@pytest.mark.usefixtures("_own_table")
def test_a_policy_of_ones_own_is_in_every_list() -> None:
    fusion_gym.register_policy("mine", Mine)
    assert "mine" in fusion_gym.policy_names()
    assert fusion_gym.policy_names("rule") == sorted([*policy_names("rule")])
    task = task_of("tobit")
    policy: Any = fusion_gym.evaluation.make_policy("mine:threshold=0.2", task)
    assert policy.threshold == 0.2
    results = fusion_gym.evaluation.run_episodes(task, policy, 4, 0)
    assert 0.0 < results.requests.mean() < 1.0
    for text, message in (
        ("mien", r"unknown policy 'mien': did you mean 'mine'\? .*lookahead, mine, model"),
        ("mine:treshold=1", r"unknown parameter of policy 'mine' 'treshold': .* 'threshold'"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            make_policy(text, task)
    centre = task_of("tobit, centre")
    with pytest.raises(ConfigurationError, match="policy 'mine': signal 'measurement'"):
        make_policy("mine", centre)


@pytest.mark.usefixtures("_own_table")
def test_a_maker_is_given_the_task_and_says_what_is_missing() -> None:
    def make(task: Task, gain: float) -> Policy:
        assert task is task_of("tobit")
        return Liar("clock", lambda signals: gain)

    register_policy("gains", make, "reference")
    assert policy_names("reference") == [
        "estimate_difference", "gains", "kullback_leibler", "lookahead", "optimal",
        "periodic_optimum", "rollout", "value_of_information", "whittle",
    ]  # fmt: skip
    policy: Any = make_policy("gains:gain=2", task_of("tobit"))
    assert policy.number(None) == 2
    with pytest.raises(ConfigurationError, match="policy 'gains' needs a parameter 'gain'"):
        make_policy("gains", task_of("tobit"))
    register_policy("shapeless", lambda: Liar("clock", lambda s: 1.0))
    register_policy("undeclared", lambda: Liar(None, lambda s: 1.0))  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match=r"knowledge = None: it must declare .* 'clock'"):
        make_policy("undeclared", task_of("tobit"))

    class Flat(Mine):
        def __call__(self, signals: Signals) -> Any:
            return signals["measurement"][:, 0, 0] > 0.0

    register_policy("flat", Flat)
    with pytest.raises(ConfigurationError, match=r"an array of bool \(3,\): .* \(3, 1\)"):
        make_policy("flat", task_of("tobit"))


@pytest.mark.usefixtures("_own_table")
@pytest.mark.parametrize(
    ("name", "maker", "message"),
    [
        ("always", Mine, "there is a policy of that name"),
        ("zoo", Mine, "there is a policy of that name"),
        ("my-rule", Mine, "name = 'my-rule'"),
        ("", Mine, "name = ''"),
        (3, Mine, "name = 3"),
        ("mine", "module:Mine", "'module:Mine' .* must be a callable"),
        ("mine", 7, "maker = 7 .* must be a callable"),
        ("mine", lambda *values: Mine(), "named parameters"),
    ],
)
def test_what_cannot_be_registered(name: Any, maker: Any, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        register_policy(name, maker)
    assert "mine" not in policy_names()


def test_near_misses_of_references_are_told() -> None:
    for wrong, right in (("lookahed", "lookahead"), ("perodic_optimum", "periodic_optimum")):
        with pytest.raises(ConfigurationError, match=f"did you mean '{right}'"):
            make_policy(wrong, task_of("tobit"))
