"""Policies look at nothing outside the class that they declare: it is changed, requests are not."""

import copy
import functools
import re
from collections.abc import Callable
from operator import attrgetter
from typing import Any

import numpy as np
import pytest
from refusals import refused
from what_matters import (
    ANYTHING,
    CHARACTERISTIC,
    HIDDEN,
    MEASUREMENTS,
    OTHERS,
    PAST,
    Values,
    may_matter,
    what_matters,
)

import fusion_gym
from agents.papers.walk import walk
from fusion_gym import zoo
from fusion_gym.core.knowledge import Knowledge, Signal, Signals
from fusion_gym.core.memory import Owner
from fusion_gym.core.task import Task
from fusion_gym.docstrings import read
from fusion_gym.evaluation import record_episode, run_episodes, watch
from fusion_gym.evaluation.episodes import run_priced, run_several
from fusion_gym.policies.base import Rule
from fusion_gym.policies.registry import make_policy, policy_maker, policy_names, register_policy
from fusion_gym.policies.rules import BeliefRule
from fusion_gym.validation import ConfigurationError

LOOP: Values = {"input_matrix": [[0.0], [1.0]], "tokens": "unlimited"}
ENVIRONMENTS: dict[str, tuple[str, Values]] = {
    "tobit": ("TobitOscillator-v1", {"filter": "tobit", "random_start": True}),
    "tobit, centre": ("TobitOscillator-v1", {"filter": "tobit", "information": "centre"}),
    "correlated": ("CorrelatedTracking-v1", {"token_rate": 1.0}),
    "markov": ("MarkovJumpTracking-v1", {"token_rate": 1.0}),
    "markov, imm": ("MarkovJumpTracking-v1", {"filter": "imm", "tokens": "unlimited"}),
    "unknown input": ("UnknownInput-v1", {"token_rate": 0.5}),
    "biased": ("BiasedTracking-v1", {"access": "random"}),
    "remote, losses": (
        "RemoteEstimation-v1",
        {"sensors": 2, "cost_weight": 3.0, "channel": "gilbert_elliott"},
    ),
    "vectors": (
        "RemoteEstimation-v1",
        {"sources": (2, 0), "access": "slots", "channel": "gilbert_elliott"},
    ),
    "closed loop": ("LinearFusion-v2", LOOP),
    "remote, one link": (
        "RemoteEstimation-v1",
        {"sensors": 2, "cost_weight": 0.3, "access": "single", "noise_deviation": (1.0, 1.5)},
    ),
}
# The memory of a sensor, what it receives, and the same of a scheduler.
REMEMBERING: dict[str, tuple[str, Values]] = {
    "tobit, memory": ("TobitOscillator-v1", {"filter": "tobit", "memory": True}),
    "biased, memory, estimates": ("BiasedTracking-v1", {"memory": True, "packet": "estimate"}),
    "correlated, memory, told": (
        "CorrelatedTracking-v1",
        {"token_rate": 1.0, "memory": True, "broadcast": "estimate"},
    ),
    "correlated, memory, overheard": (
        "CorrelatedTracking-v1",
        {"token_rate": 1.0, "memory": True, "broadcast": "packets"},
    ),
    "closed loop, memory": ("LinearFusion-v2", LOOP | {"memory": True}),
    "correlated, told": ("CorrelatedTracking-v1", {"token_rate": 1.0, "broadcast": "estimate"}),
    "remote, losses, memory": (
        "RemoteEstimation-v1",
        {"sensors": 2, "channel": "gilbert_elliott", "memory": True},
    ),
}
BELIEVED = (*REMEMBERING, "tobit", "tobit, centre", "correlated", "remote, one link")
# Texts of a policy that are tried in the place of its example.
POLICIES: dict[str, list[str]] = {
    "adaptive_innovation": ["", "threshold=3,sensitivity=0.9", "sensitivity=0"],
    "adaptive_threshold": ["", "scale=20,rho_initial=0", "rho_bar=0.5,rho_initial=0.5"],
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
    "age_index": ["price=30", "price=30,at_most=none"],
    "age_optimum": ["longest=20"],
    "kullback_leibler": ["threshold=0.3,at_most=1", "threshold=0.3,own=true"],
    "local_variance": ["", "m=0.3"],
    "model": [f"{zoo.model_path('tobit_oscillator_centre')}"],
    "optimal": ["", "criterion=average"],
    "periodic": ["", "period=3,staggered=false"],
    "periodic_optimum": ["packets=2,period=2"],
    "priced_threshold": [
        "threshold=0.03,token_exponent=0.5,price_exponent=0",
        "threshold=0.03,price_exponent=0,own=true,age_exponent=-0.5",
        "score=innovation,threshold=0.5,price_exponent=0",
        "score=innovation,threshold=0.2,price_exponent=0,margin=1.5",
        "score=variance,threshold=0.01,price_exponent=0,mixture=0.5",
    ],
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
    "zoo": [name for name in zoo.names() if name.startswith("tobit_oscillator_")],
}


@functools.cache
def task_of(name: str) -> Task:
    env_id, options = (ENVIRONMENTS | REMEMBERING)[name]
    return fusion_gym.make_task(f"fusion_gym/{env_id}", **options)


def believes(name: str) -> bool:
    """Whether a policy reads beliefs, and is tried where they differ."""
    maker = policy_maker(name)
    believing = isinstance(maker, type) and issubclass(maker, BeliefRule)
    return believing or hasattr(maker, "memory_owner") or name == "zoo"


def tried(name: str) -> list[tuple[str, Knowledge, set[str]]]:
    """(where and what, declared class, what matters) of a policy in all environments."""
    results = []
    specs = [f"{name}:{text}".rstrip(":") for text in POLICIES.get(name, ())]
    if not specs:
        specs = re.findall("``(.+?)``", read(policy_maker(name)).labelled["Example"])[:1]
    for place in BELIEVED if believes(name) else ENVIRONMENTS:
        for spec in specs:
            try:
                policy = make_policy(spec, task_of(place))
            except ConfigurationError:
                continue
            result = what_matters(policy, task_of(place))
            results.append((f"{place}: {spec}", policy.knowledge, result))
    return results


LONG = {"rollout", "priced_threshold", "periodic_optimum", "whittle", "estimate_difference"}
NAMES = [pytest.param(n, marks=pytest.mark.slow if n in LONG else ()) for n in policy_names()]


@pytest.mark.parametrize("name", NAMES)
def test_it_looks_at_what_its_class_has_and_at_nothing_else(name: str) -> None:
    """Nothing outside its class matters; what sets that apart from the one below does somewhere:
    it claims no more."""
    results = tried(name)
    assert results
    by_class: dict[Knowledge, set[str]] = {}
    for where, knowledge, value in results:
        assert value <= may_matter(knowledge), (where, knowledge)
        by_class.setdefault(knowledge, set()).update(value)
    for knowledge, value in by_class.items():
        assert CHARACTERISTIC[knowledge] <= value, knowledge


# --- policies that lie --------------------------------------------------------------------------


class Liar(Rule):
    """Requests where a number is positive, and declares whatever it likes."""

    def __init__(
        self,
        knowledge: Knowledge,
        number: Callable[[Signals], Any],
        memory_owner: Owner | None = None,
    ) -> None:
        self.declared, self.number, self.memory_owner = knowledge, number, memory_owner

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
        requests = np.broadcast_to(self.last, signals["measurement"][:, 0].shape) > 0.0
        self.last = signals["measurement"][:, 0]
        return requests


def dug_up(signals: Signals, name: str) -> Any:
    """A field of the whole state, by way of a method that knows it; zeros where there is none."""
    batch: Any = getattr(signals._values["admitted"], "__self__", None)
    return 0.0 if batch is None else np.asarray(attrgetter(name)(batch.state)[0], dtype=float)


LIARS: dict[str, tuple[Liar, str]] = {
    "tells_time": (Liar("clock", lambda s: s["age"] - 2.0), ANYTHING),
    "sees_measurements": (Liar("centre", lambda s: s["innovation"][:, 0]), MEASUREMENTS),
    "sees_others": (Liar("own", lambda s: s["innovation"][::-1, 0]), OTHERS),
    "sees_the_centre": (Liar("own", lambda s: s["prior_mean"][0]), OTHERS),
    "remembers": (Rememberer("own", lambda s: 0.0), PAST),
    "remembers_all": (Rememberer("scheduler", lambda s: 0.0), PAST),
    "keeps_what_it_measured": (Liar("own", lambda s: s["own_value"] - 0.1, "own"), PAST),
    "keeps_what_all_measured": (
        Liar("scheduler", lambda s: s["transmission_value"] - 0.1, "scheduler"),
        PAST,
    ),
    "believes_with_others": (
        Liar("own_memory", lambda s: s["own_value"][::-1] - 0.1, "own"),
        OTHERS,
    ),
    "remembers_with_all": (
        Liar("own_memory", lambda s: s["transmission_value"] - 0.1, "scheduler"),
        OTHERS,
    ),
    "plans_with_the_model": (Liar("centre", lambda s: s["estimate"].age), MEASUREMENTS),
    "believes_for_others": (
        Liar("own_memory", lambda s: s["beliefs"].value, "scheduler"),
        OTHERS,
    ),
    "is_shown_rows": (Liar("clock", lambda s: s["observation"].T[:2]), ANYTHING),
    "knows_the_truth": (Liar("scheduler", lambda s: dug_up(s, "plant.truth")), HIDDEN),
    "knows_losses": (Liar("scheduler_memory", lambda s: dug_up(s, "network.draws.lost")), HIDDEN),
}


def loops(task: Task, policy: Any) -> dict[str, Callable[[], Any]]:
    """Every loop of a policy over an episode."""
    return {
        "episodes": lambda: run_episodes(task, policy, 2, 0),
        "record": lambda: record_episode(task, policy, 0),
        "search": lambda: run_priced(task, policy, np.arange(2), np.ones(2)),
        "several": lambda: run_several(task, [policy, policy], 2, 0),
        "watch": lambda: list(watch(task, {"policy": policy}, steps=1)),
        "papers": lambda: next(walk(task, policy, 2, 0)),
    }


def test_every_loop_refuses_signals_outside_the_class() -> None:
    task = fusion_gym.make_task("fusion_gym/TobitOscillator-v1", filter="tobit", horizon=3)
    for loop in loops(task, LIARS["sees_measurements"][0]).values():
        with pytest.raises(LookupError, match="'innovation' belongs to the class 'own'"):
            loop()


# Those that a signal of another class betrays at once.
REFUSED = {
    "tells_time": "age",
    "sees_measurements": "innovation",
    "sees_the_centre": "prior_mean",
    "keeps_what_it_measured": "own_value",
    "keeps_what_all_measured": "transmission_value",
    "remembers_with_all": "transmission_value",
    "plans_with_the_model": "estimate",
    "believes_for_others": "beliefs",
    "is_shown_rows": "observation",
}


@pytest.mark.usefixtures("own_table")
@pytest.mark.parametrize("name", LIARS)
def test_a_policy_that_lies_is_caught(name: str) -> None:
    liar, what = LIARS[name]
    register_policy(name, lambda: copy.deepcopy(liar))
    task = task_of("remote, losses" if name == "knows_losses" else "tobit")
    if liar.memory_owner is not None:
        task = task_of("tobit, memory")
    assert what not in may_matter(liar.knowledge)
    if name in REFUSED:
        with pytest.raises(ConfigurationError, match=rf"Liar declares.*{liar.knowledge}") as caught:
            make_policy(name, task)
        assert f"{REFUSED[name]!r} belongs to the class" in str(caught.value)
    else:
        assert what in what_matters(make_policy(name, task), task)


def test_every_sensor_knows_the_input_of_a_controller() -> None:
    task = task_of("closed loop")
    reader = Liar("own", lambda s: s["control"][0] * s["innovation"][:, 0])
    assert what_matters(reader, task) == may_matter("own")
    run_episodes(task, reader, 2, 0)
    with pytest.raises(LookupError, match="'control' belongs to the class 'centre'"):
        run_episodes(task, Liar("clock", lambda s: s["control"][0]), 2, 0)


@pytest.mark.parametrize(("field", "value"), [("knowledge", "nobody"), ("node", "all")])
def test_a_signal_belongs_to_a_class(field: str, value: str) -> None:
    fields: dict[str, Any] = {"name": "a", "knowledge": "own", "axes": "(N,)", "meaning": "a"}
    refused(lambda: Signal(**fields | {field: value}), f"{field} = {value!r} is not allowed")
