"""What knowing and learning are worth, setting by setting: the rows of the overview."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..output import overview_figure
from ..output.markup import plain, share, table
from ..output.overview_figure import Dot, Row
from .found import Found
from .worth import RATES

ABOVE = 0.01  # a point lies above the envelope where its whole interval is further up than this
ESTIMATE = "packets that hold the estimate"
KNOWING = ("memory", "hearing", "deciding together", ESTIMATE)
HEADS = {
    "memory": "memory, of a coordinator",
    "hearing": "hearing, of sensors alone",
    "deciding together": "deciding together",
    ESTIMATE: "a packet with the estimate",
}
# Where a kind of knowledge is nothing of its own, and why.
_REASONS = {
    ("memory", "fusion_gym/MarkovJumpTracking-v0"): "nodes remember by themselves",
    ("memory", "fusion_gym/RemoteEstimation-v0"): "nothing to remember",
    (ESTIMATE, "fusion_gym/MarkovJumpTracking-v0"): "packets hold the node's estimate",
    (ESTIMATE, "fusion_gym/UnknownInput-v0"): "the centre begins anew from what was sent",
    (ESTIMATE, "fusion_gym/RemoteEstimation-v0"): "a packet is the value itself",
}


class Learned(NamedTuple):
    """A column of what learning is worth: its head, and the classes that it may be, in order."""

    head: str
    classes: tuple[str, ...]


def learned_columns(found: Found) -> list[Learned]:
    """Whose agents are set against the rules of their own class; sensors alone hear the least."""
    heard = least_heard(found)
    return [
        Learned("centre", ("centre",)),
        Learned("alone", (f"local_{heard}",)),
        Learned("alone, memory", (f"local_{heard}_memory",)),
        Learned("coordinator", ("sensors",)),
        Learned("coordinator, memory", ("sensors_memory",)),
    ]


def least_heard(found: Found) -> str:
    """What a sensor by itself hears in the environment as it is."""
    inputs = found.envelopes.get("inputs", {})
    every = [one["broadcast"] for one in found.classes.values() if one["broadcast"]]
    heard = [*inputs.get("broadcasts", ()), *every]
    return str(heard[0]) if heard else "none"


def worth_of(found: Found, kind: str) -> dict[str, Any] | None:
    """The row of a kind that stands for it: with memory if there is, of the farthest apart."""
    rows = [row for row in found.verdict["worth"] if row["kind"] == kind]
    if kind == "memory":
        rows = [row for row in rows if row["knows"] == "sensors_memory"]
    if kind == "hearing":
        rows = [
            row
            for row in rows
            if row["knows"].startswith("local_packets")
            and row["less"].startswith(f"local_{least_heard(found)}")
        ]
    rows.sort(key=lambda row: "memory" not in row["knows"])
    return rows[0] if rows else None


def reason(found: Found, kind: str) -> str:
    """Why there is nothing, in a word."""
    known = _REASONS.get((kind, found.baselines["env"]))
    if known:
        return known
    if worth_of(found, kind) is not None:
        return f"fewer than half of {RATES} rates in common"
    return "not compared"


def knowing_table(found: Mapping[str, Found]) -> list[str]:
    """Two rows a setting: of its rules and of its agents."""
    rows = []
    for one in found.values():
        for who in ("rules", "agents"):
            cells = []
            for kind in KNOWING:
                worth = worth_of(one, kind) or {}
                cells.append(share(worth[who]) if who in worth else reason(one, kind))
            rows.append([plain(one.label), who, *cells])
    return table(["setting", "of", *(HEADS[kind] for kind in KNOWING)], rows)


def learning_rows(found: Mapping[str, Found]) -> list[list[str]]:
    """One row a setting: agents against the rules of their class, by class."""
    rows = []
    for one in found.values():
        cells = [_middle(one, column) for column in learned_columns(one)]
        rows.append([plain(one.label), *cells])
    return rows


def _middle(found: Found, column: Learned) -> str:
    for name in column.classes:
        if name in found.classes:
            middle = found.classes[name].get("middle")
            return share(middle) if middle else "no price in the middle"
    kinds = ("memory", found.baselines["env"])
    if kinds in _REASONS:
        return _REASONS[kinds]
    return "no agents"


def learning_heads(found: Mapping[str, Found]) -> list[str]:
    """The heads of :func:`learning_rows`."""
    return ["setting", *(column.head for column in learned_columns(next(iter(found.values()))))]


def learning_table(found: Mapping[str, Found]) -> list[str]:
    """What learning is worth: agents against the rules of the same class."""
    return table(learning_heads(found), learning_rows(found))


def headline_table(found: Mapping[str, Found]) -> list[str]:
    """The front page's table: what memory is worth to rules, and what learning is worth."""
    memory = []
    for one in found.values():
        worth = worth_of(one, "memory") or {}
        memory.append(share(worth["rules"]) if "rules" in worth else reason(one, "memory"))
    head, *others = learning_heads(found)
    rows = [
        [row[0], rules, *row[1:]] for row, rules in zip(learning_rows(found), memory, strict=True)
    ]
    return table([head, "rules of a coordinator: memory", *others], rows)[:-1]


def headline_count(found: Mapping[str, Found]) -> str:
    """How many points of all classes lie above the envelope: the front page's sentence on it."""
    worse, asked = 0, 0
    for one in found.values():
        for front in one.classes.values():
            above, compared = above_of(front)
            worse, asked = worse + len(above), asked + compared
    return f"at {worse} of {asked} points an agent's whole interval lies above +1 % of its envelope"


def above_of(front: dict[str, Any]) -> tuple[list[dict[str, Any]], int]:
    """The points whose whole interval is more than 1 % above the envelope, and of how many."""
    compared = [point for point in front["points"] if "difference" in point]
    return [point for point in compared if point["difference"]["low"] > ABOVE], len(compared)


def above_rows(found: Mapping[str, Found]) -> list[list[str]]:
    """Each such point."""
    return [
        [
            plain(one.label),
            plain(name),
            f"{p['price']:.3g}",
            f"{p['rate']:.4f}",
            share(p["difference"]),
        ]
        for one in found.values()
        for name, front in one.classes.items()
        for p in above_of(front)[0]
    ]


def draw(results: Path, found: Mapping[str, Found]) -> None:
    """The overview's figure, into the folder, as PNG and as SVG."""
    paths = [results / f"overview.{suffix}" for suffix in ("png", "svg")]
    names = {one.name: one.label for one in found.values()}
    columns = {HEADS[kind]: (kind, _knowing(found, kind)) for kind in KNOWING}
    columns["learning"] = ("learning", list(_learning(found)))
    overview_figure.draw(paths, list(names.values()), columns)


def _knowing(found: Mapping[str, Found], kind: str) -> Sequence[Row]:
    rows = []
    for one in found.values():
        worth = worth_of(one, kind) or {}
        dots = [Dot(who, worth[who]) for who in ("rules", "agents") if who in worth]
        rows.append(Row(dots, "" if dots else reason(one, kind)))
    return rows


def _learning(found: Mapping[str, Found]) -> Iterator[Row]:
    for one in found.values():
        heard = least_heard(one)
        dots = []
        for who, names in (
            ("coordinator", ("sensors_memory", "sensors")),
            ("alone", (f"local_{heard}_memory", f"local_{heard}")),
            ("centre", ("centre",)),
        ):
            there = [one.classes[name] for name in names if name in one.classes]
            dots += [Dot(who, front["middle"]) for front in there[:1] if "middle" in front]
        yield Row(dots, "" if dots else "no agents")
