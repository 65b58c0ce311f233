"""The tables of a setting: at equal rates, by class, and what each class knows more is worth."""

from typing import Any

from ..output.markup import NONE, code, number, plain, share, table
from .envelope_table import at_least, cell
from .found import Found
from .overview import above_of
from .report_layers import shown
from .report_words import reference_of
from .verdict import RATES
from .worth import SHARES

LEAST_ROOM = 0.05  # below that the share of it that an agent closes says nothing
TYPICAL = 0.2  # of the rate that always transmitting gets: where the strongest rule is named


def rates_table(found: Found) -> list[str]:
    """Rules and agents of each class at a few rates."""
    head = ["class", "rate", "rules", "agents", "difference", "", "proven bound"]
    head[5] = f"simulated ({found.rollout_episodes} episodes)" if found.rollout else "simulated"
    rows = []
    for name, content in shown(found).items():
        beside = content.get("at") or [
            {"rate": part * found.verdict["always"]} for part in SHARES
        ]  # without agents
        for row in beside:
            rules = number(row.get("rules"))
            if "at" not in content:
                error = found.rules_at(name, row["rate"])
                rules = NONE if error is None else f"{error:.4g}"
            simulated = name == "sensors_memory" or (
                name == "sensors" and "sensors_memory" not in shown(found)
            )
            rows.append(
                [
                    plain(name),
                    f"{row['rate']:.4g}",
                    rules,
                    number(row.get("agents")),
                    share(row.get("difference")),
                    cell(found.rollout, row["rate"]) if simulated else NONE,
                    f"{at_least(found.bound, row['rate']):.4g}" if found.bound else NONE,
                ]
            )
    return table(head, rows)


def classes_table(found: Found) -> list[str]:
    """How the agents of each class did."""
    rows = []
    for name, front in found.classes.items():
        above, asked = above_of(front)
        middle = share(front.get("middle")) if "middle" in front else "no price there"
        ahead = f"{-front['hindsight_room']:+.0%}" if "hindsight_room" in front else NONE
        rows.append(
            [
                plain(name),
                f"{front['seeds']:d}",
                middle,
                f"{len(front.get('rates', []))} of {RATES}",
                f"{len(above)} of {asked}",
                _closed(found, front),
                ahead,
                _strongest(found, name),
            ]
        )
    head = [
        "class", "seeds", "agents against rules, middle", "rates there", "points above +1 %",
        "share of the gap to the reference closed", "in hindsight", "rules at a fifth of the rate",
    ]  # fmt: skip
    return table(head, rows)


def _closed(found: Found, front: dict[str, Any]) -> str:
    """How much of the room between rules and reference the agents close."""
    if not any("reference" in point for point in front["points"]):
        return "no reference"
    what = reference_of(found, front).removeprefix("the ").removeprefix("a ")
    room = front.get("room")
    if room is None:
        return f"none is left to {what}"
    if room < LEAST_ROOM:
        return f"room {room:.1%} only ({what})"
    return f"{front['closed']:.0%} of {room:.1%} ({what})"


def _strongest(found: Found, name: str) -> str:
    """The rules that are mixed at a typical rate, without their parameters."""
    hull, rate = found.hull(name), TYPICAL * found.verdict["always"]
    left = [point for point in hull if point.rate <= rate][-1:]
    right = [point for point in hull if point.rate > rate][:1]
    rules = dict.fromkeys(point.name.split(":")[0].split(" [")[0] for point in (*left, *right))
    return ", ".join(code(rule) for rule in rules) or NONE


def worth_table(found: Found) -> list[str]:
    """What each class is worth beside one that knows less."""
    rows = [
        [plain(row["kind"]), plain(row["knows"]), plain(row["less"])]
        + [share(row.get(who)) for who in ("rules", "agents")]
        for row in found.verdict["worth"]
        if "rules" in row or "agents" in row
    ]
    return table(["what is known more", "class", "beside", "rules", "agents"], rows)
