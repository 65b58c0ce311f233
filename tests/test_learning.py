"""How fast agents learn: when a front is below an envelope, and the part that measures it."""

import math
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from command_runs import Ended, call, succeed
from small_suite import SMALL, small_suite
from training_configs import small_config

from benchmarks.learning import measure_throughput
from fusion_gym.agents.experiments import learning as fronts
from fusion_gym.agents.experiments.config import Course, load_suite
from fusion_gym.agents.experiments.envelopes import SHIPPED, EnvelopeStore
from fusion_gym.agents.experiments.tables import write_rows
from fusion_gym.agents.experiments.workers import Folders
from fusion_gym.envs.privileged import PrivilegedVecEnv
from fusion_gym.envs.registration import make_task
from fusion_gym.evaluation.envelope import EnvelopePoint
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy
from fusion_gym.validation import ConfigurationError

pytestmark = pytest.mark.usefixtures("few_resamples")
# 4, 2, 1 at the rates 0, .1 and .3: 3 in the middle of the first piece, 1.5 of the second.
ENVELOPE = [
    EnvelopePoint("never", 0.0, 4.0),
    EnvelopePoint("some", 0.1, 2.0),
    EnvelopePoint("most", 0.3, 1.0),
]


@pytest.mark.parametrize(
    ("front", "excess"),
    [
        ([(0.1, 1.0), (0.3, 0.9)], -0.1),
        ([(0.3, 0.9), (0.1, 1.0)], -0.1),  # in any order
        ([(0.05, 2.4), (0.15, 1.4)], -0.05),  # each by 20 %, their mixture at .1 by 5 %
        ([(0.05, 2.7), (0.2, 1.2)], 0.1),  # each by 10 and 20 %, their mixture has 2.2 at .1
        ([(0.1, 1.0), (0.2, 1.65), (0.3, 0.9)], 0.1),  # a bad point counts by itself
        ([(0.4, 0.8)], -0.2),  # right of the envelope its last rule stands
        ([(0.0, 5.0)], 0.25),
        ([(0.1, math.nan), (0.3, 0.9)], math.inf),
    ],
)
def test_the_excess_of_a_front_is_the_worst_of_points_and_vertices(
    front: list[tuple[float, float]], excess: float
) -> None:
    assert fronts.excess_over(front, ENVELOPE) == pytest.approx(excess)
    assert fronts.excess_over(front, [*ENVELOPE, EnvelopePoint("bad", 0.2, 1.9)]) == pytest.approx(
        excess
    )


@pytest.mark.parametrize(
    ("low", "high", "below"),
    [(0.1, 0.299, False), (0.1, 0.301, True), (0.0, 0.149, False), (0.0, 0.151, True)],
)
def test_a_front_is_more_than_a_point_and_than_silence(
    low: float, high: float, below: bool
) -> None:
    assert fronts.is_below([(low, 1.0), (high, 0.5)], ENVELOPE, least=0.05) == below
    assert not fronts.is_below([(0.1, 2.0), (0.3, 0.5)], ENVELOPE, least=0.05), (
        "as good is not below"
    )
    assert not fronts.is_below([(0.0, 3.9)] * 7, ENVELOPE, least=0.05)


def test_a_range_counts_from_a_twentieth_of_always_transmitting(school: Path) -> None:
    setup = setup_of(school)
    always = setup.envelopes["always"]
    assert setup.below([(0.0, 0.001), (0.151 * always, 0.0005)])
    assert not setup.below([(0.0, 0.001), (0.149 * always, 0.0005)])
    assert not setup_of(school, memoryless=None).below([(0.0, 0.001), (always, 0.0005)])


def test_the_first_moment_below_and_what_came_after() -> None:
    states = [(0.2, False), (-0.1, True), (0.05, False), (-0.2, True)]
    curve = [
        {
            "timesteps": 100 * place,
            "cpu_seconds": 1.5 * place,
            "front": [[0.1, 1.0], [0.3, 0.5]],
            "excess": excess,
            "below": below,
        }
        for place, (excess, below) in enumerate(states)
    ]
    result = fronts.first_below({"seed": 3, "curve": curve})["first"]
    assert (result["timesteps"], result["excess"], result["above_later"]) == (100, -0.1, 1)
    assert "first" not in fronts.first_below({"seed": 3, "curve": curve[:1]})


def setup_of(school: Path, **course: Any) -> fronts.LearningSetup:
    """The course of the suite that :func:`school` writes, with changes."""
    suite = load_suite(school / "suite.yaml")
    plain = suite.settings[0].course.model_dump() | course  # type: ignore[union-attr]
    store = EnvelopeStore(suite, school / "results")
    return fronts.LearningSetup(
        suite, suite.settings[0], Course(**plain), store, Folders(school, school)
    )


@pytest.fixture(scope="module")
def school(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small suite with its envelopes, and what is to be learned in it, in a second."""
    folder = tmp_path_factory.mktemp("school")
    source = {
        "name": "source",
        "title": "one source",
        "environment": {"id": "fusion_gym/RemoteEstimation-v1", "options": {"horizon": 5}},
        "price_range": [0.1, 1.0],
    }
    options = {
        "small": {"filter": "tobit", "horizon": 10, "memory": True},
        "centre": {"filter": "tobit", "horizon": 10, "information": "centre"},
        "plain": {"filter": "tobit", "horizon": 10},
        "narrow": {"filter": "tobit", "horizon": 10, "memory": True, "price_range": [0.01, 0.1]},
        "source": {"horizon": 5},
    }
    for name, own in options.items():
        place = folder / name
        place.mkdir()
        at = source if name == "source" else SMALL["settings"][0]
        priced = {"cost_weight": "random", "price_range": at["price_range"]}
        small_config(
            place,
            environment={"id": at["environment"]["id"], "options": priced | own},
            algorithm={"name": "counterfactual_ppo", "n_steps": 8, "batch_size": 32},
            training={"timesteps": 128, "num_envs": 4},
        )
    course = {"front": str(folder / "small" / "config.yaml")}
    course |= {"memoryless": "sensors", "against": "sensors_memory"}
    plain = {"every": 128, "seeds": 1, "budget": 1000.0, "timesteps": 256, "num_envs": 4}
    plain |= {"algorithm": {"name": "ppo", "n_steps": 16, "batch_size": 32}}
    suite = small_suite(
        folder,
        settings=[SMALL["settings"][0] | {"course": course}, source],
        families=[family for family in SMALL["families"] if family["label"] == "gain"],
        learning={"prices": 3, "every": 64, "episodes": 4, "plain": plain},
    )
    words = ["--classes", "sensors", "sensors_memory", "--results", str(folder / "results")]
    succeed("benchmark", words_of(suite, folder, "--envs", "small", *words, parts="envelopes"))
    return folder


def words_of(suite: Path, folder: Path, *more: str, parts: str = "learning report") -> list[str]:
    words = ["--config", str(suite), "--work", str(folder / "work"), "--workers", "1"]
    return [*words, "--parts", *parts.split(), *more]


def without_seconds(value: Any) -> Any:
    if isinstance(value, dict):
        dropped = ("cpu_seconds", "throughput")
        return {key: without_seconds(v) for key, v in value.items() if key not in dropped}
    return [without_seconds(v) for v in value] if isinstance(value, list) else value


def test_an_interrupted_run_ends_as_an_undisturbed_one(
    school: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def learn(name: str, *more: str) -> Ended:
        folder = tmp_path / name
        if not folder.exists():
            shutil.copytree(school / "results" / "small", folder / "results" / "small")
        words = ["--results", str(folder / "results"), *more]
        return call("benchmark", words_of(school / "suite.yaml", folder, *words), seconds=200.0)

    def tables(name: str) -> dict[str, Any]:
        return fronts.read_learning(tmp_path / name / "results" / "learning" / "small")

    ended = learn("whole")
    assert (ended.status, ended.trace) == (0, ""), ended.err
    content = tables("whole")
    assert [front["seed"] for front in content["fronts"]] == [0, 1]
    assert content["fronts"][0]["curve"] != content["fronts"][1]["curve"]
    for front in content["fronts"]:
        assert [point["timesteps"] for point in front["curve"]] == [64, 128]
        seconds = [point["cpu_seconds"] for point in front["curve"]]
        assert 0.0 < seconds[0] < seconds[1]
        assert [point["price"] for point in front["points"]] == content["prices"]
    assert [item["algorithm"] for item in content["plain"]] == ["ppo"], "fewer seeds of it"
    assert [point["timesteps"] for point in content["plain"][0]["curve"]] == [128, 256]
    assert content["finished"]["compared"] == 2, "the inner one of three prices, of two seeds"
    page = tmp_path / "whole" / "results" / "learning" / "README.md"
    assert "| small | – | – |" in page.read_text()
    assert "go on with --resume" in learn("whole").err

    before, counted = PrivilegedVecEnv.step_alternatives, 0

    def step_alternatives(self: PrivilegedVecEnv, *arguments: Any) -> Any:
        nonlocal counted
        counted += 1
        if counted == 45:  # of 32 a training: in the second one
            os.kill(os.getpid(), signal.SIGINT)
        return before(self, *arguments)

    monkeypatch.setattr(PrivilegedVecEnv, "step_alternatives", step_alternatives)
    assert learn("broken").status == 130
    assert learn("broken", "--resume").status == 0
    assert counted == 64, "nothing is trained twice"
    assert without_seconds(tables("broken")) == without_seconds(content)
    assert learn("broken", "--resume").status == 0
    assert counted == 64
    other = yaml.safe_load((school / "suite.yaml").read_text())
    other["learning"]["timesteps"] = 32
    (tmp_path / "shorter.yaml").write_text(yaml.safe_dump(other))
    shorter = learn("broken", "--resume", "--config", str(tmp_path / "shorter.yaml"))
    assert "timesteps = 32 differs" in shorter.err


def test_throughput_is_part_of_the_tables(school: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.throughput.TURNS", 1)
    speeds = measure_throughput(load_suite(school / "suite.yaml").settings[0], 0.01)
    assert speeds["values"] < speeds["without"]


@pytest.mark.parametrize(("budget", "below"), [(1e-9, False), (math.inf, True)])
def test_plain_ppo_ends_with_its_budget_or_below_the_rules(
    school: Path, tmp_path: Path, budget: float, below: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fusion_gym.agents.experiments.learning.is_below", lambda *_: below)
    setup = replace(setup_of(school), folders=Folders(tmp_path, tmp_path))
    result = fronts.run_course(fronts.LearningRun(setup, "plain", 0, budget))
    assert [point["timesteps"] for point in result["curve"]] == [128], "not the whole 256"


@pytest.mark.parametrize(
    "course",
    [
        {"setting": "source", "front": "source", "against": "optimum"},
        {
            "setting": "small",
            "front": "centre",
            "against": "schedules",
            "schedules": ["never", "periodic:period=4", "always"],
        },
    ],
)
def test_a_front_beside_the_optimum_or_the_best_of_schedules(
    school: Path, tmp_path: Path, course: dict[str, Any]
) -> None:
    plain = yaml.safe_load((school / "suite.yaml").read_text())
    (setting,) = (item for item in plain["settings"] if item["name"] == course["setting"])
    front = {"front": str(school / course["front"] / "config.yaml")}
    setting["course"] = {k: v for k, v in course.items() if k != "setting"} | front
    (tmp_path / "suite.yaml").write_text(yaml.safe_dump(plain))
    words = ["--envs", course["setting"], "--seeds", "1", "--results", str(tmp_path)]
    succeed("benchmark", words_of(tmp_path / "suite.yaml", tmp_path, *words))
    content = fronts.read_learning(tmp_path / "learning" / course["setting"])
    assert content["plain"] == []
    assert content["finished"]["compared"] == 3, "all prices"
    where = setting["environment"]
    for point in content["fronts"][0]["points"]:
        task = make_task(where["id"], **where["options"], cost_weight=point["price"])
        best = min(
            -run_episodes(task, make_policy(policy, task), 12, 0).returns.mean()
            for policy in course.get("schedules", ["optimal"])
        )
        assert point["optimum"] == pytest.approx(best)
        assert point["difference"]["mean"] == pytest.approx(point["cost"] / best - 1.0)


@pytest.mark.parametrize(
    ("course", "expected"),
    [
        ({"against": "sensors"}, r"memory = True is not allowed in small: .* has False"),
        ({"front": "centre"}, r"memory = False is not allowed in small: .* has True"),
        (
            {"front": "plain", "against": "schedules", "schedules": ("never",)},
            r"information = 'sensors' is not allowed in small: .* has 'centre'",
        ),
        ({"front": "source"}, r"id = 'fusion_gym/RemoteEstimation-v1' is not allowed in small"),
        ({"front": "narrow"}, r"price_range = \[0.01, 0.1\] is not allowed .* has \[0.001, 0.1\]"),
        ({"against": "local_none"}, r"class = 'local_none' is not allowed"),
    ],
)
def test_a_front_is_compared_with_what_knows_the_same(
    school: Path, course: dict[str, Any], expected: str
) -> None:
    setup_of(school).check()
    if "front" in course:
        course = course | {"front": str(school / course["front"] / "config.yaml")}
    with pytest.raises(ConfigurationError, match=expected):
        setup_of(school, **course).check()


def test_seeds_and_prices_that_lie_above_are_counted(school: Path) -> None:
    def point(mean: float, low: float, mse: float) -> dict[str, Any]:
        result = {"mean": mean, "low": low, "high": mean + 1.0}
        return {
            "price": 0.01,
            "rate": 0.1 * mse,
            "mse": mse,
            "envelope": 2.0,
            "bound": 1.0,
            "difference": result,
        }

    bad = point(9.0, 8.0, 9.0)  # outside the inner part
    seeds = [
        {"seed": 0, "points": [bad, point(0.02, 0.011, 1.8), bad]},
        {"seed": 1, "points": [bad, point(0.03, 0.009, 1.4), bad]},
    ]
    setup = {"course": setup_of(school).course.model_dump(), "inner": [False, True, False]}
    result = fronts.judge_fronts(setup | {"fronts": seeds})
    assert result is not None
    assert result["compared"] == 2
    assert [(p["seed"], p["difference"]["low"]) for p in result["above"]] == [(0, 0.011)]
    assert result["worst"]["seed"] == 1
    assert result["rates"] == pytest.approx([0.14, 0.18])
    assert result["closed"] == {"rollout": None, "bound": pytest.approx((0.2 + 0.6) / 2.0)}
    assert fronts.gap_share([{"envelope": 1.0, "bound": 1.0, "mse": 1.0}], "bound") is None
    assert fronts.judge_fronts(setup | {"fronts": []}) is None


def test_a_rollout_counts_on_its_own_episodes_and_only_where_it_was_run(
    school: Path, tmp_path: Path
) -> None:
    """Of 4 episodes the first 2 are twice as hard: there the rollout has 3/4 of the envelope."""
    shutil.copytree(school / "results" / "small", tmp_path / "small")
    none = {"mean": 1.5, "low": 1.5, "high": 1.5}
    rollout = dict.fromkeys(("mse", "return_gain", "base_mse"), none) | {"episodes": 2, "seed": 0}
    rollout |= dict.fromkeys(("price", "return", "base_rate"), 0.0)
    rollout |= dict.fromkeys(("policy", "base_policy", "env", "command"), "x") | {"options": {}}
    write_rows(tmp_path / "small", "rollout", [rollout | {"rate": rate} for rate in (0.1, 0.3)])
    bound = dict.fromkeys(("upper", "rate", "step", "points", "gap", "horizon"), 1)
    bound |= {"sensors": 2, "floor": 0.4, "env": "x", "weights": "mse", "settings": {}}
    bound |= {"everything_delivered": {}}
    costs = [{"price": 1.0, "lower": 0.9}, {"price": 4.0, "lower": 1.5}]
    write_rows(tmp_path / "small", "bounds", [bound | cost for cost in costs])
    hard = np.array([2.0, 2.0, 1.0, 1.0])
    envelope = {str(rate): SimpleNamespace(rate=np.array([rate]), mse=hard) for rate in (0.0, 1.0)}
    setup = setup_of(school)
    setup = replace(setup, store=setup.store._replace(results=tmp_path))
    assert fronts.best_known(setup, 0.2, envelope) == {
        "rollout": 0.75 * 1.5,
        "bound": pytest.approx(0.5),
    }
    assert fronts.best_known(setup, 0.05, envelope) == {"bound": pytest.approx(1.1)}
    assert fronts.best_known(setup, 0.31, envelope) == {"bound": 0.4}
    course = setup.course.model_copy(update={"against": "sensors"})
    assert "rollout" not in fronts.best_known(replace(setup, course=course), 0.2, envelope), (
        "it remembers"
    )


def test_every_shipped_front_knows_what_it_is_compared_with(tmp_path: Path) -> None:
    suite = load_suite("benchmark")
    store, folders = EnvelopeStore(suite, SHIPPED), Folders(tmp_path, tmp_path)
    for setting in suite.settings:
        assert setting.course is not None
        setup = fronts.LearningSetup(suite, setting, setting.course, store, folders)
        setup.check()
        assert setup.inner == [False, *[True] * 5, False], setting.name
        assert len(setup.tests) == len({test.name for test in setup.tests}) > 5
