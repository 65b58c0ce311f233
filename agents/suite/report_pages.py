"""The parts of README and docs that say who wins: made of the results, between two marks."""

import re
from collections.abc import Mapping
from pathlib import Path

from fusion_gym.validation import choice

from .config import load_suite
from .overview import headline_count, overview_table
from .report_words import sentences
from .robust_summary import read_reports, robustness_summary
from .setting_results import SettingResults

HEADLINE, ROBUSTNESS = "headline", "robustness"
_MARKED = re.compile(r"(<!-- results: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def update_pages(text: str, settings: Mapping[str, SettingResults], results: Path) -> str:
    """The text with all its marked parts made anew.

    ``<!-- results: SETTING -->`` to ``<!-- end -->`` holds what was found in a setting, with
    ``headline`` in its place the table of all settings and how many points lie above envelopes,
    and with ``robustness`` what the folder ``results`` has of perturbed cases.

    Raises:
        ConfigurationError: a setting that neither the results nor the benchmark has.
    """

    def part(match: re.Match[str]) -> str:
        return match[1] + "\n".join(["", *lines_of(match[2], settings, results), ""]) + match[3]

    return _MARKED.sub(part, text)


def lines_of(name: str, settings: Mapping[str, SettingResults], results: Path) -> list[str]:
    """The lines of a marked part.

    Raises:
        ConfigurationError: as :func:`update_pages`.
    """
    titles = {setting.name: setting.title for setting in load_suite("benchmark").settings}
    choice("results", name, dict.fromkeys([HEADLINE, ROBUSTNESS, *settings, *titles]))
    if name == ROBUSTNESS:
        tried = read_reports(results, list(titles))
        return (
            robustness_summary(tried, titles) if tried else ["- Nothing has been tried so far.", ""]
        )
    if name not in (HEADLINE, *settings):
        return ["- No agents have been trained here so far.", ""]
    if name != HEADLINE:
        return [*(f"- {sentence}" for sentence in sentences(settings[name])), ""]
    seeds = [front["seeds"] for setting in settings.values() for front in setting.classes.values()]
    trained = f"{min(seeds)} to {max(seeds)}" if min(seeds) < max(seeds) else f"{seeds[0]}"
    count = headline_count(settings)
    text = f"{count[0].upper()}{count[1:]}; training seeds of a class: {trained}."
    return [*overview_table(settings), "", text, ""]
