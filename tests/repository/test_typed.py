"""Types and options as an editor, a type checker, ``help`` and the specification show them."""

import inspect
import os
import subprocess
import sys
import venv
from dataclasses import fields
from pathlib import Path

import gymnasium as gym
import pytest
from paths import ROOT

import fusion_gym
from fusion_gym.core.access import ACCESS
from fusion_gym.envs import registered
from fusion_gym.envs.option_text import FOR_ALL, short
from fusion_gym.envs.registration import ENVIRONMENTS, FusionSpec, class_name, options_of

USER = ROOT / "tests/repository/typed_user.py"
PLANT = ROOT / "tests/helpers/linear_case.py"  # a plant of the user's own
SKIPPED = ",".join(f"mypy-{name}.*" for name in ("torch", "jax", "jaxlib", "pygame"))  # large ones
STRICT = f"[mypy]\nstrict = True\n[{SKIPPED}]\nfollow_imports = skip\n"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment in which the package is a typed one of others'."""
    folder = tmp_path_factory.mktemp("installed")
    venv.create(folder / "environment", with_pip=False)
    (packages,) = (folder / "environment").glob("lib/python3*/site-packages")
    (packages / "fusion_gym").symlink_to(ROOT / "fusion_gym", target_is_directory=True)
    others = [path for path in sys.path if path.endswith("site-packages")]
    (packages / "others.pth").write_text("\n".join(others))
    return folder / "environment" / "bin" / "python"


def strictly(python: Path, folder: Path) -> str:
    """What ``mypy --strict`` says of a user's files, outside of the repository."""
    (folder / "mypy.ini").write_text(STRICT)
    line = [sys.executable, "-m", "mypy", "--config-file", "mypy.ini"]
    line += ["--python-executable", str(python), "."]
    line += ["--cache-dir", str(ROOT / ".mypy_cache" / "strict")]
    return subprocess.run(line, cwd=folder, capture_output=True, text=True).stdout


@pytest.mark.slow
def test_mypy_strict_accepts_what_a_user_writes(installed: Path, tmp_path: Path) -> None:
    """It needs every ``type: ignore`` that stands there, so that no type is Any by chance."""
    for path in (USER, PLANT):
        (tmp_path / path.name).write_text(path.read_text())
    output = strictly(installed, tmp_path)
    assert output.startswith("Success"), output


@pytest.mark.slow
def test_what_a_user_writes_runs() -> None:
    paths = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (ROOT, PLANT.parent)))}
    words = [sys.executable, str(USER)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, env=paths, check=True)
    assert "Interval(mean=" in done.stdout


def test_every_name_that_is_offered_is_there() -> None:
    for name in fusion_gym.__all__:
        assert getattr(fusion_gym, name) is not None
        assert name in dir(fusion_gym)
    with pytest.raises(AttributeError, match="make_taks"):
        fusion_gym.make_taks  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_the_specification_lists_every_option(env_id: str) -> None:
    specification = gym.spec(env_id)
    assert isinstance(specification, FusionSpec)
    kind = options_of(env_id)
    own = [field.name for field in fields(kind)]
    options = specification.options
    assert set(options) == {*own, *FOR_ALL}
    text = specification.pprint(disable_print=True)
    assert text is not None
    lines = [line.strip() for line in text.splitlines()]
    assert lines[0] == f"id={env_id}"
    for name in own:
        place = lines.index(f"{name}: {options[name].type} = {short(getattr(kind(), name))}")
        assert lines[place + 1] == options[name].meaning
    assert options["access"].type == " | ".join(map(repr, ACCESS))
    assert options["price_range"].type == "ArrayLike | 'auto' | None"
    for ending in ("Env", "VectorEnv"):  # what an editor shows of the class, and help
        parameters = inspect.signature(getattr(registered, class_name(env_id) + ending)).parameters
        for name in own:
            assert parameters[name].annotation == options[name].type
