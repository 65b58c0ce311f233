"""The benchmark's verdict: its arithmetic, its interval, and the middle of a front."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from agents.suite.verdict import judge
from fusion_gym.evaluation.episodes import EpisodeResults


def made_up(rate: float, mse: Any) -> EpisodeResults:
    mse = np.asarray(mse, dtype=np.float64)
    zero = np.zeros_like(mse)
    return EpisodeResults(
        mse=mse, bound_trace=zero, nees=zero, rate=np.full((len(mse), 2), rate),
        requests=np.full((len(mse), 2), rate), tokens=zero, denied=zero, returns=zero,
        diverged=zero, squared_error=np.zeros((3, 2)),
    )  # fmt: skip


def test_the_verdict_is_the_arithmetic_that_it_says() -> None:
    generator = np.random.default_rng(0)
    noise = generator.uniform(0.5, 1.5, 400)
    baselines = {"never": made_up(0.0, 2 * noise), "always": made_up(1.0, noise)}
    references = {"never": made_up(0.0, 2 * noise), "ahead": made_up(0.25, 0.5 * noise)}
    # At rate 0.3 the envelope is 1.7, at 0.8 it is 1.2 (outside the middle).
    agents = [
        [made_up(0.3, 0.7 * 1.7 * noise), made_up(0.8, noise)],
        [made_up(0.3, 0.8 * 1.7 * noise), made_up(0.8, noise)],
    ]
    ahead = {
        "dear": made_up(0.1, 0.6 * noise[:50]),
        "cheap": made_up(0.5, 0.2 * noise[:50]),
    }
    verdict = judge(agents, [0.1, 0.01], baselines, references, always=1.0, clairvoyant=ahead)
    point = verdict["points"][0]
    assert point["hindsight"] == pytest.approx(0.4 * noise.mean())
    assert verdict["hindsight_room"] == pytest.approx(1.0 - 0.4 / 1.7)
    assert point["envelope"] == pytest.approx(1.7 * noise.mean())
    assert verdict["middle"]["mean"] == pytest.approx(-0.25)
    assert verdict["middle"]["low"] == pytest.approx(-0.3)
    assert verdict["middle"]["high"] == pytest.approx(-0.2)
    room = 1.7 - 0.5
    assert verdict["room"] == pytest.approx(room / 1.7)
    assert verdict["closed"] == pytest.approx((1.7 - 0.75 * 1.7) / room)
    assert verdict["points"][1]["difference"]["mean"] == pytest.approx(1 / 1.2 - 1)


@pytest.mark.parametrize("always", [1.0, 0.4])
def test_the_middle_of_the_front_is_from_a_twentieth_to_half_of_always(
    always: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rates just outside and just inside, each with a difference of its own."""
    monkeypatch.setattr("agents.suite.verdict.RESAMPLES", 20)
    noise = np.random.default_rng(0).uniform(0.5, 1.5, 50)
    baselines = {"never": made_up(0.0, 2 * noise), "always": made_up(1.0, noise)}

    def middle(*shares: float) -> float | None:
        rates = [share * always for share in shares]
        agents = [[made_up(rate, 0.9 * (2.0 - rate) * noise) for rate in rates]]
        verdict = judge(agents, list(rates), baselines, {}, always=always)
        return verdict["middle"]["mean"] if "middle" in verdict else None

    assert middle(0.049, 0.501) is None
    assert middle(0.051) == pytest.approx(-0.1)
    assert middle(0.499) == pytest.approx(-0.1)


def test_the_interval_covers_the_difference_between_episodes() -> None:
    """Unpaired noise of known deviation: the interval is that of the ratio of two means."""
    generator = np.random.default_rng(1)
    baselines = {"never": made_up(0.0, generator.normal(1.0, 0.2, 2000))}
    agents = [[made_up(0.1, generator.normal(0.9, 0.2, 2000))] for _ in range(1)]
    found = judge(agents, [1.0], baselines, {}, always=1.0)["middle"]
    deviation = 0.2 * np.sqrt((1 + 0.9**2) / 2000)
    width = (found["high"] - found["low"]) / (2 * 1.96)
    assert width == pytest.approx(deviation, rel=0.1)
