"""Names and texts have no word that docs/glossary.md rejects."""

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from paths import ROOT

import fusion_gym
from fusion_gym.commands.__main__ import COMMANDS
from fusion_gym.envs import registered
from fusion_gym.envs.registration import ENVIRONMENTS, class_name

MODULES = sorted(p for f in ("fusion_gym", "agents") for p in (ROOT / f).rglob("*.py"))
TREES = {p.relative_to(ROOT).as_posix(): ast.parse(p.read_text()) for p in MODULES}


def rejected(heading: str) -> list[str]:
    """The words of the first column under a heading of the glossary."""
    section = (ROOT / "docs/glossary.md").read_text().split(f"## {heading}\n")[1].split("\n## ")[0]
    rows = re.findall(r"^\| (.*?) \|", section, re.MULTILINE)[1:]
    return [word for row in rows for word in row.split(", ")]


WORDS, NAMES = set(rejected("Rejected words")), set(rejected("Rejected names"))
IN_PROSE = re.compile(rf"\b({'|'.join(sorted(WORDS))})\b", re.IGNORECASE)


def names_in(tree: ast.Module) -> Iterator[str]:
    """Functions, methods, classes, their parameters and fields."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
            if isinstance(node, ast.FunctionDef):
                yield from (a.arg for a in ast.walk(node.args) if isinstance(a, ast.arg))
            else:
                yield from (
                    ast.unparse(f.target) for f in node.body if isinstance(f, ast.AnnAssign)
                )


def named_by_environments() -> set[str]:
    """Policies, commands, and the signals and entries of all environments."""
    names = {*fusion_gym.policy_names(), *COMMANDS}
    for task in map(fusion_gym.make_task, ENVIRONMENTS):
        names |= {s.name for s in task.estimator.signals}
        names |= {b.name for b in task.estimator.observation}
    return names


def texts() -> Iterator[tuple[str, str]]:
    for path in sorted((ROOT / "docs").rglob("*.md")):
        if path.name != "glossary.md":
            yield path.relative_to(ROOT).as_posix(), path.read_text()
    for name, tree in TREES.items():
        values = (getattr(n.value, "value", 0) for n in ast.walk(tree) if isinstance(n, ast.Expr))
        yield name, "\n".join(value for value in values if isinstance(value, str))
    kinds = (getattr(registered, f"{class_name(env_id)}Env") for env_id in ENVIRONMENTS)
    lines = (line for kind in kinds for line in str(kind.__doc__).splitlines())
    yield "help", "\n".join(dict.fromkeys(lines))


def test_names_hold_no_rejected_word() -> None:
    modules = [Path(path).stem for path in TREES]
    names = named_by_environments().union(modules, *map(names_in, TREES.values()))
    parts = {n: {w.lower() for w in re.findall("[A-Z]?[a-z]+", n)} for n in names}
    rejected = WORDS | NAMES - {"of", "one"}
    assert not {n for n in names if n.strip("_") in NAMES or parts[n] & rejected}


def test_a_public_name_has_one_meaning() -> None:
    places = defaultdict(set)
    for path, tree in TREES.items():
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].add(path)
    assert not {n: p for n, p in places.items() if len(p) > 1 and n != "main"}


def test_texts_hold_no_rejected_word() -> None:
    counts = {path: IN_PROSE.findall(text) for path, text in texts()}
    assert not {path: words for path, words in counts.items() if words}
