"""Tables and figures of the benchmark's results, as Markdown and as one self-contained page.

    python -m agents.report [--results results]

Reads the JSON in the results folder and writes ``README.md``, a figure for each setting, and
``report.html`` with the figures inside. What the JSON says is text there, never markup.
"""

from __future__ import annotations

import base64
import html
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

import markdown

from fusion_gym.validation import ConfigurationError

from .command_line import Command, spelled, start
from .input.options import OutputFolder
from .output import figures
from .output.files import write_text
from .suite.committed import FOLDER
from .suite.reports import read_setting
from .suite.verdict import RATES

# What is said of verdicts that were made before there were committed envelopes.
OLDER = (
    "Rows without a number of prices are older: their envelope was chosen on the test seeds, of "
    "rules that may remember what a sensor did not send and that were tuned less well, and their "
    "mean is the interquartile mean over seeds and prices together, which leaves prices out. "
)
LEAST_ROOM = 0.05  # below that the share of it that an agent closes says nothing
MODES = {
    "sensors": "a coordinator that sees all sensors' new signals",
    "centre": "what the centre knows before anything is sent",
    "local": "one shared policy that every sensor runs by itself",
}


@dataclass(frozen=True)
class Report(Command):
    """Tables and figures of the benchmark's results, as Markdown and as one HTML page."""

    results: Annotated[Path, OutputFolder()] = Path("results")
    """Folder of the benchmark's JSON, and for what is made of it."""

    def run(self) -> None:
        """Draw the figures, write README.md and report.html."""
        found = read(self.results)
        quick = " --quick" if self.results.name == "quick" else ""
        text = text_of(found, f"{spelled('benchmark')}{quick}", spelled("report"))
        for name, parts in found.items():
            draw(self.results, name, parts)
        page, readme = self.results / "report.html", self.results / "README.md"
        write_text(readme, text)
        write_text(page, page_of(text, self.results))
        print(f"wrote {readme} and {page}")


def read(results: Path) -> dict[str, dict[str, Any]]:
    """Verdict, baselines and informed references of every setting that is judged, by name.

    Raises:
        ConfigurationError: there are none, or a file that is no such JSON.
    """
    found = {
        path.parent.name: read_setting(path.parent)
        for path in sorted(results.glob("*/verdict.json"))
    }
    if not found:
        raise ConfigurationError(
            f"results = {str(results)!r} is not allowed: it must hold results of the benchmark"
        )
    return found


def plain(text: str) -> str:
    """Free text in one line, no part of which Markdown or HTML takes for a mark."""
    escaped = html.escape(" ".join(text.split()), quote=False)
    return re.sub(r"[\\`*\[\]|]|(?<!\w)_|_(?!\w)", lambda mark: f"\\{mark[0]}", escaped)


def code(text: str) -> str:
    """Text as a span of code, also in a table."""
    line = " ".join(text.split()).replace("|", "\\|")
    fence = "`" * (1 + max(map(len, re.findall("`+", line)), default=0))
    return f"{fence}{line}{fence}" if len(fence) == 1 else f"{fence} {line} {fence}"


def share(interval: dict[str, float] | None) -> str:
    """A relative difference with its interval, in per cent."""
    if interval is None:
        return "–"
    return f"{interval['mean']:+.1%} [{interval['low']:+.1%}, {interval['high']:+.1%}]"


def summary_table(found: dict[str, dict[str, Any]]) -> list[str]:
    """One row a setting and mode: the middle of the front against the tuned baselines."""
    lines = [
        "| setting | agent | trainings | MSE against the envelope, middle of the front | "
        "prices there | rates of the grid | prices above the envelope | room to the reference | "
        "share of it closed | in hindsight |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, parts in found.items():
        for mode, front in parts["verdict"]["modes"].items():
            room = f"{front['room']:.1%}" if "room" in front else "–"
            worth = front.get("room", 0.0) >= LEAST_ROOM
            closed = f"{front['closed']:.0%}" if worth else "–"
            ahead = f"{-front['hindsight_room']:+.1%}" if "hindsight_room" in front else "–"
            worse, asked = above(front)
            lines.append(
                f"| [{plain(name)}](#{quote(name.replace('_', '-'))}) | {plain(mode)} | "
                f"{front['seeds']:d} | "
                f"{share(front.get('middle'))} | {reached(front)} | "
                f"{worse} of {asked} | {room} | {closed} | "
                f"{ahead} |"
            )
    return lines


def reached(front: dict[str, Any]) -> str:
    """How many prices lie in the middle and how many rates of the grid count, in two cells."""
    if "rates" not in front:
        return "– | –"
    return f"{front['prices']} of {len(front['points'])} | {len(front['rates'])} of {RATES}"


def above(front: dict[str, Any]) -> tuple[int, int]:
    """At how many prices an agent's whole interval lies above the envelope, and of how many."""
    compared = [point["difference"] for point in front["points"] if "difference" in point]
    return sum(difference["low"] > 0.0 for difference in compared), len(compared)


def headline_table(found: dict[str, dict[str, Any]]) -> list[str]:
    """One row a setting, one column a mode: the front page's table."""
    lines = [
        "| setting | " + " | ".join(MODES) + " | reference for `sensors` |",
        "|---|" + "---|" * (len(MODES) + 1),
    ]
    for parts in found.values():
        fronts = parts["verdict"]["modes"]
        cells = [share(fronts.get(mode, {}).get("middle")) for mode in MODES]
        room = fronts.get("sensors", {}).get("room")
        cells.append("–" if room is None else f"{-room:+.1%}")
        title = plain(parts["verdict"]["title"].split(",")[0])
        lines.append(f"| {title} | {' | '.join(cells)} |")
    return lines


def headline_count(found: dict[str, dict[str, Any]]) -> str:
    """How many points of all fronts lie above the envelope: the front page's sentence on it."""
    counts = [above(f) for parts in found.values() for f in parts["verdict"]["modes"].values()]
    worse, asked = (sum(column) for column in zip(*counts, strict=True))
    return f"{worse} of the {asked} points of all fronts lie above the envelope"


def setting_section(name: str, parts: dict[str, Any]) -> list[str]:
    """A setting's figure and the points of its fronts."""
    verdict, baselines = parts["verdict"], parts["baselines"]
    title = f"{plain(verdict['title'])} ({code(baselines['env'])})."
    lines = [f"## {plain(name.replace('_', '-'))}", "", title, ""]
    lines += [f"![Pareto front of {plain(name)}]({quote(name)}/pareto.png)", ""]
    if "genie" in baselines:
        genie = baselines["genie"]
        lines += [
            f"Genie: MSE {genie['mse']['mean']:.4g}; {plain(genie['assumes'])}.",
            "",
        ]
    lines += [
        "| agent | price | rate | MSE | tuned baselines there | difference | reference there | "
        "in hindsight |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for mode, front in verdict["modes"].items():
        for point in front["points"]:
            envelope = f"{point['envelope']:.4g}" if "envelope" in point else "–"
            reference = f"{point['reference']:.4g}" if "reference" in point else "–"
            ahead = f"{point['hindsight']:.4g}" if "hindsight" in point else "–"
            lines.append(
                f"| {plain(mode)} | {point['price']:.3g} | {point['rate']:.4f} | "
                f"{point['mse']:.4g} | {envelope} | {share(point.get('difference'))} | "
                f"{reference} | {ahead} |"
            )
    best = {
        policy
        for front in verdict["modes"].values()
        for policy in (point["name"] for point in front["envelope"])
    }
    lines += ["", "On the baselines' envelopes (tuned, test seeds):", ""]
    lines += ["| policy | rate | MSE |", "|---|---|---|"]
    rows = sorted(
        (_rate(baselines["policies"][policy]), policy, baselines["policies"][policy]["mse"])
        for policy in best
    )
    lines += [
        f"| {code(policy)} | {rate:.4f} | {mse['mean']:.4g} [{mse['low']:.4g}, {mse['high']:.4g}] |"
        for rate, policy, mse in rows
    ]
    return [*lines, ""]


def _rate(policy: dict[str, Any]) -> float:
    return float(sum(policy["rate"]) / len(policy["rate"]))


def draw(results: Path, name: str, parts: dict[str, Any]) -> None:
    """The setting's Pareto figure, into its folder."""
    policies = parts["baselines"]["policies"]
    curves = {
        label: [
            (_rate(policies[policy]), policies[policy]["mse"]["mean"])
            for policy in curve["policies"]
        ]
        for label, curve in parts["baselines"]["curves"].items()
    }
    ahead = sorted((_rate(policy), policy["mse"]["mean"]) for policy in parts["informed"].values())
    fronts = {
        mode: [(point["rate"], point["mse"]) for point in front["points"]]
        for mode, front in parts["verdict"]["modes"].items()
    }
    figures.fronts(
        results / name / "pareto.png",
        parts["verdict"]["title"],
        curves,
        ahead,
        fronts,
        parts["baselines"].get("genie"),
    )


def text_of(
    found: dict[str, dict[str, Any]], command: str, second: str = "python -m agents.report"
) -> str:
    """The report in Markdown, made by these two commands."""
    first = next(iter(found.values()))["baselines"]
    fronts = [front for parts in found.values() for front in parts["verdict"]["modes"].values()]
    lines = [
        "# Results of the benchmark",
        "",
        f"Made by `{command}` and `{second}` from the JSON beside this file. "
        f"{first['episodes']:,} test episodes a policy, seeds {first['seed']} to "
        f"{first['seed'] + first['episodes'] - 1:,}, the same noise for all.",
        "",
        "An agent is one policy that sees the price of a token, asked at several prices, and is "
        "compared at its own rate with the envelope of its class: the lower convex hull, mixtures "
        "included, of the tuned rules that know no more than it does, chosen on tuning seeds and "
        "measured on the test seeds, committed with a hash before any agent was trained "
        f"(`{FOLDER}/`):",
        "",
        *(f"- **{mode}**: {meaning}." for mode, meaning in MODES.items()),
        "",
        "Differences are relative, of the mean squared error: interquartile means over training "
        f"seeds at each price, and then the plain mean over a grid of {RATES} rates, evenly spaced "
        "in the logarithm from 5 % to 50 % of what always transmitting gets and as far as the "
        "front reaches, between prices interpolated in the logarithm of the rate. The 95 % "
        "intervals resample training seeds, paired episodes, rates and tuning seeds at once. A "
        "price counts as above the envelope where the whole interval does. "
        + OLDER
        * any("rates" not in front for front in fronts)
        + "The reference of a coordinator is a lookahead that knows the model and all sensors' new "
        "signals, neither an optimum nor a bound, and in remote estimation the optimum itself; "
        "that of the centre is the best of all periodic schedules, where covariances do not depend "
        "on data. "
        "Where the room to the reference is below 5 %, the share of it that is closed is left out. "
        "In hindsight: what a clairvoyant that knows all noise reaches at the same rate, by beam "
        "search on the first episodes; no policy can use that knowledge, and the search is not "
        "exact, so it is neither a goal nor a bound. The genie states what it assumes.",
        "",
        *summary_table(found),
        "",
    ]
    for name, parts in found.items():
        lines += setting_section(name, parts)
    return "\n".join(lines)


def page_of(text: str, results: Path) -> str:
    """The Markdown as one HTML page with its figures inside; HTML in it is shown, not obeyed."""
    renderer = markdown.Markdown(extensions=["tables", "toc"])
    renderer.preprocessors.deregister("html_block")
    renderer.inlinePatterns.deregister("html")
    body = renderer.convert(text)
    for path in results.glob("*/pareto.png"):
        data = base64.b64encode(path.read_bytes()).decode()
        body = body.replace(
            f'src="{quote(path.parent.name)}/pareto.png"', f'src="data:image/png;base64,{data}"'
        )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        "<title>Results of the benchmark</title><style>"
        "body{font:16px/1.5 sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem;"
        "color:#30343b}img{max-width:100%}table{border-collapse:collapse;margin:1rem 0}"
        "td,th{border:1px solid #ccd;padding:.2rem .6rem;text-align:right}"
        "td:first-child,th:first-child{text-align:left}code{background:#f3f4f6}"
        f"</style></head><body>\n{body}\n</body></html>\n"
    )


def main() -> None:
    """Entry point; exit status 130 after an interrupt."""
    start(Report)


if __name__ == "__main__":
    main()
