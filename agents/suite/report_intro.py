"""How to read the report: what was compared, who knew what, on which seeds, and what is proven."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..output.markup import ranged
from .committed import FOLDER
from .found import Found
from .verdict import RATES

TEXT = """\
## How to read this

**Compared** are tuned rules and learned agents: who has the smaller mean squared error at the same
rate of transmissions per sensor and step. An agent is one policy that sees the price of a token and
is asked at several. The rules of a class are its *envelope*: the line, mixtures of two included,
through those chosen on tuning seeds among all that know no more than the class, committed with a
hash (`{folder}/`) before any agent was trained. Then all ran on the test seeds.

**Who knew what.** A class says who decides, what a sensor hears, and whether there is memory:

- `centre` decides by what it knows before anything is sent, and sees no new measurement.
- `local_none`, `local_estimate`, `local_packets`: each sensor by itself, by one shared policy; it
  hears nothing, the centre's estimate, or every packet that is delivered.
- `sensors`: a coordinator that sees all new measurements and decides for all sensors.
- `…_memory`: what was measured and not sent is remembered besides.
- **A packet** holds one sensor's newest measurement (in Markov jump tracking the node's estimate),
  in `sensors_estimates_memory` the coordinator's estimate.

**Seeds.** {seeds}

**Intervals** are 95 % bootstrap intervals: of errors over episodes, of agents against rules over
training seeds, paired episodes, rates and tuning seeds at once. The *middle* is the mean over
{rates} rates, evenly spaced in the logarithm from 5 % to 50 % of that of always transmitting, as
far as agents reach, of the interquartile mean over training seeds; a worth is a mean over such
rates.

**Proven** are the bounds (`bounds/`: no policy lies below, whatever its packets hold) and, in
remote estimation, the optimum by dynamic programming. All else was measured: a lookahead with the
model, the best schedules of a period and rules improved by simulation are policies and no floors,
and *in hindsight* is what a clairvoyant reaches by beam search on a few episodes, which no policy
can.
"""


def how_to_read(found: Mapping[str, Found]) -> list[str]:
    """The report's first section."""
    first = next(iter(found.values())).baselines
    last = first["seed"] + first["episodes"] - 1
    agents = [front["seeds"] for one in found.values() for front in one.classes.values()]
    tuned = [one.envelopes["inputs"]["tuning"] for one in found.values() if one.envelopes]
    validated = [one.validation for one in found.values() if one.validation]
    seeds = [f"Test: {first['seed']:,} to {last:,}, the same noise for all."]
    if tuned:
        seeds.append(
            f"Tuning: {_of(tuned, 'seeds')} searches of {_of(tuned, 'episodes')} episodes each, "
            f"from {_of(tuned, 'seed')} on."
        )
    if validated:
        seeds.append(
            f"Validation, which chooses the moment of a training that is kept: "
            f"{_of(validated, 'episodes')} episodes from {_of(validated, 'seed')} on."
        )
    number = f"{ranged(agents)} training seeds" if agents else "none so far"
    seeds.append(f"Agents of a class: {number}.")
    text = TEXT.format(folder=FOLDER, seeds=" ".join(seeds), rates=RATES)
    return text.split("\n")


def _of(every: Sequence[Mapping[str, Any]], key: str) -> str:
    return ranged([one[key] for one in every])
