"""The benchmark's verdict: its arithmetic, its interval, and the middle of a front."""

from typing import Any

import numpy as np
import pytest
from rliable import library, metrics

from agents.benchmark.verdict import AgentFront, interval, judge
from fusion_gym.evaluation.episodes import EpisodeResults


def made_up(rate: float, mse: Any) -> EpisodeResults:
    mse = np.asarray(mse, dtype=np.float64)
    zero = np.zeros_like(mse)
    return EpisodeResults(
        mse=mse, error_cost=mse, bound_trace=zero, nees=zero, rate=np.full((len(mse), 2), rate),
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
    assert point["difference"]["mean"] == pytest.approx(-0.25)
    assert point["difference"]["low"] == pytest.approx(-0.3)
    assert point["difference"]["high"] == pytest.approx(-0.2)
    # The front reaches the last three parts of the grid, from 0.25 on: the first is moved to 0.3.
    edges = np.geomspace(0.05, 0.5, 11)
    grid = np.maximum(np.sqrt(edges[:-1] * edges[1:])[-3:], 0.3)
    assert verdict["rates"] == pytest.approx(grid)
    assert verdict["prices"] == 1
    shares = np.log(grid / 0.3) / np.log(0.8 / 0.3)
    assert verdict["middle"]["mean"] == pytest.approx(
        np.mean((1 - shares) * -0.25 + shares * (1 / 1.2 - 1))
    )
    room = 1.7 - 0.5
    assert verdict["room"] == pytest.approx(room / 1.7)
    assert verdict["closed"] == pytest.approx((1.7 - 0.75 * 1.7) / room)
    assert verdict["points"][1]["difference"]["mean"] == pytest.approx(1 / 1.2 - 1)


@pytest.mark.parametrize("always", [1.0, 0.4])
@pytest.mark.usefixtures("few_resamples")
def test_the_middle_of_the_front_is_from_a_twentieth_to_half_of_always(always: float) -> None:
    """Rates just outside and just inside, each with a difference of its own."""
    noise = np.random.default_rng(0).uniform(0.5, 1.5, 50)
    baselines = {"never": made_up(0.0, 2 * noise), "always": made_up(1.0, noise)}

    def middle(*shares: float) -> float | None:
        rates = [share * always for share in shares]
        agents = [[made_up(rate, 0.9 * (2.0 - rate) * noise) for rate in rates]]
        verdict = judge(agents, list(rates), baselines, {}, always=always)
        return verdict["middle"]["mean"] if "middle" in verdict else None

    assert middle(0.049, 0.501) is None, "no price in the middle"
    assert middle(0.051) == pytest.approx(-0.1)
    assert middle(0.499) == pytest.approx(-0.1)


def test_the_interval_covers_the_difference_between_episodes() -> None:
    """Unpaired noise of known deviation: the interval is that of the ratio of two means."""
    generator = np.random.default_rng(1)
    baselines = {"never": made_up(0.0, generator.normal(1.0, 0.2, 2000))}
    agents = [[made_up(0.1, generator.normal(0.9, 0.2, 2000))] for _ in range(1)]
    result = judge(agents, [1.0], baselines, {}, always=1.0)["middle"]
    deviation = 0.2 * np.sqrt((1 + 0.9**2) / 2000)
    width = (result["high"] - result["low"]) / (2 * 1.96)
    assert width == pytest.approx(deviation, rel=0.1)


def front_of(differences: Any, rates: Any) -> AgentFront:
    """A front of given relative differences (seeds, P) without any noise of episodes."""
    shares = np.asarray(differences, dtype=np.float64)
    learned = (1.0 + shares)[..., None] * np.ones(3)
    own = np.broadcast_to(rates, shares.shape)
    return AgentFront(learned, np.ones_like(learned), own, np.ones((1, *shares.shape)))


def test_no_price_is_trimmed_away() -> None:
    """Seeds are trimmed at each price; a price that stands out counts as every other one."""
    differences = np.array([[-0.9, -0.1, -0.1, -0.1]] * 3 + [[-0.9, -0.1, -0.1, 9.0]])
    rates = np.array([0.1, 0.2, 0.3, 0.4])
    result = interval(front_of(differences, rates), rates)
    assert result["mean"] == pytest.approx(np.mean([-0.9, -0.1, -0.1, -0.1]))
    assert result["low"] < -0.4, "the grid's rates are drawn anew"
    assert result["high"] > -0.2


def test_the_interval_counts_what_tuning_seeds_change() -> None:
    """The mean stays, and the width is that of the envelope's mean over drawn searches."""
    shares, rates = np.full((1, 1), -0.2), np.array([0.2])
    front = front_of(shares, rates)
    still = interval(front, rates)
    assert still["low"] == still["high"] == pytest.approx(-0.2)
    spread = np.array([0.9, 1.0, 1.1])[:, None, None]
    moved = interval(AgentFront(front.learned, front.envelope, front.rates, spread), rates)
    assert moved["mean"] == pytest.approx(-0.2)
    assert moved["low"] == pytest.approx(0.8 / 1.1 - 1.0, abs=0.02)
    assert moved["high"] == pytest.approx(0.8 / 0.9 - 1.0, abs=0.02)


def test_searches_are_compared_at_the_agents_rates() -> None:
    noise = np.random.default_rng(0).uniform(0.9, 1.1, 60)
    envelope = {"never": made_up(0.0, 2 * noise), "always": made_up(1.0, noise)}
    agents = [[made_up(0.2, 1.8 * noise)]]
    searches = [[(0.0, 1.8), (1.0, 0.9)], [(0.0, 2.2), (1.0, 1.1)]]
    result = judge(agents, [1.0], envelope, {}, always=1.0, searches=searches)["middle"]
    assert result["mean"] == pytest.approx(0.0)
    assert result["low"] == pytest.approx(1 / 1.1 - 1, abs=1e-6)
    assert result["high"] == pytest.approx(1 / 0.9 - 1, abs=1e-6)


def test_one_table_as_rliable_has_it() -> None:
    """Interquartile means over seeds at each of four prices, and their mean; bootstrapped too."""
    means = np.array([-0.1, -0.09, -0.12, -0.07])
    noise = np.random.default_rng(3).normal(size=(20, 4))
    # Columns without correlation: the library draws the seeds of each price by themselves, and one
    # agent has all prices here.
    shares = means + 0.2 * np.linalg.qr(noise - noise.mean(0))[0]
    rates = np.array([0.1, 0.2, 0.3, 0.4])
    result = interval(front_of(shares, rates), rates)

    def mean_of_prices(scores: Any) -> Any:
        columns = [metrics.aggregate_iqm(scores[:, [place]]) for place in range(scores.shape[1])]
        return np.array([np.mean(columns)])

    np.random.seed(0)  # noqa: NPY002  # where the library draws seeds and prices from
    point, ends = library.get_interval_estimates(
        {"agent": shares},
        mean_of_prices,
        reps=500,
        task_bootstrap=True,
        random_state=np.random.RandomState(0),
    )
    assert result["mean"] == pytest.approx(point["agent"][0])
    width = ends["agent"][1, 0] - ends["agent"][0, 0]
    assert result["high"] - result["low"] == pytest.approx(width, rel=0.2)
    assert (result["low"], result["high"]) == pytest.approx(ends["agent"][:, 0], abs=0.2 * width)
