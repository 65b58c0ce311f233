"""How to read the report: what was compared, who knew what, on which seeds, and what is proven."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from .committed import FOLDER
from .found import Found
from .verdict import RATES


def how_to_read(found: Mapping[str, Found]) -> list[str]:
    """The report's first section."""
    first = next(iter(found.values())).baselines
    last = first["seed"] + first["episodes"] - 1
    seeds = [front["seeds"] for one in found.values() for front in one.classes.values()]
    tunings = [one.envelopes["inputs"]["tuning"] for one in found.values() if one.envelopes]
    trained = f"{ranged(seeds)} training seeds" if seeds else "no agents so far"
    return [
        "## How to read this",
        "",
        "**Compared** are, in each setting, tuned rules and learned agents: who has the smaller mean "
        "squared error at the same rate of transmissions per sensor and step. An agent is one policy "
        "that sees the price of a token and is asked at several prices. The rules of a class are its "
        "*envelope*: the line through those chosen among all tuned rules that know no more than the "
        "class, with mixtures of two. It was chosen on tuning seeds and committed with a hash "
        f"(`{FOLDER}/`) before any agent was trained; then rules and agents were run on the test "
        "seeds.",
        "",
        "**Who knew what.** A class is who decides, what it hears and whether it remembers:",
        "",
        "- `centre`: whoever fuses, by what it knows before anything is sent; it sees no new signal.",
        "- `local_none`, `local_estimate`, `local_packets`: each sensor by itself, by one shared "
        "policy; it hears nothing, the centre's estimate, or every packet that is delivered.",
        "- `sensors`: a coordinator that sees all new measurements and decides for all sensors.",
        "- `…_memory`: besides, what was measured and not sent is remembered; without it, a decision "
        "looks at new measurements and at what the centre knows.",
        "- `sensors_estimates_memory`: **a packet** holds the coordinator's estimate. In all other "
        "classes it holds one sensor's newest measurement (in Markov jump the node's estimate).",
        "",
        f"**Seeds.** Test: {first['episodes']:,} episodes a policy, seeds {first['seed']:,} to "
        f"{last:,}, the same noise for all. {_tuning(tunings)}{_validation(found)}Agents: {trained}.",
        "",
        "**Intervals** are 95 % bootstrap intervals. That of an error resamples episodes. That of a "
        "difference between agents and rules resamples training seeds, paired episodes, rates and "
        "tuning seeds at once; its mean is the interquartile mean over training seeds at each price, "
        f"and then the plain mean over a grid of {RATES} rates, evenly spaced in the logarithm from "
        "5 % to 50 % of the rate of always transmitting, as far as the agents reach (the *middle* of "
        "the front). What more knowledge is worth is such a mean over the rates that both classes "
        "reach, at least half of the grid. No interval knows of another training method or other "
        "rules.",
        "",
        "**Proven** are the bounds (no policy lies below, whatever it remembers; `bounds/`), and the "
        "optimum of two sources seen exactly, by dynamic programming. **Not proven**: a lookahead "
        "with the model, the best periodic schedules (the best of all schedules of their period, where "
        "covariances do not depend on data), and rules improved by simulation are policies, no floors; "
        "*in hindsight* is what a clairvoyant that knows all noise reaches by beam search on a few "
        "episodes, no goal for any policy. The genie states what it assumes.",
        "",
    ]  # fmt: skip


def _tuning(tunings: Sequence[Mapping[str, Any]]) -> str:
    """The seeds on which rules were tuned."""
    if not tunings:
        return ""
    starts = ranged([one["seed"] for one in tunings])
    return (
        f"Tuning of rules: {ranged([one['seeds'] for one in tunings])} searches a setting, each on "
        f"{ranged([one['episodes'] for one in tunings])} episodes of its own from seed {starts} on. "
    )


def _validation(found: Mapping[str, Found]) -> str:
    """The seeds on which the best moment of a training was chosen."""
    chosen = [one.validation for one in found.values() if one.validation]
    if not chosen:
        return ""
    return (
        f"Validation, which chooses the moment of a training that is kept: "
        f"{ranged([one['episodes'] for one in chosen])} episodes from seed "
        f"{ranged([one['seed'] for one in chosen])} on. "
    )


def ranged(values: Sequence[int]) -> str:
    """One number, or the least and the greatest."""
    low, high = min(values), max(values)
    return f"{low:,}" if low == high else f"{low:,} to {high:,}"
