"""What the README and the pages show must run, and their tables must name what exists."""

import pydoc
import re
from pathlib import Path

import pytest
import yaml
from benchmark_rows import read_results
from markdown_it import MarkdownIt
from page_blocks import LANGUAGES
from paths import ROOT

import fusion_gym
from agents.benchmark.report import headline_text
from agents.benchmark.settings import load_suite
from docs.tables import PART, TABLES, written
from fusion_gym.envs.option_text import options_in, short
from fusion_gym.envs.registration import ENVIRONMENTS, options_of

README = (ROOT / "README.md").read_text()
DOCS = sorted((ROOT / "docs").glob("*.md"))
PAGES = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "results").rglob("*.md")]
SHOWN = "text", "softbreak"
TEXTS = README + "".join(path.read_text() for path in (*DOCS, ROOT / "CONTRIBUTING.md"))


@pytest.mark.parametrize("path", [ROOT / "README.md", *DOCS], ids=lambda path: path.stem)
def test_what_a_page_links_exists(path: Path) -> None:
    for name, part in re.findall(r"\]\(([\w/.]*)(?:#([\w-]+))?\)", path.read_text()):
        target = path.parent / name if name else path
        assert target.exists(), name
        if part:
            heads = re.findall(r"^#+ (.*)$", target.read_text(), re.MULTILINE)
            anchors = [re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads]
            assert part in anchors, f"{name}#{part}"


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_markdown_leaves_formulas_as_written(path: Path) -> None:
    """CommonMark eats backslashes before punctuation, and makes underscores italics."""
    text = path.read_text()
    blocks = MarkdownIt().enable("table").parse(text)
    plain = ("".join(p.content or " " for p in b.children or () if p.type in SHOWN) for b in blocks)
    shown = " ".join("\n".join(plain).split())
    bare = re.sub(r"^```.*?^```|`[^`\n]*`", "", text, flags=re.DOTALL | re.MULTILINE)
    formulas = re.findall(r"\$\$.+?\$\$|\$[^$\n]+?\$", bare, re.DOTALL)
    assert not [formula for formula in formulas if " ".join(formula.split()) not in shown]


QUESTIONS = {
    "the options of an environment": "docs/tobit_oscillator.md#options",
    "the options of every environment": "docs/options.md#tokens",
    "the entries of an observation": "docs/remote_estimation.md#observation",
    "the list of rules": "docs/rules.md#rules",
    "the list of filters": "docs/filters.md#filters",
    "the metrics": "docs/policies.md#metrics",
    "losses and delays": "docs/networks.md#delays",
    "whether SAC, TD3 or RecurrentPPO work": "docs/algorithms.md#which-algorithm-works",
    "VecNormalize": "docs/algorithms.md#vecnormalize",
    "a plant of one's own": "docs/your_system.md#",
    "a log of one's own": "docs/tutorials/your_log.md#",
    "what a learned policy saves": "results/README.md#against-the-best-rule",
    "a paper's figures": "docs/reproduction/README.md#",
}


@pytest.mark.parametrize("question", QUESTIONS)
def test_a_question_is_two_clicks_from_the_readme(question: str) -> None:
    """A click is a link to a page; on the page the question has a heading."""
    name, _, heading = QUESTIONS[question].partition("#")
    pages = {ROOT / "README.md"}
    for _ in range(2):
        links = ((page, re.findall(r"\]\(([\w/.]+\.md)", page.read_text())) for page in pages)
        pages = pages | {(page.parent / link).resolve() for page, every in links for link in every}
    assert ROOT / name in pages
    heads = re.findall(r"^#+ (.*)$", (ROOT / name).read_text(), re.MULTILINE)
    assert not heading or heading in [head.lower().replace(" ", "-") for head in heads]


def test_configs_that_the_texts_name_exist() -> None:
    configs = re.findall(r"--config (\w+)(?![\w/]|\.yaml)", TEXTS)
    assert configs
    missing = [name for name in configs if not (ROOT / f"configs/{name}.yaml").exists()]
    assert not missing


def test_files_and_names_of_the_library_that_the_texts_name_exist() -> None:
    files = re.findall(r"`((?:fusion_gym|agents|configs|docs|tests)/[\w/]+\.\w+)`", TEXTS)
    names = re.findall(r"`(fusion_gym(?:\.\w+)+)[`(]", TEXTS)
    assert len(files) > 10
    assert len(names) > 10
    assert not [name for name in files if "/my_" not in name and not (ROOT / name).exists()]
    assert not [name for name in names if pydoc.locate(name) is None]


def test_the_readme_says_what_the_results_say() -> None:
    assert headline_text(load_suite().settings, read_results(ROOT / "results")) in README


def test_one_version_is_in_code_results_citations_and_changelog() -> None:
    version = fusion_gym.__version__
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"version = {{{version}}}" in (ROOT / "docs/papers.bib").read_text()
    assert f"in version {version}:" in (ROOT / "results/README.md").read_text()
    headings = re.findall(r"^## \[(.*?)\](.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    number, _, development = version.partition(".dev")
    assert headings[0][0] == number
    assert ("unreleased" in headings[0][1]) == bool(development)


def doc_of(env_id: str) -> str:
    """The page that docs/environments.md links for an environment."""
    text = (ROOT / "docs/environments.md").read_text()
    row = re.search(rf"\[`{env_id.split('/')[1]}`\]\((\w+\.md)\)", text)
    assert row is not None
    return (ROOT / "docs" / row[1]).read_text()


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_every_option_and_entry_has_a_meaning_and_a_table(env_id: str) -> None:
    meanings = {name: option.meaning for name, option in options_in(options_of(env_id)).items()}
    blocks = fusion_gym.make_task(env_id).estimator.observation
    meanings |= {block.name: block.meaning for block in blocks}
    assert not [name for name, meaning in meanings.items() if not meaning]
    page = doc_of(env_id)
    assert "<!-- table: observation " in page
    assert re.search(rf"<!-- table: options .*{env_id}", page)
    pages = page + (ROOT / "docs/options.md").read_text()
    pages += (
        doc_of("fusion_gym/LinearFusion-v2") if " beyond fusion_gym/LinearFusion-v2" in page else ""
    )
    for name, option in options_in(options_of(env_id)).items():
        value = short(option.default).replace("'", '"')
        rows = re.findall(rf"^\| `{name}` .*$|`{name}=.*", pages, re.MULTILINE)
        assert len(value) >= 60 or any(
            f"{value}`" in row or f"{value} or" in row for row in rows
        ), name


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize(
    "name",
    [
        *(path.relative_to(ROOT).as_posix() for path in PAGES if path.stem != "networks"),
        pytest.param("docs/networks.md", marks=pytest.mark.slow),  # makes hundreds of tasks
    ],
)
def test_a_page_has_the_tables_of_the_code(name: str) -> None:
    text = (ROOT / name).read_text()
    assert text == written(text)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_page_is_plain_markdown(path: Path) -> None:
    text, markdown = path.read_text(), MarkdownIt().enable("table")
    words = {token.info for token in markdown.parse(text) if token.type == "fence"}
    assert words <= {*LANGUAGES, "", "bibtex", "console", "json", "text", "{toctree}"}
    assert "{toctree}" not in words or path.name == "index.md"
    parts = [part[0] for part in PART.finditer(text)]
    assert len(parts) == len(
        re.findall(rf"^<!-- table: (?:{'|'.join(TABLES)})\s", text, re.MULTILINE)
    )
    for part in parts:
        assert "<table>" in markdown.render(part)
        assert not re.search(r"``|:\w+:`", part)
        inner = [token for block in markdown.parse(part) for token in block.children or []]
        assert "html_inline" not in {token.type for token in inner}
        links = [str(token.attrs["href"]) for token in inner if token.type == "link_open"]
        assert all((path.parent / link.partition("#")[0]).exists() for link in links)


def test_the_bibliography_has_every_paper_that_an_environment_names() -> None:
    keys = re.findall(r"^@\w+{(\w+),$", (ROOT / "docs/papers.bib").read_text(), re.MULTILINE)
    papers = [path.stem for path in (ROOT / "docs/reproduction").glob("*.md")]
    assert {*papers, "fusion_gym"} == {*keys, "README"}


@pytest.mark.skipif(not (ROOT / ".github").exists(), reason="the source distribution has none")
def test_the_workflow_runs_the_targets_of_ci() -> None:
    workflow = yaml.safe_load((ROOT / ".github/workflows/test.yml").read_text())
    targets = workflow["jobs"]["targets"]["strategy"]["matrix"]["target"]
    assert re.findall(r"^timed make (\S+)", (ROOT / ".ci/run").read_text(), re.MULTILINE) == targets
