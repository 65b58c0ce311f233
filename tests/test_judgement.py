"""Verdicts are of intervals, worst cases the worst, envelopes chosen where they are tuned."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_suite import small_suite

from agents.benchmark import envelopes
from agents.benchmark.classes import classes_of
from agents.benchmark.config import load_suite
from agents.benchmark.report import robustness_rows
from agents.cache import Cache
from agents.papers.numbers import below
from agents.papers.round_robin_tobit_runs import always_below
from fusion_gym.evaluation.envelope import best_mse

NOISE = np.array([-3.0, 1.0, -2.0, 3.5])


def interval(mean: float, low: float, high: float) -> dict[str, float]:
    return {"mean": mean, "low": low, "high": high}


def test_a_mean_below_another_is_not_yet_below() -> None:
    assert NOISE.mean() < 0.0
    assert not below(NOISE, np.zeros(4))
    assert below(NOISE - 10.0, np.zeros(4))
    error = np.full((3, 5), 0.1)
    assert always_below(np.stack([-0.5 * error, error]))[0] == "does not hold"
    assert always_below(np.stack([-5.0 * error, error]))[0] == "holds"


def test_cases_are_counted_by_their_intervals_and_the_worst_is_named() -> None:
    result = {
        "as_assumed": interval(-0.3, -0.4, -0.2),
        "clear": interval(-0.2, -0.3, -0.1),
        "open": interval(0.1, -0.1, 0.3),
        "worse": interval(0.2, 0.1, 0.3),
    }
    cases = {name: {"title": name, "agents": {"middle": item}} for name, item in result.items()}
    (row,) = robustness_rows([{"setting": "small", "cases": cases}], {"small": "a setting"})
    assert [row[name] for name in ("better", "undecided", "worse")] == [1, 1, 1]
    assert row["at worst"].endswith("worse")
    assert "+20" in row["at worst"]


# The middle policy lies below the line through its neighbours where it is tuned, above it after.
TUNED = {"a": (0.0, 1.0), "b": (0.5, 0.4), "c": (1.0, 0.0)}
TESTED = {"a": (0.0, 1.0), "b": (0.5, 0.6), "c": (1.0, 0.0)}
RESULTS: dict[str, Any] = {
    name: SimpleNamespace(rate=np.full((4, 3), rate), mse=np.full(4, mse))
    for name, (rate, mse) in TESTED.items()
}


def test_all_policies_of_an_envelope_count_where_it_is_measured() -> None:
    np.testing.assert_allclose(best_mse(RESULTS, 0.5), 0.6)


def test_vertices_are_those_of_the_tuning_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite = load_suite(small_suite(tmp_path))
    rule = {"options": {}, "family": "family", "knows": "centre", "found_by": (0, 1)}
    candidates = {
        name: rule | {"policy": name, "rate": rate, "mse": interval(mse, mse, mse)}
        for name, (rate, mse) in (TUNED | {"d": (0.5, 0.8)}).items()
    }
    monkeypatch.setattr(envelopes, "candidates_of", lambda *_: (candidates, 4))
    monkeypatch.setattr(
        envelopes, "read_tests", lambda tests, _: {t.name: RESULTS[t.policy] for t in tests}
    )
    of = next(iter(classes_of(suite.settings[0])))
    result = envelopes.content_of(suite, suite.settings[0], of, [], Cache(tmp_path))
    assert [vertex["policy"] for vertex in result["vertices"]] == ["a", "b", "c"]
    assert [vertex["convex"] for vertex in result["vertices"]] == [True, False, True]
