"""The parts of pages that say who wins: made of results, and only where a page asks for them."""

from pathlib import Path
from typing import Any

from command_runs import call
from small_results import small_results

from agents.benchmark.report import read_results, robustness_text, update_pages
from agents.benchmark.tables import read_rows, write_rows
from agents.benchmark.verdict import read_cases, write_cases

PAGE = """# A page

<!-- results: {name} -->
what was said before
<!-- end -->

The rest stays. <!-- end -->
"""


def test_the_command_writes_pages(tmp_path: Path) -> None:
    results, page = tmp_path / "results", tmp_path / "page.md"
    small_results(results)
    page.write_text(PAGE.format(name="headline"))
    words = ["--parts", "report", "--results", str(results), "--pages", str(page)]
    assert call("benchmark", words).status == 0
    settings = read_results(results)
    assert page.read_text() == update_pages(PAGE.format(name="headline"), settings, results, {})
    page.write_text(PAGE.format(name="nobody"))
    assert "results = 'nobody'" in call("benchmark", words).err
    assert "pages" in call("benchmark", [*words[:-1], str(tmp_path / "absent.md")]).err


def test_perturbed_cases_are_counted(tmp_path: Path) -> None:
    def row(title: str, low: float, high: float) -> dict[str, Any]:
        middle = {"mean": (low + high) / 2, "low": low, "high": high}
        return {"title": title, "always": 0.5, "agents": {"middle": middle, "points": []}}

    cases = {
        "as_assumed": row("as assumed", -0.3, -0.1),
        "loud": row("loud", -0.2, -0.1),
        "louder": row("louder", 0.01, 0.03),
        "still": row("still", -0.1, 0.1),
        "none": {"title": "none", "always": 0.5, "agents": {"points": []}},
    }
    report = {"class": "sensors", "cases": cases, "episodes": 2, "sha256": "0"}
    write_cases(tmp_path / "tobit_oscillator", report)
    setting = read_rows(Path(__file__).parents[1] / "results" / "tobit_oscillator", "setting")
    write_rows(tmp_path / "tobit_oscillator", "setting", setting)
    titles = {"tobit_oscillator": "Tobit oscillator, with an option"}
    text = update_pages(PAGE.format(name="robustness"), {}, tmp_path, titles)
    expected = "| Tobit oscillator | as they are | -20.0% [-30.0%, -10.0%] | 1 | 1 | 1 | "
    assert f"{expected}+2.0% [+1.0%, +3.0%], louder |" in text
    assert "trained over draws" not in text
    assert robustness_text(read_cases(tmp_path, [*titles]), titles).count("version v0") == 1
    nothing = update_pages(PAGE.format(name="robustness"), {}, tmp_path / "absent", titles)
    assert "- Nothing has been tried so far." in nothing
