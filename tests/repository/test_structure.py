"""Imports run one way, without circles, and packages stay small."""

import ast
import functools
import itertools
import tomllib
from pathlib import Path

import pytest
from paths import ROOT

from fusion_gym import seeds

# Each package may import from the rows above its own, and from itself.
ROWS = (
    "arrays declaration docstrings entries errors gaussian importing linalg lowering namespace "
    "seeds validation version yaml_text",
    "fusion",
    "core",
    "systems",
    "envs solvers zoo",
    "jax policies wrappers",
    "evaluation configs",
    "output",
    "training recordings",
    "commands",
)
FLOORS = {name: floor for floor, row in enumerate(ROWS) for name in row.split()}


@functools.cache
def modules() -> dict[str, Path]:
    """Every module of the library by its dotted name."""
    files = [*(ROOT / "fusion_gym").rglob("*.py"), *(ROOT / "agents").rglob("*.py")]
    named = {".".join(p.relative_to(ROOT).with_suffix("").parts): p for p in files}
    return {name.removesuffix(".__init__"): path for name, path in named.items()}


@functools.cache
def imports(module: str) -> frozenset[str]:
    """The library's modules that a module imports, wherever in its text."""
    every, result = modules(), set()
    for node in ast.walk(ast.parse(every[module].read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{module} has a relative import"
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                result.add(inner if inner in every else node.module)
        elif isinstance(node, ast.Import):
            result |= {alias.name for alias in node.names}
    return frozenset(result & every.keys())


@functools.cache
def reached(module: str) -> set[str]:
    """All that a module imports, directly or not, and itself."""
    visited: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in visited:
            visited.add(name)
            waiting += imports(name)
    return visited


def floor(module: str) -> int | None:
    parts = module.split(".")
    if parts[0] == "agents":  # research, made with the library
        return len(ROWS)
    return FLOORS[parts[1]] if len(parts) > 1 else None


def package_of(module: str) -> str:
    first, *rest = module.split(".")
    return rest[0] if first == "fusion_gym" else first


@pytest.mark.parametrize("module", [name for name in modules() if floor(name) is not None])
def test_imports_run_downwards(module: str) -> None:
    package, own = package_of(module), floor(module)
    for other in imports(module):
        below = floor(other)
        if package == "agents" and other == "fusion_gym":
            continue
        assert below is not None, f"{module} imports the whole package"
        assert own is not None
        same = package_of(other) == package or own == below == 0
        assert same or below < own, f"{module} imports {other}"
        if package == "systems" and other.startswith("fusion_gym.systems."):
            families = [name.split(".")[2] for name in (module, other) if name.count(".") > 2]
            assert len(set(families)) <= 1, f"{module} imports {other} of another family"


def test_only_the_registration_knows_the_families_of_systems() -> None:
    """It has their names; others ask for the classes of fusion_gym/systems/solvable.py."""
    home = "fusion_gym.systems."
    families = {
        n for n, path in modules().items() if n.startswith(home) and path.stem == "__init__"
    }
    users = {"fusion_gym", "fusion_gym.envs.registration"}
    users |= {"fusion_gym.recordings.environment"}  # it extends LinearFusion
    assert families
    for module in modules().keys() - users:
        for other in imports(module):
            family = ".".join(other.split(".")[:3])
            inside = module.startswith((f"{family}.", "agents."))
            assert family not in families or inside, f"{module} imports {other}"


def test_only_commands_of_logs_and_the_registration_know_recordings() -> None:
    """The registration has the name of their environment, and imports it on its first use."""
    users = {f"fusion_gym.commands.{name}" for name in ("field", "fit", "info")}
    users |= {"fusion_gym.envs.registration"}
    for module, path in modules().items():
        texts = {path.read_text(), *imports(module)}
        if any("fusion_gym.recordings" in text for text in texts):
            inside = module.startswith(("fusion_gym.recordings", "agents."))
            assert inside or module in users, module


def test_there_are_no_circles() -> None:
    for module in modules():
        for other in imports(module):
            assert module not in reached(other), f"{module} and {other} import each other"


@pytest.mark.parametrize("package", ["core", "fusion", "systems"])
def test_what_knows_no_environment_imports_no_gymnasium(package: str) -> None:
    for path in (ROOT / "fusion_gym" / package).rglob("*.py"):
        text = path.read_text()
        assert "import gymnasium" not in text, path
        assert "from gymnasium" not in text or path.name == "action.py", path  # its spaces


def test_every_purpose_has_seeds_of_its_own() -> None:
    """The ranges of seeds are disjoint, and no module writes a seed of one as a literal."""
    ranges = sorted(
        (r for r in vars(seeds).values() if isinstance(r, range)), key=lambda r: r.start
    )
    assert all(low.stop <= high.start for low, high in itertools.pairwise(ranges))
    for module, path in modules().items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and type(node.value) is int:
                used = [r for r in ranges if r != seeds.TEST and node.value in r[: 10**9]]
                assert not used or module == "fusion_gym.seeds", (module, node.value)


def test_every_mutant_changes_one_place_and_names_tests_that_exist() -> None:
    table = tomllib.loads((ROOT / "tests/mutants/mutants.toml").read_text(encoding="utf-8"))
    for name, mutant in table.items():
        assert (ROOT / mutant["file"]).read_text(encoding="utf-8").count(mutant["old"]) == 1, name
        paths = [line.split(" -k ")[0].partition("::")[0] for line in mutant["tests"]]
        assert all((ROOT / path).exists() for path in paths), name
