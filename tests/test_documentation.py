"""What the README and the pages show must run, and their tables must name what exists."""

import importlib.util
import pydoc
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from page_blocks import blocks_of, imported

import fusion_gym
from agents.benchmark.report import headline_text
from agents.benchmark.settings import load_suite
from agents.benchmark.tables import ClassRow, read_rows
from fusion_gym.envs import pages
from fusion_gym.envs.option_text import options_in
from fusion_gym.envs.registration import ENVIRONMENTS, options_of

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
DOCS = sorted((ROOT / "docs").glob("*.md"))
TEXTS = README + "".join(path.read_text() for path in (*DOCS, ROOT / "CONTRIBUTING.md"))


def importable(code: str) -> bool:
    """Whether all packages that it imports are here."""
    packages = {module.partition(".")[0] for module in imported(code)}
    return all(importlib.util.find_spec(package) is not None for package in packages)


TITLES = {setting.name: setting.title for setting in load_suite().settings}
JOURNEYS = [path.read_text() for path in (ROOT / "tests" / "journeys").glob("*.py")]
BLOCKS = {
    path.name: blocks_of(path.relative_to(ROOT), path.read_text())
    for path in (ROOT / "README.md", *DOCS, ROOT / "CONTRIBUTING.md")
}
EXAMPLES = [
    (name, place)
    for name, blocks in BLOCKS.items()
    for place, block in enumerate(blocks)
    # Those of libraries that are not here are run by `make integrations` and its sisters.
    if block.language == "python"
    and block.text not in JOURNEYS  # tests/test_journeys.py runs them
    and (name != "other_libraries.md" or importable(block.text))
]


@pytest.mark.parametrize(("name", "place"), EXAMPLES)
def test_python_examples_run(
    name: str, place: int, registries: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``tests/wheel_blocks.py`` runs them again, with the wheel and the extras that they need."""
    monkeypatch.chdir(tmp_path)
    block = BLOCKS[name][place]
    for other in BLOCKS[name][:place]:
        if other.file is not None:
            Path(other.file).write_text(other.text)
    exec(compile(block.text, "example", "exec"), {})


def test_the_evaluation_command_runs(tmp_path: Path) -> None:
    words = next(
        words
        for block in BLOCKS["policies.md"]
        for _, words in block.commands()
        if words[:2] == ["fusion-gym", "evaluate"]
    )
    words[words.index("--json") + 1] = str(tmp_path / "evaluation.json")
    line = [sys.executable, "-m", "fusion_gym.commands", *words[1:]]
    subprocess.run(line, cwd=ROOT, check=True, capture_output=True)
    assert (tmp_path / "evaluation.json").exists()


@pytest.mark.parametrize("path", [ROOT / "README.md", *DOCS], ids=lambda path: path.stem)
def test_what_a_page_links_exists(path: Path) -> None:
    for name, part in re.findall(r"\]\(([\w/.]*)(?:#([\w-]+))?\)", path.read_text()):
        target = path.parent / name if name else path
        assert target.exists(), name
        if part:
            heads = re.findall(r"^#+ (.*)$", target.read_text(), re.MULTILINE)
            anchors = [re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads]
            assert part in anchors, f"{name}#{part}"


def test_configs_that_the_texts_name_exist() -> None:
    configs = re.findall(r"(?:--config|--sweep) (\w+)(?![\w/]|\.yaml)", TEXTS)
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
    titles = {setting.name: setting.title for setting in load_suite().settings}
    assert headline_text(titles, read_rows(ROOT / "results", ClassRow)) in README


def doc_of(env_id: str) -> str:
    """The file in docs that the README's table links for an environment."""
    row = re.search(rf"\[`{env_id}`\]\((docs/\w+\.md)\)", README)
    assert row is not None
    return (ROOT / row[1]).read_text()


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_every_option_and_entry_has_a_meaning_and_a_table(env_id: str) -> None:
    meanings = {name: option.meaning for name, option in options_in(options_of(env_id)).items()}
    blocks = fusion_gym.make_task(env_id).system.observation
    meanings |= {block.name: block.meaning for block in blocks}
    assert not [name for name, meaning in meanings.items() if not meaning]
    page = doc_of(env_id)
    assert re.search(rf"<!-- options: .*{env_id}", page)
    assert "<!-- observation: " in page


@pytest.mark.parametrize("path", DOCS, ids=lambda path: path.stem)
def test_tables_in_the_docs_are_those_of_the_code(path: Path) -> None:
    text = path.read_text()
    assert text == pages.update_tables(text), "run python -m fusion_gym.envs.pages docs/*.md"


def test_the_citation_is_of_this_version() -> None:
    citation = (ROOT / "CITATION.cff").read_text()
    project = (ROOT / "pyproject.toml").read_text()
    for text in (citation, project):
        assert re.search(r'^version(?:: | = ")([\d.]+)', text, re.MULTILINE)[1] == (  # type: ignore[index]
            fusion_gym.__version__
        )
    assert f"version = {{{fusion_gym.__version__}}}" in (ROOT / "docs/papers.bib").read_text()


def test_the_bibliography_has_every_paper_that_an_environment_names() -> None:
    keys = re.findall(r"^@\w+{(\w+),$", (ROOT / "docs/papers.bib").read_text(), re.MULTILINE)
    papers = [path.stem for path in (ROOT / "docs/reproduction").glob("*.md")]
    assert {*papers, "fusion_gym"} == {*keys, "README"}


@pytest.mark.skipif(not (ROOT / ".github").exists(), reason="the source distribution has none")
def test_the_workflow_runs_the_targets_of_ci() -> None:
    workflow = yaml.safe_load((ROOT / ".github/workflows/test.yml").read_text())
    targets = workflow["jobs"]["targets"]["strategy"]["matrix"]["target"]
    assert re.findall(r"^make (\S+)$", (ROOT / ".ci/run").read_text(), re.MULTILINE) == targets
