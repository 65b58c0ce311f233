"""What was found, in sentences that follow from the numbers by fixed rules."""

from collections.abc import Mapping, Sequence
from typing import Any

from ..output.markup import ranged, share
from .envelope_table import HEADLINE, at_least
from .overview import above_of, reason, worth_of
from .setting_results import SettingResults
from .verdict import MIDDLE

EQUAL = 0.01  # what lies no further above the optimum is as good
NAMES = {"centre": "centre", "local": "sensors alone", "sensors": "scheduler"}
HEARING = {"none": "hearing nothing", "estimate": "hearing estimates", "packets": "hearing packets"}


def policy_label(content: Mapping[str, Any]) -> str:
    """A class in words."""
    held = "sending the estimate" if content["packet"] == "estimate" else ""
    remembers = "with memory" if content["memory"] else ""
    received = HEARING.get(content["broadcast"] or "", "")
    return " ".join(part for part in (NAMES[content["mode"]], received, held, remembers) if part)


def _percent(value: float) -> str:
    """A share, with a digit behind the point where it is small."""
    return f"{100.0 * value:.1f} %" if abs(value) < 0.0995 else f"{100.0 * value:.0f} %"


def change(interval: Mapping[str, float], than: str) -> str:
    """How an error compares with another one, as far as its interval tells."""
    mean, low, high = (interval[end] for end in ("mean", "low", "high"))
    if high < 0.0:
        return (
            f"is {_percent(-mean)} lower than {than} (95 %: {_percent(-high)} to {_percent(-low)})"
        )
    if low > 0.0:
        return f"is {_percent(mean)} higher than {than} (95 %: {_percent(low)} to {_percent(high)})"
    return f"cannot be told from {than} ({share(interval)})"


def sentences(results: SettingResults) -> list[str]:
    """On knowledge, on learning, and on what is proven."""
    return [knowledge(results), learning(results), floors(results)]


def knowledge(results: SettingResults) -> str:
    """What memory does."""
    worth = worth_of(results, "memory") or {}
    text = [
        f"with memory the error of a scheduler's {who} {change(worth[who], 'without')}"
        for who in ("rules", "agents")
        if who in worth
    ]
    if not text:
        return f"**Memory** is not compared here: {reason(results, 'memory')}."
    return f"**Memory**: {'; '.join(text)}."


def learning(results: SettingResults) -> str:
    """Where agents lie beside the strongest rules of their class."""
    sides: dict[str, list[str]] = {"below": [], "above": [], "apart": []}
    for content in results.classes.values():
        if "middle" in content:
            middle = content["middle"]
            side = "below" if middle["high"] < 0.0 else "above" if middle["low"] > 0.0 else "apart"
            sides[side].append(f"{policy_label(content)} {share(middle)}")
    heads = {
        "below": "agents lie below the strongest rules of their class",
        "above": "agents lie above the strongest rules of their class",
        "apart": "agents cannot be told from the strongest rules of their class",
    }
    parts = [f"{heads[side]}: {', '.join(who)}" for side, who in sides.items() if who]
    if not parts:
        return "**Learning**: no agent has a price in the middle of the front so far."
    counts = [above_of(content) for content in results.classes.values()]
    worse, total = sum(len(points) for points, _ in counts), sum(count for _, count in counts)
    return (
        f"**Learning**: {'; '.join(parts)}. At {worse} of {total} points the whole interval lies "
        "more than 1 % above."
    )


def floors(results: SettingResults) -> str:
    """The optimum where it is known, else the proven bound, else what the reference is."""
    parts = [_beside(results, name) for name in _referred(results)]
    bound = results.bound
    if bound is not None:
        rate = HEADLINE * results.verdict["always"]
        least = at_least(bound, rate)
        text = f"at the rate {rate:.3g} no policy has an error below {least:.3g}"
        best = results.rules_at("sensors_memory", rate) or results.rules_at("sensors", rate)
        if best is not None:
            text += f"; a scheduler's strongest rules have {best:.3g}, {best / least:.1f} times it"
        parts.append(f"{text}. This is proven, but no policy is known that reaches it")
    if not parts:
        return "**Floor**: no bound, optimum or reference is known at these rates."
    return f"**Floor**: {'. '.join(part[0].upper() + part[1:] for part in parts)}."


def _referred(results: SettingResults) -> list[str]:
    """The classes with a reference of which something is said."""
    scheduler = "sensors" if "sensors" in results.classes else "sensors_memory"
    required = [scheduler, "centre"]
    return [name for name in required if name in results.classes and gap(results, name)]


def gap(results: SettingResults, name: str) -> tuple[float, float] | None:
    """How far rules and agents lie above a class's reference, over the prices in the middle."""
    front, always = results.classes[name], results.verdict["always"]
    inside = [
        point
        for point in front["points"]
        if "reference" in point and MIDDLE[0] * always <= point["rate"] <= MIDDLE[1] * always
    ]
    below = sum(point["reference"] for point in inside)
    if not inside or below <= 0.0:
        return None
    rules, agents = (sum(point[key] for point in inside) / below for key in ("envelope", "mse"))
    return rules - 1.0, agents - 1.0


def reference_of(results: SettingResults, front: Mapping[str, Any]) -> str:
    """What a class is referred to, in words."""
    if front["mode"] == "centre":
        return "the best periodic schedules"
    return "the optimum" if results.optimal else "a lookahead with the model"


def _beside(results: SettingResults, name: str) -> str:
    rules, agents = gap(results, name) or (0.0, 0.0)
    front = results.classes[name]
    what = reference_of(results, front)
    text = (
        f"relative to {what}, the strongest rules of the {policy_label(front)} have {rules:+.1%} "
        f"error and its agents {agents:+.1%} (summed over the prices in the middle; no interval)"
    )
    if what == "the optimum":
        if rules < -EQUAL:
            text += ". Below it lies only what chance and mixtures of its prices allow"
        elif rules <= EQUAL:
            text += ". So a rule is as good as the optimum, to within 1 %: that is a result"
        return text
    return f"{text}; that reference is neither an optimum of this class nor a bound"


def caption(results: SettingResults, drawn: Sequence[str]) -> str:
    """What the figure of a setting shows, and what to see in it; ``drawn`` are its small panels."""
    seeds = [len(columns) for columns in results.seeds.values() if len(columns) > 1]
    band = "" if not seeds else f", with a band from the least to the greatest of {ranged(seeds)}"
    parts = [
        "*Above:* error against rate of the scheduler, both axes logarithmic. Blue: the lower "
        "envelope of the tuned rules; orange: agents at their prices"
        + (f"{band} training seeds" if band else "")
        + "; light without memory, dark with it; grey: each tuned rule by itself, on tuning seeds, "
        "down to the envelope."
    ]
    if results.rollout:
        parts.append(
            f"Diamonds: a rule improved once by simulation, on {results.rollout_episodes} episodes "
            "alone, so that chance moves them by 5 to 15 %."
        )
    if results.bound:
        parts.append("Green: no policy lies below, which is proven.")
    elif "genie" in results.baselines:
        genie = results.baselines["genie"]["mse"]["mean"]
        parts.append(f"If everything arrives the error is {genie:.3g}.")
    if drawn:
        parts.append(f"*Below*, on the same axes: {'; '.join(drawn)}.")
    parts.append(
        "*Strips:* the agents' error relative to the rules that know as much (the line at 0), with "
        f"95 % intervals. {_see(results)}"
    )
    return " ".join(parts)


def _see(results: SettingResults) -> str:
    """What there is to see."""
    worth = (worth_of(results, "memory") or {}).get("rules")
    if worth and worth["high"] < 0.0:
        together = worth_of(results, "deciding together") or {}
        text = f"See how far the dark lines lie below the light ones: {_percent(-worth['mean'])}"
        if "rules" in together and together["rules"]["high"] < 0.0:
            text += ", and how much higher sensors by themselves lie than the scheduler"
        return f"{text}."
    if results.optimal:
        return "See how close rules and agents lie to the optimum."
    return "See how close the lines of agents and rules lie together, panel by panel."
