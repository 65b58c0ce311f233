"""What knowing and learning are worth, setting by setting: the rows of the overview."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..output import overview_figure
from ..output.markup import plain_text, share, table_markup
from ..output.overview_figure import Dot, OverviewRow
from .setting_results import SettingResults
from .worth import RATES

ABOVE = 0.01  # a point lies above the envelope where its whole interval is further up than this
ESTIMATE = "packets that hold the estimate"
KNOWING = ("memory", "hearing", "deciding together", ESTIMATE)
HEADS = {
    "memory": "memory, of a scheduler",
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


def learned_columns(results: SettingResults) -> list[Learned]:
    """Whose agents are set against the rules of their own class; sensors alone hear the least."""
    received = least_broadcast(results)
    return [
        Learned("centre", ("centre",)),
        Learned("alone", (f"local_{received}",)),
        Learned("alone, memory", (f"local_{received}_memory",)),
        Learned("scheduler", ("sensors",)),
        Learned("scheduler, memory", ("sensors_memory",)),
    ]


def least_broadcast(results: SettingResults) -> str:
    """What a sensor by itself hears in the environment as it is."""
    inputs = results.envelopes.get("inputs", {})
    every = [item["broadcast"] for item in results.classes.values() if item["broadcast"]]
    received = [*inputs.get("broadcasts", ()), *every]
    return str(received[0]) if received else "none"


def worth_of(results: SettingResults, kind: str) -> dict[str, Any] | None:
    """The row of a kind that stands for it: with memory if there is, of the farthest apart."""
    rows = [row for row in results.verdict["worth"] if row["kind"] == kind]
    if kind == "memory":
        rows = [row for row in rows if row["knows"] == "sensors_memory"]
    if kind == "hearing":
        rows = [
            row
            for row in rows
            if row["knows"].startswith("local_packets")
            and row["less"].startswith(f"local_{least_broadcast(results)}")
        ]
    rows.sort(key=lambda row: "memory" not in row["knows"])
    return rows[0] if rows else None


def reason(results: SettingResults, kind: str) -> str:
    """Why there is nothing, in a word."""
    known = _REASONS.get((kind, results.baselines["env"]))
    if known:
        return known
    if worth_of(results, kind) is not None:
        return f"fewer than half of {RATES} rates in common"
    return "not compared"


def knowing_table(settings: Mapping[str, SettingResults]) -> list[str]:
    """Two rows a setting: of its rules and of its agents."""
    rows = []
    for setting in settings.values():
        for who in ("rules", "agents"):
            cells = []
            for kind in KNOWING:
                worth = worth_of(setting, kind) or {}
                cells.append(share(worth[who]) if who in worth else reason(setting, kind))
            rows.append([plain_text(setting.label), who, *cells])
    return table_markup(["setting", "of", *(HEADS[kind] for kind in KNOWING)], rows)


def learning_rows(settings: Mapping[str, SettingResults]) -> list[list[str]]:
    """One row a setting: agents against the rules of their class, by class."""
    rows = []
    for setting in settings.values():
        cells = [_middle(setting, column) for column in learned_columns(setting)]
        rows.append([plain_text(setting.label), *cells])
    return rows


def _middle(results: SettingResults, column: Learned) -> str:
    for name in column.classes:
        if name in results.classes:
            middle = results.classes[name].get("middle")
            return share(middle) if middle else "no price in the middle"
    kinds = ("memory", results.baselines["env"])
    if kinds in _REASONS:
        return _REASONS[kinds]
    return "no agents"


def learning_heads(settings: Mapping[str, SettingResults]) -> list[str]:
    """The heads of :func:`learning_rows`."""
    return ["setting", *(column.head for column in learned_columns(next(iter(settings.values()))))]


def learning_table(settings: Mapping[str, SettingResults]) -> list[str]:
    """What learning is worth: agents against the rules of the same class."""
    return table_markup(learning_heads(settings), learning_rows(settings))


def overview_table(results: Mapping[str, SettingResults]) -> list[str]:
    """The front page's table: what memory is worth to rules, and what learning is worth."""
    memory = []
    for result in results.values():
        worth = worth_of(result, "memory") or {}
        memory.append(share(worth["rules"]) if "rules" in worth else reason(result, "memory"))
    head, *others = learning_heads(results)
    rows = [
        [row[0], rules, *row[1:]] for row, rules in zip(learning_rows(results), memory, strict=True)
    ]
    return table_markup([head, "rules of a scheduler: memory", *others], rows)[:-1]


def headline_count(settings: Mapping[str, SettingResults]) -> str:
    """How many points of all classes lie above the envelope: the front page's sentence on it."""
    worse, count = 0, 0
    for setting in settings.values():
        for front in setting.classes.values():
            above, compared = above_of(front)
            worse, count = worse + len(above), count + compared
    return f"at {worse} of {count} points an agent's whole interval lies above +1 % of its envelope"


def above_of(front: dict[str, Any]) -> tuple[list[dict[str, Any]], int]:
    """The points whose whole interval is more than 1 % above the envelope, and of how many."""
    compared = [point for point in front["points"] if "difference" in point]
    return [point for point in compared if point["difference"]["low"] > ABOVE], len(compared)


def above_rows(settings: Mapping[str, SettingResults]) -> list[list[str]]:
    """Each such point."""
    return [
        [
            plain_text(setting.label),
            plain_text(name),
            f"{p['price']:.3g}",
            f"{p['rate']:.4f}",
            share(p["difference"]),
        ]
        for setting in settings.values()
        for name, front in setting.classes.items()
        for p in above_of(front)[0]
    ]


def draw_overview(results: Path, settings: Mapping[str, SettingResults]) -> None:
    """The overview's figure, into the folder, as PNG and as SVG."""
    paths = [results / f"overview.{suffix}" for suffix in ("png", "svg")]
    names = {setting.name: setting.label for setting in settings.values()}
    columns = {HEADS[kind]: (kind, _knowing(settings, kind)) for kind in KNOWING}
    columns["learning"] = ("learning", list(_learning(settings)))
    overview_figure.draw_overview_figure(paths, list(names.values()), columns)


def _knowing(settings: Mapping[str, SettingResults], kind: str) -> Sequence[OverviewRow]:
    rows = []
    for setting in settings.values():
        worth = worth_of(setting, kind) or {}
        dots = [Dot(who, worth[who]) for who in ("rules", "agents") if who in worth]
        rows.append(OverviewRow(dots, "" if dots else reason(setting, kind)))
    return rows


def _learning(settings: Mapping[str, SettingResults]) -> Iterator[OverviewRow]:
    for setting in settings.values():
        received = least_broadcast(setting)
        dots = []
        for who, names in (
            ("scheduler", ("sensors_memory", "sensors")),
            ("alone", (f"local_{received}_memory", f"local_{received}")),
            ("centre", ("centre",)),
        ):
            there = [setting.classes[name] for name in names if name in setting.classes]
            dots += [Dot(who, front["middle"]) for front in there[:1] if "middle" in front]
        yield OverviewRow(dots, "" if dots else "no agents")
