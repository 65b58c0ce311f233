"""Tuning and committed envelopes: what is searched, chosen, measured, hashed and compared."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_runs import refusal, succeed
from small_suite import ENV, SMALL, small_suite

import fusion_gym
from agents.benchmark.classes import Class, classes_of
from agents.benchmark.config import Choices, Family, Range, Tuning, load_suite
from agents.benchmark.envelopes import merge_curves, read_envelopes, write_envelopes
from agents.benchmark.tables import read_rows, write_rows
from agents.benchmark.tuning import TuningTrial, first_values, near_hull, policy_text, search_family
from fusion_gym.core.system import covers
from fusion_gym.evaluation.beside import run_beside
from fusion_gym.evaluation.envelope import EnvelopePoint, lower_hull
from fusion_gym.evaluation.episodes import run_episodes
from fusion_gym.policies.registry import make_policy

FAMILY = Family(
    label="x", policy="innovation_threshold",
    parameters={
        "threshold": Range(low=0.1, high=10, per_sensor=True),
        "whitened": Choices(values=(True, False)),
    },
)  # fmt: skip


@pytest.mark.parametrize(
    ("options", "policies"),
    [
        ({}, ["innovation_threshold:threshold=0.5", "stochastic_event:weight=2", "always"]),
        ({"memory": True}, ["value_of_information:threshold=0.01,steps=2", "value_of_information"]),
        (
            {"memory": True},
            ["estimate_difference:own=true", "estimate_difference:own=true,whitened=true"],
        ),
    ],
)
def test_policies_beside_each_other_do_what_each_does_alone(
    options: dict[str, Any], policies: list[str]
) -> None:
    task = fusion_gym.make_task(ENV, filter="tobit", horizon=15, **options)
    built = [make_policy(name, task) for name in policies]
    for name, brief in zip(policies, run_beside(task, built, 7, 3), strict=True):
        single = run_episodes(task, make_policy(name, task), 7, 3)
        np.testing.assert_array_equal(brief.mse, single.mse)
        np.testing.assert_allclose(brief.rate, single.rate.mean(-1), rtol=1e-12)


def test_a_search_begins_with_values_that_all_sensors_share() -> None:
    result = first_values(FAMILY, 24, 3, seed=0)
    texts = [policy_text(FAMILY, values, 3) for values in result]
    assert len(set(texts)) == 24
    alike = [values for values in result if len({values[f"threshold_{i}"] for i in range(3)}) == 1]
    assert alike == result[:12]
    for kind in (True, False):
        swept = [values["threshold_0"] for values in alike if values["whitened"] is kind]
        assert np.diff(np.log(swept)) == pytest.approx(np.log(100) / 6)
    assert policy_text(FAMILY, result[0], 3).endswith("whitened=true")
    fixed = Family(label="y", policy="paced:rate=0.1", parameters={"a": Choices(values=(1,))})
    assert policy_text(fixed, {"a": 1}, 3) == "paced:rate=0.1,a=1"
    assert result != first_values(FAMILY, 24, 3, seed=1)


def test_the_search_at_a_price_gets_nearer_to_the_envelope_there() -> None:
    """More than as many trials without it, and the same again."""
    task = fusion_gym.make_task(ENV, filter="tobit", random_start=True, horizon=30)
    few = Tuning(trials=6, prices=4, refined=1, episodes=40, seeds=1)
    more = few.model_copy(update={"refined": 4})
    result = search_family(task, FAMILY, more, (0.003, 0.3), 0)
    assert search_family(task, FAMILY, few, (0.003, 0.3), 0) == result[: 18 + 12]
    points = [EnvelopePoint(t.policy, t.rate, t.mse) for t in result]
    first, last = points[:18], points
    slope = 0.5
    assert min(p.mse + slope * p.rate for p in last) < min(p.mse + slope * p.rate for p in first)


def test_all_of_the_hull_is_kept_and_what_lies_near() -> None:
    curve = [TuningTrial(f"p{k}", {}, 0.05 * k, (1 - 0.05 * k) ** 2) for k in range(21)]
    above = [TuningTrial("near", {}, 0.5, 0.2525), TuningTrial("far", {}, 0.5, 0.4)]
    stored = near_hull(curve + above, near=0.02, finalists=22)
    assert set(stored) == {trial.policy for trial in curve} | {"near"}
    assert len(near_hull(curve + above, near=0.02, finalists=3)) == 21


def test_classes_contain_what_knows_less() -> None:
    suite = load_suite("benchmark")
    for setting in suite.settings:
        classes = list(classes_of(setting))
        assert len({c.name for c in classes}) == len(classes)
        for place, of in enumerate(classes):
            assert of.contains(of)
            for other in classes:
                if of != other and of.contains(other):
                    assert classes.index(other) < place
                    assert covers(of.knows, other.knows)
        packets = Class("local", False, "packets")
        assert packets.contains(Class("local", False, "estimate"))
        assert not packets.contains(Class("local", True, "estimate"))
        assert not Class("local", True, "estimate").contains(packets)
        measured = [c for c in classes if c.packet == "measurement"]
        assert measured[-1].name == "sensors_memory"
        assert all(measured[-1].contains(c) for c in measured)
        assert all(c.packet == "estimate" for c in classes if not measured[-1].contains(c))


def test_envelopes_are_committed_and_kept(tmp_path: Path) -> None:
    own = {
        "label": "own", "policy": "value_of_information:own=true", "tuned_in": "local",
        "parameters": {"threshold": {"low": 0.01, "high": 1}},
    }  # fmt: skip
    families = [*SMALL["families"], own]
    config = str(small_suite(tmp_path, families=families))
    results = tmp_path / "results"
    words = ["--config", config, "--results", str(results), "--work", str(tmp_path / "work")]
    words += ["--workers", "1", "--parts", "envelopes", "report"]
    succeed("benchmark", [*words, "--classes", "centre", "local_packets"])
    path = results / "small"
    first = read_envelopes(path)
    assert list(first["classes"]) == ["centre", "local_packets"]
    assert "--resume" in refusal("benchmark", words)
    succeed("benchmark", [*words, "--resume"])
    envelopes = read_envelopes(path)
    for name, content in first["classes"].items():
        assert envelopes["classes"][name] == content, "what is committed stays"
    tuned: dict[str, list[EnvelopePoint]] = {}
    for name, content in envelopes["classes"].items():
        listed = content["vertices"]
        tuned[name] = [
            EnvelopePoint(v["name"], v["tuning_rate"], v["tuning_mse"]["mean"]) for v in listed
        ]
        assert tuned[name] == lower_hull(tuned[name]), "chosen on the tuning seeds"
        assert len(content["searches"]) == 2
        assert all(covers(content["knows"], v["knows"]) for v in listed)
        if not content["memory"]:
            assert not any("memory" in v["options"] for v in listed)
    # On the tuning seeds no class is worse than one that it contains.
    for name, content in envelopes["classes"].items():
        for inside in content["contains"]:
            both = [*tuned[name], *tuned[inside]]
            assert {p[1:] for p in lower_hull(both)} <= {p[1:] for p in tuned[name]}
    # The values are those of the test seeds.
    vertex = envelopes["classes"]["sensors_memory"]["vertices"][-1]
    task = fusion_gym.make_task(ENV, filter="tobit", horizon=10, **vertex["options"])
    again = run_episodes(task, make_policy(vertex["policy"], task), 12, 0)
    assert vertex["test_mse"]["mean"] == pytest.approx(again.mse.mean())
    text = (results / "envelopes" / "README.md").read_text()
    assert "| small | sensors |" in text
    assert "| small | local, packets |" in text
    # What was changed by hand is noticed, and what was made from other inputs refused.
    vertices = read_rows(path, "vertices")
    vertices[0]["test_mse"]["mean"] *= 0.9
    write_rows(path, "vertices", vertices)
    error = refusal("benchmark", [*words, "--resume"])
    assert re.search(r"sha256 = .* of the class 'centre' .* were changed", error)
    write_envelopes(path, envelopes)
    small_suite(tmp_path, families=families, episodes=13)
    assert "episodes = 13 differs" in refusal("benchmark", [*words, "--resume"])


def test_a_family_that_does_not_fit_is_reported_before_anything_runs(tmp_path: Path) -> None:
    wrong = [{"label": "gap", "policy": "paced:rat=1", "parameters": {}}]
    words = ["--config", str(small_suite(tmp_path, families=wrong)), "--results"]
    words += [str(tmp_path / "results"), "--work", str(tmp_path / "work")]
    assert "family = 'gap' is not allowed in small" in refusal("benchmark", words)
    assert not list((tmp_path / "work").rglob("*.json"))


def test_classes_that_are_added_take_no_curves_away() -> None:
    first = [{"family": "a", "options": {}, "rate": 1}, {"family": "b", "options": {}}]
    new = [
        {"family": "a", "options": {}, "rate": 2},
        {"family": "b", "options": {"memory": True}},
    ]
    assert merge_curves(first, new) == [first[1], *new]
