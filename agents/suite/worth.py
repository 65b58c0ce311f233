"""What a class of knowledge is worth: errors at a grid of rates, one class beside another."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fusion_gym.arrays import Array
from fusion_gym.evaluation.envelope import best_mse
from fusion_gym.evaluation.episodes import EpisodeResults
from fusion_gym.evaluation.intervals import mean_interval

from .classes import HEARD, Class
from .verdict import RATES, AgentFront, Searches, interval, middles, shares_of

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
        return "hearing" if _hears(more) > _hears(less) else None
    if more.memory == less.memory and more.mode == less.mode == "sensors":
        return "packets that hold the estimate" if more.packet == "estimate" and not same else None
    if more.memory == less.memory and same and more.mode == "sensors":
        together = less.mode == "local" and less.broadcast == "packets"
        if together:
            return "deciding together"
        return "seeing measurements" if less.mode == "centre" else None
    return None


def _hears(of: Class) -> int:
    return -1 if of.broadcast is None else HEARD.index(of.broadcast)
