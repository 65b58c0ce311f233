"""What was found, in sentences that follow from the numbers by fixed rules."""

from collections.abc import Mapping, Sequence
from typing import Any

from ..output.markup import ranged, share
from .envelope_table import HEADLINE, at_least
from .found import Found
from .overview import above_of, reason, worth_of
from .verdict import MIDDLE

EQUAL = 0.01  # what lies no further above the optimum is as good
NAMES = {"centre": "centre", "local": "sensors alone", "sensors": "coordinator"}
HEARING = {"none": "hearing nothing", "estimate": "hearing estimates", "packets": "hearing packets"}


def named(content: Mapping[str, Any]) -> str:
    """A class in words."""
    held = "sending the estimate" if content["packet"] == "estimate" else ""
    remembers = "with memory" if content["memory"] else ""
    heard = HEARING.get(content["broadcast"] or "", "")
    return " ".join(part for part in (NAMES[content["mode"]], heard, held, remembers) if part)


def percent(value: float) -> str:
    """A share, with a digit behind the point where it is small."""
    return f"{100.0 * value:.1f} %" if abs(value) < 0.0995 else f"{100.0 * value:.0f} %"


def change(interval: Mapping[str, float], than: str) -> str:
    """How an error compares with another one, as far as its interval tells."""
    mean, low, high = (interval[end] for end in ("mean", "low", "high"))
    if high < 0.0:
        return f"is {percent(-mean)} lower than {than} (95 %: {percent(-high)} to {percent(-low)})"
    if low > 0.0:
        return f"is {percent(mean)} higher than {than} (95 %: {percent(low)} to {percent(high)})"
    return f"cannot be told from {than} ({share(interval)})"


def sentences(found: Found) -> list[str]:
    """On knowledge, on learning, and on what is proven."""
    return [knowledge(found), learning(found), floors(found)]


def knowledge(found: Found) -> str:
    """What memory does."""
    worth = worth_of(found, "memory") or {}
    said = [
        f"with memory the error of a coordinator's {who} {change(worth[who], 'without')}"
        for who in ("rules", "agents")
        if who in worth
    ]
    if not said:
        return f"**Memory** is not compared here: {reason(found, 'memory')}."
    return f"**Memory**: {'; '.join(said)}."


def learning(found: Found) -> str:
    """Where agents lie beside the strongest rules of their class."""
    sides: dict[str, list[str]] = {"below": [], "above": [], "apart": []}
    for content in found.classes.values():
        if "middle" in content:
            middle = content["middle"]
            side = "below" if middle["high"] < 0.0 else "above" if middle["low"] > 0.0 else "apart"
            sides[side].append(f"{named(content)} {share(middle)}")
    heads = {
        "below": "agents lie below the strongest rules of their class",
        "above": "agents lie above the strongest rules of their class",
        "apart": "agents cannot be told from the strongest rules of their class",
    }
    parts = [f"{heads[side]}: {', '.join(who)}" for side, who in sides.items() if who]
    if not parts:
        return "**Learning**: no agent has a price in the middle of the front so far."
    counts = [above_of(content) for content in found.classes.values()]
    worse, asked = sum(len(points) for points, _ in counts), sum(count for _, count in counts)
    return (
        f"**Learning**: {'; '.join(parts)}. At {worse} of {asked} points the whole interval lies "
        "more than 1 % above."
    )


def floors(found: Found) -> str:
    """The optimum where it is known, else the proven bound, else what the reference is."""
    parts = [_beside(found, name) for name in _referred(found)]
    bound = found.bound
    if bound is not None:
        rate = HEADLINE * found.verdict["always"]
        least = at_least(bound, rate)
        text = f"at the rate {rate:.3g} no policy has an error below {least:.3g}"
        best = found.rules_at("sensors_memory", rate) or found.rules_at("sensors", rate)
        if best is not None:
            text += (
                f"; a coordinator's strongest rules have {best:.3g}, {best / least:.1f} times it"
            )
        parts.append(f"{text}. This is proven, but no policy is known that reaches it")
    if not parts:
        return "**Floor**: no bound, optimum or reference is known at these rates."
    return f"**Floor**: {'. '.join(part[0].upper() + part[1:] for part in parts)}."


def _referred(found: Found) -> list[str]:
    """The classes with a reference of which something is said."""
    coordinator = "sensors" if "sensors" in found.classes else "sensors_memory"
    wanted = [coordinator, "centre"]
    return [name for name in wanted if name in found.classes and gap(found, name)]


def gap(found: Found, name: str) -> tuple[float, float] | None:
    """How far rules and agents lie above a class's reference, over the prices in the middle."""
    front, always = found.classes[name], found.verdict["always"]
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


def reference_of(found: Found, front: Mapping[str, Any]) -> str:
    """What a class is referred to, in words."""
    if front["mode"] == "centre":
        return "the best periodic schedules"
    return "the optimum" if found.optimal else "a lookahead with the model"


def _beside(found: Found, name: str) -> str:
    rules, agents = gap(found, name) or (0.0, 0.0)
    front = found.classes[name]
    what = reference_of(found, front)
    text = (
        f"relative to {what}, the strongest rules of the {named(front)} have {rules:+.1%} error "
        f"and its agents {agents:+.1%} (summed over the prices in the middle; no interval)"
    )
    if what == "the optimum":
        if rules < -EQUAL:
            text += ". Below it lies only what chance and mixtures of its prices allow"
        elif rules <= EQUAL:
            text += ". So a rule is as good as the optimum, to within 1 %: that is a result"
        return text
    return f"{text}; that reference is neither an optimum of this class nor a bound"


def caption(found: Found, drawn: Sequence[str]) -> str:
    """What the figure of a setting shows, and what to see in it; ``drawn`` are its small panels."""
    seeds = [len(columns) for columns in found.seeds.values() if len(columns) > 1]
    band = "" if not seeds else f", with a band from the least to the greatest of {ranged(seeds)}"
    parts = [
        "*Above:* error against rate of the coordinator, both axes logarithmic. Blue: the lower "
        "envelope of the tuned rules; orange: agents at their prices"
        + (f"{band} training seeds" if band else "")
        + "; light without memory, dark with it; grey: each tuned rule by itself, on tuning seeds, "
        "down to the envelope."
    ]
    if found.rollout:
        parts.append(
            f"Diamonds: a rule improved once by simulation, on {found.rollout_episodes} episodes "
            "alone, so that chance moves them by 5 to 15 %."
        )
    if found.bound:
        parts.append("Green: no policy lies below, which is proven.")
    elif "genie" in found.baselines:
        genie = found.baselines["genie"]["mse"]["mean"]
        parts.append(f"If everything arrives the error is {genie:.3g}.")
    if drawn:
        parts.append(f"*Below*, on the same axes: {'; '.join(drawn)}.")
    parts.append(
        "*Strips:* the agents' error relative to the rules that know as much (the line at 0), with "
        f"95 % intervals. {_see(found)}"
    )
    return " ".join(parts)


def _see(found: Found) -> str:
    """What there is to see."""
    worth = (worth_of(found, "memory") or {}).get("rules")
    if worth and worth["high"] < 0.0:
        together = worth_of(found, "deciding together") or {}
        text = f"See how far the dark lines lie below the light ones: {percent(-worth['mean'])}"
        if "rules" in together and together["rules"]["high"] < 0.0:
            text += ", and how much higher sensors by themselves lie than the coordinator"
        return f"{text}."
    if found.optimal:
        return "See how close rules and agents lie to the optimum."
    return "See how close the lines of agents and rules lie together, panel by panel."
