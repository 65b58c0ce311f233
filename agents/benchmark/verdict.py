"""The verdict: learned fronts against envelopes at the agents' own rates, and class by class."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agents.benchmark.classes import HEARD, Class
from agents.benchmark.tables import group_by, read_rows, write_rows
from fusion_gym.arrays import Array
from fusion_gym.evaluation.envelope import EnvelopePoint, best_mse, envelope_mse, height
from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.evaluation.intervals import mean_interval

RESAMPLES = 2000
MIDDLE = (0.05, 0.5)  # of the rate that transmitting always gets: the middle of the front
RATES = 10  # of the grid over the middle, each for an equal part of it in the logarithm
_PRICE = (1, 1, 1, 2)  # the axis of the prices in the arrays of a front
Searches = Sequence[Sequence[tuple[float, float]]]


class AgentFront(NamedTuple):
    """An agent beside the envelope, at P prices.

    ``learned`` and ``envelope`` (seeds, P, E) are the agents' MSE and the envelope's at their own
    ``rates`` (seeds, P); ``tuned`` (K, seeds, P) is the height there of what each of K searches
    alone would have made of the envelope, as a share of their mean.
    """

    learned: Array
    envelope: Array
    rates: Array
    tuned: Array

    def at(self, price: int) -> AgentFront:
        """The front at one price alone."""
        lane = slice(price, price + 1)
        return AgentFront(
            self.learned[:, lane],
            self.envelope[:, lane],
            self.rates[:, lane],
            self.tuned[..., lane],
        )


def judge(
    agents: Sequence[Sequence[EpisodeResults]],
    prices: Sequence[float],
    envelope: Mapping[str, EpisodeResults],
    references: Mapping[str, EpisodeResults],
    always: float,
    clairvoyant: Mapping[str, EpisodeResults] | None = None,
    searches: Searches = (),
) -> dict[str, Any]:
    """Points and verdict of one front.

    ``agents[seed][price]`` are test results of one training seed at one price. ``envelope`` has
    the rules of a committed envelope, all of which count. A point has the mean rate and MSE over
    seeds, the envelope and the references' there, and the relative difference of the MSE to the
    envelope: the interquartile mean over seeds. The verdict, ``middle``, is the plain mean of that
    over a fixed grid of rates: the middles of ten equal parts, in the logarithm, of 5 % to 50 % of
    ``always``, the rate that always transmitting gets. Between prices it is interpolated in the
    logarithm of the rate; parts that the front does not reach are left out. ``prices`` says how
    many prices lie in the middle, ``rates`` which rates of the grid count.

    The 95 % intervals are bootstrapped over (paired) episodes, training seeds (one agent for all
    prices), the grid's rates and tuning seeds, all at once. ``searches`` has the envelope, as
    (rate, MSE), that each tuning seed would have made alone: a resample draws as many of them as
    there are and scales the envelope by their mean, as a share of the mean of all; so it has the
    spread of tuning and no shift. ``clairvoyant`` has results of schedules made in hindsight, on
    the first of the episodes: points have their MSE at the same rate, as a share of the envelope on
    the same episodes times that on all.
    """
    points, columns, stored = [], [], []
    for place, price in enumerate(prices):
        column = [seed[place] for seed in agents]
        rates = [float(value.rate.mean()) for value in column]
        learned: Array = np.array([value.mse for value in column])
        rate = float(np.mean(rates))
        point: dict[str, Any] = {"price": price, "rate": rate, "mse": float(learned.mean())}
        floors = [best_mse(envelope, own) for own in rates]
        if all(floor is not None for floor in floors):
            below = np.array(floors)
            point["envelope"] = float(below.mean())
            columns.append((learned, below, rates, shares_of(searches, rates)))
            stored.append(point)
            known = [envelope_mse(references, own) for own in rates] if references else []
            sound = [value.mean() for value in known if value is not None]
            if sound and len(sound) == len(rates):
                point["reference"] = float(np.mean(sound))
            ahead = envelope_mse(clairvoyant, rate) if clairvoyant else None
            if ahead is not None:
                share = ahead.mean() / below[:, : len(ahead)].mean()
                point["hindsight"] = float(share * below.mean())
        points.append(point)
    verdict: dict[str, Any] = {"points": points, "seeds": len(agents)}
    if stored:
        parts = [np.array(part) for part in zip(*columns, strict=True)]  # prices first
        front = AgentFront(
            *(np.moveaxis(part, 0, axis) for part, axis in zip(parts, _PRICE, strict=True))
        )
        for place, point in enumerate(stored):
            point["difference"] = interval(front.at(place), np.array([point["rate"]]))
        grid = grid_of(front, always)
        inside = sum(_in_middle(point, always) for point in stored)
        verdict |= {"prices": inside, "rates": grid.tolist()}
        if inside:
            verdict["middle"] = interval(front, grid)
    gaps = [p for p in points if "reference" in p and _in_middle(p, always)]
    room = sum(p["envelope"] - p["reference"] for p in gaps)
    if room > 0.0:
        verdict["room"] = room / sum(p["envelope"] for p in gaps)
        verdict["closed"] = sum(p["envelope"] - p["mse"] for p in gaps) / room
    loose = [p for p in points if "hindsight" in p and _in_middle(p, always)]
    if loose:
        part = sum(p["hindsight"] for p in loose) / sum(p["envelope"] for p in loose)
        verdict["hindsight_room"] = 1.0 - part
    return verdict


def _in_middle(point: Mapping[str, float], always: float) -> bool:
    return MIDDLE[0] * always <= point["rate"] <= MIDDLE[1] * always


def shares_of(searches: Searches, rates: Sequence[float]) -> Array:
    """Height (K, seeds) of each search's own envelope at these rates, as a share of their mean.

    One search, or a rate at which some search has nothing, says nothing of the spread: shares of 1.
    """
    values = np.ones((max(len(searches), 1), len(rates)))
    hulls = [[EnvelopePoint(f"{rate}", rate, mse) for rate, mse in search] for search in searches]
    for column, rate in enumerate(rates):
        heights = [height(hull, rate) for hull in hulls]
        if heights and None not in heights:
            known = np.array(heights, dtype=np.float64)
            values[:, column] = known / known.mean()
    return values


def middles(always: float) -> Array:
    """The grid's rates: the middles of its parts."""
    edges = np.geomspace(MIDDLE[0] * always, MIDDLE[1] * always, RATES + 1)
    return np.asarray(np.sqrt(edges[:-1] * edges[1:]))


def grid_of(front: AgentFront, always: float) -> Array:
    """The grid's rates, of those of its parts that the front reaches; moved to its nearest end."""
    edges = np.geomspace(MIDDLE[0] * always, MIDDLE[1] * always, RATES + 1)
    rates = front.rates.mean(0)
    low, high = rates.min(), rates.max()
    reached = (edges[:-1] <= high) & (edges[1:] >= low)
    return np.asarray(np.clip(middles(always)[reached], low, high))


def trimmed(shares: Array) -> Array:
    """Mean over the first axis without its lowest and highest quarter, each rounded down."""
    cut = len(shares) // 4
    stored = np.sort(shares, axis=0)[cut : len(shares) - cut]
    return np.asarray(stored.mean(0))


def _between(values: Array, rates: Array, grid: Array) -> Array:
    """The values (P,) at the grid's rates, interpolated in the logarithm of the rates (P,)."""
    places, which = np.unique(rates, return_inverse=True)
    means = np.bincount(which, weights=values) / np.bincount(which)
    tiny = np.finfo(np.float64).tiny  # of an agent that never transmits
    return np.interp(np.log(np.maximum(grid, tiny)), np.log(np.maximum(places, tiny)), means)


def interval(front: AgentFront, grid: Array) -> dict[str, float]:
    """Mean over the grid's rates of the relative difference to the envelope, and its interval."""
    result = front.learned.mean(-1) / front.envelope.mean(-1) - 1.0
    generator = np.random.default_rng(0)
    seeds, _, episodes = front.learned.shape
    searches = len(front.tuned)
    weights = generator.multinomial(
        episodes, np.full(episodes, 1.0 / episodes), size=RESAMPLES
    ).T.astype(np.float64)
    tuned = front.tuned[generator.integers(0, searches, (RESAMPLES, searches))].mean(1)
    below = np.moveaxis(tuned, 0, -1) * (front.envelope @ weights)
    shares = (front.learned @ weights) / below - 1.0  # (seeds, P, resamples)
    choice = generator.integers(0, seeds, (seeds, RESAMPLES))
    middle = trimmed(np.take_along_axis(shares, choice[:, None], axis=0))
    rates = front.rates[choice].mean(0)  # (resamples, P)
    places = generator.integers(0, len(grid), (RESAMPLES, len(grid)))
    drawn = [
        _between(middle[:, item], rates[item], grid)[places[item]].mean()
        for item in range(RESAMPLES)
    ]
    low, high = np.quantile(drawn, (0.025, 0.975))
    mean = float(_between(trimmed(result), front.rates.mean(0), grid).mean())
    return {"mean": mean, "low": float(low), "high": float(high)}


SHARES = (0.05, 0.1, 0.2, 0.4)  # of the rate that transmitting always gets


@dataclass(frozen=True)
class ClassTests:
    """A class with its rules and agents on the test episodes.

    ``agents[seed][price]``, of which there may be none; ``searches`` as :func:`judge` has them.
    """

    of: Class
    rules: Mapping[str, EpisodeResults]
    agents: Sequence[Sequence[EpisodeResults]]
    searches: Searches

    def rule_mse(self, rate: float) -> Array | None:
        """The rules' MSE (1, E) at a rate."""
        result = best_mse(self.rules, rate)
        return None if result is None else result[None]

    def agent_mse(self, rate: float) -> Array | None:
        """The agents' MSE (seeds, E) at a rate, mixed of the two prices beside it.

        None without agents, or where some agent has no price on one side of the rate.
        """
        result = []
        for column in self.agents:
            by_place = {f"{place:03d}": results for place, results in enumerate(column)}
            highest = max(float(results.rate.mean()) for results in column)
            mse = best_mse(by_place, rate) if rate <= highest else None
            if mse is None:
                return None
            result.append(mse)
        return np.array(result) if result else None


def at_rates(tested: ClassTests, always: float) -> list[dict[str, Any]]:
    """Rules, agents and their relative difference at each of :data:`SHARES`, with intervals."""
    rows = []
    for share in SHARES:
        rate = share * always
        row: dict[str, Any] = {"rate": rate}
        rules, agents = tested.rule_mse(rate), tested.agent_mse(rate)
        if rules is not None:
            row["rules"] = mean_interval(rules[0])._asdict()
        if agents is not None:
            single = compare_classes(agents[:, None], np.ones_like(agents)[:, None], [rate])
            row["agents"] = {name: 1.0 + value for name, value in single.items()}
        if rules is not None and agents is not None:
            heights = shares_of(tested.searches, [rate] * len(agents))[..., None]
            below = np.repeat(rules, len(agents), axis=0)
            row["difference"] = compare_classes(agents[:, None], below[:, None], [rate], heights)
        rows.append(row)
    return rows


def compare_classes(
    learned: Array, below: Array, rates: Sequence[float], tuned: Array | None = None
) -> dict[str, float]:
    """Relative difference of errors (seeds, P, E) at P rates, as :func:`interval` has it."""
    seeds, count, _ = learned.shape
    own = np.broadcast_to(np.array(rates), (seeds, count))
    spread = np.ones((1, seeds, count)) if tuned is None else tuned
    return interval(AgentFront(learned, below, own, spread), np.array(rates))


def worths(tested: Mapping[str, ClassTests], always: float) -> list[dict[str, Any]]:
    """What more knowledge is worth, by rules and by agents, over the grid of the verdict's rates.

    Each row has the relative difference of the MSE of ``knows`` to that of ``less`` at equal rate,
    where both reach at least half of the grid; over paired episodes, training seeds and rates.
    """
    rows = []
    for kind, more, less in pairs([item.of for item in tested.values()]):
        row: dict[str, Any] = {"kind": kind, "knows": more, "less": less}
        for who in ("rules", "agents"):
            result = _worth(tested[more], tested[less], who, always)
            if result is not None:
                row[who] = result
        rows.append(row)
    return rows


def _worth(more: ClassTests, less: ClassTests, who: str, always: float) -> dict[str, float] | None:
    rates: list[float] = []
    columns: list[tuple[Array, Array]] = []
    for rate in middles(always).tolist():
        ask = ClassTests.rule_mse if who == "rules" else ClassTests.agent_mse
        own, other = ask(more, rate), ask(less, rate)
        if own is not None and other is not None:
            seeds = min(len(own), len(other))
            rates.append(rate)
            columns.append((own[:seeds], other[:seeds]))
    if 2 * len(columns) < RATES:
        return None
    known, beside = (np.stack(part, axis=1) for part in zip(*columns, strict=True))
    return compare_classes(known, beside, rates)


def pairs(classes: Sequence[Class]) -> Iterator[tuple[str, str, str]]:
    """What is compared: a kind, the class that knows more, and the one that knows less."""
    for more in classes:
        for less in classes:
            kind = _kind(more, less)
            if kind is not None:
                yield kind, more.name, less.name


def _kind(more: Class, less: Class) -> str | None:
    same = more.packet == less.packet
    if more.mode == less.mode and same and more.broadcast == less.broadcast:
        return "memory" if more.memory and not less.memory else None
    if more.memory == less.memory and more.mode == less.mode == "local":
        order = HEARD.index
        wider = order(more.broadcast or "none") > order(less.broadcast or "none")
        return "hearing" if wider else None
    if more.memory == less.memory and more.mode == less.mode == "sensors":
        return "packets that hold the estimate" if more.packet == "estimate" and not same else None
    if more.memory == less.memory and same and more.mode == "sensors":
        together = less.mode == "local" and less.broadcast == "packets"
        if together:
            return "deciding together"
        return "seeing measurements" if less.mode == "centre" else None
    return None


ROBUSTNESS = "robustness"  # of the page for readers in that of the results, and a table's name
KINDS = ("agents", "trained")  # agents as they are, and trained over draws
Report = Mapping[str, Any]


def write_cases(folder: Path, report: Report) -> None:
    """Write what was found of a class into the tables of its setting, beside the other classes."""
    own, points = [], []
    for case, row in report["cases"].items():
        of = {"class": report["class"], "case": case}
        whole = {key: report[key] for key in ("episodes", "sha256")} | dict(row) | of
        kinds = [kind for kind in KINDS if kind in row]
        own += [{**whole, **row[kind], "kind": kind} for kind in kinds] or [whole]
        points += [{**of, "kind": kind} | point for kind in kinds for point in row[kind]["points"]]
    for table, rows in (("robustness_points", points), (ROBUSTNESS, own)):
        there = read_rows(folder, table) if (folder / f"{table}.csv").exists() else []
        others = [row for row in there if row["class"] != report["class"]]
        write_rows(folder, table, [*others, *rows])


def read_cases(results: Path, settings: Sequence[str]) -> list[dict[str, Any]]:
    """What was found in settings, in their order, by class.

    Raises:
        ConfigurationError: a table that cannot be read or is of another shape.
    """
    result = []
    for name in settings:
        folder = results / name
        rows = read_rows(folder, ROBUSTNESS) if (folder / f"{ROBUSTNESS}.csv").exists() else []
        for of, own in sorted(group_by(rows, "class").items()):
            cases: dict[str, Any] = {}
            for row in own:
                case = cases.setdefault(
                    row["case"],
                    {key: row[key] for key in ("title", "always", "rules") if key in row},
                )
                if "kind" in row:
                    case[row["kind"]] = row
            report = {key: own[0][key] for key in ("episodes", "sha256")}
            report["env"] = read_rows(folder, "setting")[0]["env"]
            result.append({"setting": name, "class": of, "cases": cases} | report)
    return result


def is_gain(middle: Mapping[str, float]) -> bool:
    """Whether the whole interval lies on the side of the agents."""
    return middle["high"] < 0.0
