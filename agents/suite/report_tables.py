"""The tables of a setting: at equal rates, by class, and what each class knows more is worth."""

from typing import Any

from ..output.markup import NONE, code, markup_number, plain_text, share, table_markup
from .envelope_table import at_least, cell
from .overview import above_of
from .report_layers import figure_of
from .report_words import reference_of
from .setting_results import SettingResults
from .verdict import RATES
from .worth import SHARES

LEAST_ROOM = 0.05  # below that the share of it that an agent closes says nothing
TYPICAL = 0.2  # of the rate that always transmitting gets: where the strongest rule is named


def rates_table(results: SettingResults) -> list[str]:
    """Rules and agents of each class at a few rates."""
    head = ["class", "rate", "rules", "agents", "difference", "", "proven bound"]
    head[5] = f"simulated ({results.rollout_episodes} episodes)" if results.rollout else "simulated"
    rows = []
    for name, content in figure_of(results).items():
        beside = content.get("at") or [
            {"rate": part * results.verdict["always"]} for part in SHARES
        ]  # without agents
        for row in beside:
            rules = markup_number(row.get("rules"))
            if "at" not in content:
                error = results.rules_at(name, row["rate"])
                rules = NONE if error is None else f"{error:.4g}"
            simulated = name == "sensors_memory" or (
                name == "sensors" and "sensors_memory" not in figure_of(results)
            )
            rows.append(
                [
                    plain_text(name),
                    f"{row['rate']:.4g}",
                    rules,
                    markup_number(row.get("agents")),
                    share(row.get("difference")),
                    cell(results.rollout, row["rate"]) if simulated else NONE,
                    f"{at_least(results.bound, row['rate']):.4g}" if results.bound else NONE,
                ]
            )
    return table_markup(head, rows)


def classes_table(results: SettingResults) -> list[str]:
    """How the agents of each class did."""
    rows = []
    for name, front in results.classes.items():
        above, count = above_of(front)
        middle = share(front.get("middle")) if "middle" in front else "no price there"
        ahead = f"{-front['hindsight_room']:+.0%}" if "hindsight_room" in front else NONE
        rows.append(
            [
                plain_text(name),
                f"{front['seeds']:d}",
                middle,
                f"{len(front.get('rates', []))} of {RATES}",
                f"{len(above)} of {count}",
                _closed(results, front),
                ahead,
                _strongest(results, name),
            ]
        )
    head = [
        "class", "seeds", "agents against rules, middle", "rates there", "points above +1 %",
        "share of the gap to the reference closed", "in hindsight", "rules at a fifth of the rate",
    ]  # fmt: skip
    return table_markup(head, rows)


def _closed(results: SettingResults, front: dict[str, Any]) -> str:
    """How much of the room between rules and reference the agents close."""
    if not any("reference" in point for point in front["points"]):
        return "no reference"
    what = reference_of(results, front).removeprefix("the ").removeprefix("a ")
    room = front.get("room")
    if room is None:
        return f"none is left to {what}"
    if room < LEAST_ROOM:
        return f"room {room:.1%} only ({what})"
    return f"{front['closed']:.0%} of {room:.1%} ({what})"


def _strongest(results: SettingResults, name: str) -> str:
    """The rules that are mixed at a typical rate, without their parameters."""
    hull, rate = results.hull(name), TYPICAL * results.verdict["always"]
    left = [point for point in hull if point.rate <= rate][-1:]
    right = [point for point in hull if point.rate > rate][:1]
    rules = dict.fromkeys(point.name.split(":")[0].split(" [")[0] for point in (*left, *right))
    return ", ".join(code(rule) for rule in rules) or NONE


def worth_table(results: SettingResults) -> list[str]:
    """What each class is worth beside one that knows less."""
    rows = [
        [plain_text(row["kind"]), plain_text(row["knows"]), plain_text(row["less"])]
        + [share(row.get(who)) for who in ("rules", "agents")]
        for row in results.verdict["worth"]
        if "rules" in row or "agents" in row
    ]
    return table_markup(["what is known more", "class", "beside", "rules", "agents"], rows)
