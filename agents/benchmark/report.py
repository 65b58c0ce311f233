"""The pages of the results: data frames made of the tables, rendered by the templates.

A new column of a page is a new entry in the rows of one of these frames.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from agents.benchmark.config import NOMINAL
from agents.benchmark.envelopes import (
    at_least,
    bound_of,
    hull_of,
    path_of,
    read_envelopes,
    rollout_of,
)
from agents.benchmark.markup import NONE, code, markup_number, plain_text, ranged, share
from agents.benchmark.tables import VERDICT, Row, group_by, read_rows
from agents.benchmark.verdict import MIDDLE, RATES, SHARES, is_gain, read_cases
from fusion_gym.envs.registration import ENVIRONMENTS
from fusion_gym.evaluation.envelope import EnvelopePoint, height
from fusion_gym.validation import ConfigurationError, choice

ABOVE = 0.01  # a point lies above the envelope where its whole interval is further up than this
HEADLINE = 0.2  # of the rate that always transmitting gets: where single errors are named
LEAST_ROOM = 0.05  # below that the share of it that an agent closes says nothing
ESTIMATE = "packets that hold the estimate"
KNOWING = {
    "memory": "memory, of a scheduler",
    "hearing": "hearing, of sensors alone",
    "deciding together": "deciding together",
    ESTIMATE: "a packet with the estimate",
}
# Where a kind of knowledge is nothing of its own, and why.
_REASONS = {
    ("memory", "MarkovJumpTracking"): "nodes remember by themselves",
    ("memory", "RemoteEstimation"): "nothing to remember",
    (ESTIMATE, "MarkovJumpTracking"): "packets hold the node's estimate",
    (ESTIMATE, "UnknownInput"): "the centre begins anew from what was sent",
    (ESTIMATE, "RemoteEstimation"): "a packet is the value itself",
}
_MARKED = re.compile(r"(<!-- results: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def _percent(value: float) -> str:
    """Return a share, with a digit behind the point where it is small."""
    return f"{100.0 * value:.1f} %" if abs(value) < 0.0995 else f"{100.0 * value:.0f} %"


TEMPLATES = jinja2.Environment(
    loader=jinja2.FileSystemLoader(Path(__file__).with_name("templates")),
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
    undefined=jinja2.StrictUndefined,
)
TEMPLATES.filters |= {
    "share": share, "percent": _percent, "text": plain_text, "code": code, "ranged": ranged,
    "number": markup_number, "mean": lambda values: float(np.mean(values)),
}  # fmt: skip


TEMPLATES.globals["at_least"] = at_least


@dataclass(frozen=True)
class SettingResults:
    """A setting's tables as pages and figures need them; what is not there is empty.

    A property raises ConfigurationError where a table cannot be read or is of another shape.
    """

    folder: Path

    @cached_property
    def verdict(self) -> Row:
        """The setting itself."""
        rows = read_rows(self.folder, VERDICT)
        if len(rows) > 1 or rows[0]["always"] <= 0.0:
            path = str(self.folder / f"{VERDICT}.csv")
            raise ConfigurationError(
                f"results = {path!r}: always = {[row['always'] for row in rows]} is not allowed: "
                "it must be one positive rate"
            )
        return rows[0]

    @cached_property
    def classes(self) -> dict[str, Row]:
        """The classes with agents, each with its ``points``, errors ``at`` rates and envelope."""
        parts = {"points": "points", "at": "equal_rates", "envelope": "envelope"}
        tables = {part: group_by(read_rows(self.folder, t), "class") for part, t in parts.items()}
        fronts = {row.pop("class"): row for row in read_rows(self.folder, "fronts")}
        for part, table in parts.items():
            if differing := sorted(fronts.keys() ^ tables[part].keys()):
                path = str(self.folder / f"{table}.csv")
                raise ConfigurationError(
                    f"results = {path!r} is not allowed: it must have rows of the same classes as "
                    f"fronts.csv, and not differ in {differing[0]!r}"
                )
        return {
            name: {"broadcast": None} | row | {part: every[name] for part, every in tables.items()}
            for name, row in fronts.items()
        }

    @cached_property
    def worths(self) -> list[Row]:
        """What each class is worth beside one that knows less."""
        return read_rows(self.folder, "worth")

    @cached_property
    def envelopes(self) -> Row:
        """The committed envelopes."""
        committed = path_of(self.folder.parent, self.folder.name).exists()
        return read_envelopes(self.folder) if committed else {}

    @cached_property
    def policies(self) -> dict[str, list[Row]]:
        """The tested policies by run."""
        return group_by(read_rows(self.folder, "policies"), "run")

    @cached_property
    def runs(self) -> list[Row]:
        """The runs of agents."""
        return [row for row in read_rows(self.folder, "runs") if row.get("class") in self.classes]

    @cached_property
    def seeds(self) -> dict[str, list[list[tuple[float, float]]]]:
        """Rate and error at each price, by class and training seed."""
        result: dict[str, list[list[tuple[float, float]]]] = {}
        for run in self.runs:
            points = [(rate_of(p), p["mse"]["mean"]) for p in self.policies.get(run["run"], [])]
            if len(points) == len(self.classes[run["class"]]["points"]):
                result.setdefault(run["class"], []).append(points)
        return result

    @property
    def ahead(self) -> list[EnvelopePoint]:
        """The scheduler's references."""
        return _places(self.policies.get("informed", []))

    @cached_property
    def known(self) -> list[EnvelopePoint]:
        """The centre's references."""
        return _places(self.policies.get("references", []))

    @property
    def genie(self) -> Row | None:
        """The policy to which everything arrives."""
        return next(iter(self.policies.get("genie", [])), None)

    @cached_property
    def rollout(self) -> list[EnvelopePoint]:
        """A rule that was improved by simulation."""
        return rollout_of(self.folder)[0]

    @cached_property
    def bound(self) -> Row | None:
        """The proven lower bound."""
        return bound_of(self.folder)

    @property
    def label(self) -> str:
        """The setting's name for readers: its title up to the first comma."""
        return str(self.verdict["title"].split(",")[0])

    @property
    def always(self) -> float:
        """The rate of always transmitting."""
        return float(self.verdict["always"])

    @property
    def optimal(self) -> bool:
        """Whether the scheduler's reference is the optimum."""
        names = [point.name for point in self.ahead]
        return bool(names) and all(name.startswith("optimal:") for name in names)

    @property
    def broadcast(self) -> str:
        """What a sensor alone receives in the environment as it is."""
        inputs = self.envelopes.get("inputs", {})
        every = [front["broadcast"] for front in self.classes.values() if front["broadcast"]]
        return str(next(iter([*inputs.get("broadcasts", ()), *every]), "none"))

    @property
    def known_classes(self) -> dict[str, Row]:
        """The classes with agents, and committed ones where no class of the kind has any."""
        committed = self.envelopes.get("classes", {})
        there = {kind_of(front) for front in self.classes.values()}
        others = {name: of for name, of in committed.items() if kind_of(of) not in there}
        every = others | self.classes
        return {name: every[name] for name in dict.fromkeys([*committed, *every]) if name in every}

    def hull(self, name: str) -> list[EnvelopePoint]:
        """Return the envelope of a class on the test seeds; empty without one."""
        if name in self.classes:
            return [
                EnvelopePoint(p["name"], p["rate"], p["mse"])
                for p in self.classes[name]["envelope"]
            ]
        committed = self.envelopes.get("classes", {})
        return hull_of(committed[name]) if name in committed else []

    def rules_at(self, name: str, rate: float) -> float | None:
        """Return the error of a class's rules at a rate."""
        hull = self.hull(name)
        return height(hull, rate) if hull else None

    def worth(self, kind: str) -> Row:
        """Return the row that stands for a kind: with memory if there is, of the farthest apart."""
        rows = [row for row in self.worths if row["kind"] == kind]
        if kind == "memory":
            rows = [row for row in rows if row["knows"] == "sensors_memory"]
        if kind == "hearing":
            rows = [
                row
                for row in rows
                if row["knows"].startswith("local_packets")
                and row["less"].startswith(f"local_{self.broadcast}")
            ]
        return min(rows, key=lambda row: "memory" not in row["knows"], default={})

    @property
    def plant(self) -> str:
        """The environment's name without its version."""
        return str(self.verdict["env"]).partition("/")[2].rpartition("-v")[0]

    def reason(self, kind: str) -> str:
        """Return why there is nothing of a kind, in a word."""
        absent = f"fewer than half of {RATES} rates in common" if self.worth(kind) else ""
        return _REASONS.get((kind, self.plant), absent or "not compared")

    def middle(self, name: str) -> str:
        """Return a class's agents against its rules over the middle, or why there is nothing."""
        if name in self.classes:
            middle = self.classes[name].get("middle")
            return share(middle) if middle else "no price in the middle"
        return _REASONS.get(("memory", self.plant), "no agents")

    def sides(self) -> dict[str, list[Row]]:
        """Return the fronts whose middle lies below, above or on both sides of the rules."""
        sides: dict[str, list[Row]] = {"below": [], "above": [], "apart": []}
        for front in self.classes.values():
            if "middle" in front:
                low, high = front["middle"]["low"], front["middle"]["high"]
                sides["below" if high < 0.0 else "above" if low > 0.0 else "apart"].append(front)
        return {side: fronts for side, fronts in sides.items() if fronts}

    def gap(self, name: str) -> tuple[float, float] | None:
        """Return how far rules and agents lie above a class's reference, over the middle."""
        low, high = (end * self.always for end in MIDDLE)
        points = self.classes[name]["points"] if name in self.classes else []
        inside = [p for p in points if "reference" in p and low <= p["rate"] <= high]
        below = sum(point["reference"] for point in inside)
        if not inside or below <= 0.0:
            return None
        rules, agents = (sum(point[key] for point in inside) / below for key in ("envelope", "mse"))
        return rules - 1.0, agents - 1.0

    @property
    def referred(self) -> list[str]:
        """The classes with a reference of which something is said."""
        scheduler = "sensors" if "sensors" in self.classes else "sensors_memory"
        return [name for name in (scheduler, "centre") if self.gap(name)]

    def reference(self, front: Mapping[str, Any]) -> str:
        """Return what a class is referred to, in words."""
        if front["mode"] == "centre":
            return "the best periodic schedules"
        return "the optimum" if self.optimal else "a lookahead with the model"


def kind_of(content: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return who decides, what a sensor alone receives, and what a packet holds."""
    packet = content.get("packet") or content["options"].get("packet", "measurement")
    return content["mode"], content["broadcast"] or "", str(packet)


def read_results(results: Path) -> dict[str, SettingResults]:
    """Return every setting that is judged, by name.

    Raises:
        ConfigurationError: there are none.
    """
    found = sorted(results.glob(f"*/{VERDICT}.csv"))
    if not found:
        earlier = ", and not JSON of an earlier version" * any(results.glob(f"*/{VERDICT}.json"))
        raise ConfigurationError(
            f"results = {str(results)!r} is not allowed: it must hold tables of the "
            f"benchmark{earlier}"
        )
    return {path.parent.name: SettingResults(path.parent) for path in found}


def _places(policies: Sequence[Row]) -> list[EnvelopePoint]:
    result = [EnvelopePoint(p["name"], rate_of(p), p["mse"]["mean"]) for p in policies]
    return sorted(result, key=lambda point: (point.rate, point.mse))


def rate_of(policy: Row) -> float:
    """Return a tested policy's mean rate per sensor and step."""
    return float(sum(policy["rate"]) / len(policy["rate"]))


def cell(points: Sequence[EnvelopePoint], rate: float) -> str:
    """Return the error at a rate between the points, or a dash."""
    computed = bool(points) and points[0].rate > 0.0  # point by point: it ends with the last one
    if not points or (computed and rate > points[-1].rate):
        return NONE
    result = height(points, rate)
    return NONE if result is None else f"{result:.4g}"


def above_of(front: Row) -> tuple[list[Row], int]:
    """Return the points whose whole interval is above the envelope, and of how many."""
    compared = [point for point in front["points"] if "difference" in point]
    return [point for point in compared if point["difference"]["low"] > ABOVE], len(compared)


def count_above(settings: Sequence[SettingResults]) -> tuple[int, int]:
    """Return how many points of all classes lie above the envelope, and of how many."""
    pairs = [above_of(front) for item in settings for front in item.classes.values()]
    return sum(len(points) for points, _ in pairs), sum(count for _, count in pairs)


def hulls_of(envelopes: Row) -> dict[str, dict[bool, list[EnvelopePoint]]]:
    """Return each class's committed rules, by the class without memory in words, and memory."""
    result: dict[str, dict[bool, list[EnvelopePoint]]] = {}
    for content in envelopes["classes"].values():
        mode, broadcast, packet = kind_of(content)
        parts = [mode, broadcast, ESTIMATE if packet == "estimate" else ""]
        result.setdefault(", ".join(filter(None, parts)), {})[content["memory"]] = hull_of(content)
    return result


def text_of(settings: Sequence[SettingResults], panels: Mapping[str, Sequence[str]]) -> str:
    """Return the report in Markdown; ``panels`` has the small panels of each setting's figure."""
    fronts = [front for item in settings for front in item.classes.values()]
    return _render(
        "report.md",
        settings=settings,
        panels=panels,
        shares=SHARES,
        trained=[front["seeds"] for front in fronts],
        tuned=[item.envelopes["inputs"]["tuning"] for item in settings if item.envelopes],
        validated=[r["inputs"]["training"]["validation"] for s in settings for r in s.runs[:1]],
    )


def _render(template: str, **values: Any) -> str:
    """Return a template's text; it may call every function of this module."""
    text = TEMPLATES.get_template(template).render(globals() | values)
    return text.rstrip("\n") + "\n"


def note_of(envs: Iterable[str]) -> str:
    """Return which earlier versions of the environments were measured; empty where none was."""
    earlier = sorted({env.rpartition("-")[2] for env in envs if env not in ENVIRONMENTS})
    if not earlier:
        return ""
    return f"**Measured in version {', '.join(earlier)} of the environments**, an earlier one."


# Parts of other pages.


def update_pages(
    text: str, settings: Mapping[str, SettingResults], results: Path, titles: Mapping[str, str]
) -> str:
    """Return the text with all its marked parts made again.

    ``<!-- results: SETTING -->`` to ``<!-- end -->`` holds what was found in a setting, with
    ``headline`` in its place the table of all settings and how many points lie above envelopes,
    and with ``robustness`` what the folder ``results`` has of perturbed cases. ``titles`` are those
    of the benchmark's settings by name.

    Raises:
        ConfigurationError: a setting that neither the results nor the benchmark has.
    """

    def part(match: re.Match[str]) -> str:
        choice("results", match[2], dict.fromkeys(["headline", "robustness", *settings, *titles]))
        content = _render(
            "part.md",
            name=match[2],
            settings=list(settings.values()),
            trained=[f["seeds"] for item in settings.values() for f in item.classes.values()],
            results=settings.get(match[2]),
            reports=read_cases(results, list(titles)),
            titles=titles,
        )
        return f"{match[1]}\n{content}\n{match[3]}"

    return _MARKED.sub(part, text)


# Perturbed cases.


def robustness_rows(reports: Sequence[Row], titles: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return in how many cases agents are ahead of the rules; ``titles`` of settings by name."""
    rows = []
    for report in reports:
        cases = report["cases"]
        for kind, name in (("agents", "as they are"), ("trained", "trained over draws")):
            if kind not in cases[NOMINAL.name]:
                continue
            result = {
                row["title"]: row[kind]["middle"]
                for case, row in cases.items()
                if case != NOMINAL.name and "middle" in row.get(kind, {})
            }
            better = sum(is_gain(middle) for middle in result.values())
            worse = sum(middle["low"] > 0.0 for middle in result.values())
            worst = max(result, key=lambda title: float(result[title]["mean"]), default="")
            rows.append(
                {
                    "setting": plain_text(titles[report["setting"]].partition(",")[0]),
                    "agents": name,
                    "as assumed": share(cases[NOMINAL.name][kind].get("middle")),
                    "better": better,
                    "undecided": len(result) - better - worse,
                    "worse": worse,
                    "at worst": f"{share(result[worst])}, {plain_text(worst)}" if worst else NONE,
                }
            )
    return rows


def robustness_text(reports: Sequence[Row], titles: Mapping[str, str]) -> str:
    """Return the page of perturbed cases of the settings with these titles."""
    by_class = {name: [r for r in reports if r["class"] == name] for name in
                sorted({report["class"] for report in reports})}  # fmt: skip
    return _render("robustness.md", reports=reports, by_class=by_class, titles=titles)


# Committed envelopes.


def envelopes_text(results: Path) -> str:
    """Return the page of the committed rules.

    Raises:
        ConfigurationError: a table that cannot be read or is of another shape.
    """
    folders = [path.parent for path in sorted(results.glob("*/classes.csv"))]
    settings = {folder: read_envelopes(folder) for folder in folders}
    return _render("envelopes.md", settings=settings, shares=SHARES)


# The quick benchmark beside the full one.


def agreement_text(quick: Path, full: Path, settings: Sequence[str]) -> str:
    """Return each class of agents over the middle of its front, by both, and whether they agree.

    They agree where their 95 % intervals have a value in common. Empty where the folder ``full``
    has no verdict of any class that the folder ``quick`` has.

    Raises:
        ConfigurationError: a verdict that is damaged.
    """
    ours, theirs = (
        {
            (name, row["class"]): row["middle"]
            for name in settings
            if (folder / name / "fronts.csv").exists()
            for row in read_rows(folder / name, "fronts")
            if "middle" in row
        }
        for folder in (quick, full)
    )
    both = [(*names, own, theirs[names]) for names, own in ours.items() if names in theirs]
    return _render("agreement.md", both=both) if both else ""
