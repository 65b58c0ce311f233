"""The worked examples of LinearFusion: they run, and their files hold what their sources say."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from paths import ROOT
from scipy.linalg import expm
from scipy.stats import norm

EXAMPLES = ROOT / "examples"
STEP, DENSITY = 0.2, 0.005  # of the vehicle


def module(name: str) -> ModuleType:
    specification = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert specification is not None
    assert specification.loader is not None
    result = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(result)
    return result


def held(name: str) -> dict[str, Any]:
    content = yaml.safe_load((EXAMPLES / f"{name}.yaml").read_text())
    assert isinstance(content, dict)
    return content


@pytest.mark.parametrize("name", ["vehicle", "tanks"])
def test_it_runs_and_keeps_its_budget(name: str, tmp_path: Path) -> None:
    """The script beside its file, here with shorter episodes."""
    content = held(name) | {"horizon": 12}
    (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(content))
    script = tmp_path / f"{name}.py"
    script.write_text((EXAMPLES / f"{name}.py").read_text())
    environment = {"PYTHONPATH": str(EXAMPLES.parent), "PATH": ""}
    line = [sys.executable, str(script), "12"]
    done = subprocess.run(line, capture_output=True, text=True, env=environment, check=True)
    title, head, *rows = done.stdout.splitlines()
    rules = module(name).RULES
    assert title == "12 episodes, seeds 0 to 11; 95 % intervals"
    assert head.split()[0] == "rule"
    assert [row[: len(label)] for row, label in zip(rows, rules, strict=True)] == list(rules)
    most = content["token_rate"] + content["initial_tokens"] / 12
    for row, label in zip(rows, rules, strict=True):
        words = row[len(label) :].split()
        tokens, mean, low, high, nees = (float(word.strip("[,]")) for word in words)
        assert 0.0 < tokens <= most
        assert 0.0 < low <= mean <= high
        assert 0.2 < nees < 2.0


def discretised(drift: NDArray[Any], noise: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """A and W of x' = drift x + white noise, by the exponential of Van Loan's block matrix."""
    n = len(drift)
    whole = expm(STEP * np.block([[-drift, noise], [np.zeros((n, n)), drift.T]]))
    transition = whole[n:, n:].T
    return transition, transition @ whole[:n, n:]


def test_the_vehicle_moves_as_its_source_says() -> None:
    drift = np.kron(np.eye(2), [[0.0, 1.0], [0.0, 0.0]])
    noise = np.kron(np.eye(2), np.diag([0.0, DENSITY]))
    transition, process = discretised(drift, noise)
    content = held("vehicle")
    np.testing.assert_allclose(content["transition"], transition, atol=1e-12)
    np.testing.assert_allclose(content["process_covariance"], process, atol=1e-9)
    assert np.sqrt(process[1, 1]) == pytest.approx(0.03, abs=0.002)
    # Within the walls, 6 m on either side, in more than 99 % of the steps.
    mean, spread = np.array([6.0, 0, 6.0, 0]), np.array(content["initial_covariance"])
    outside = []
    for _ in range(content["horizon"]):
        mean, spread = transition @ mean, transition @ spread @ transition.T + process
        outside.append(4.0 * norm.sf(6.0 / np.sqrt(spread[0, 0])))
    assert mean.tolist() == [6.0, 0, 6.0, 0]
    assert np.mean(outside) < 0.013  # on either axis, at either wall
    assert np.mean(outside) / 2.0 < 0.01


def test_the_tanks_are_johanssons() -> None:
    tanks = module("tanks")
    assert tanks.time_constants().round().tolist() == [63.0, 91.0, 39.0, 56.0]  # as he prints
    content = held("tanks")
    for name, value in tanks.options().items():
        np.testing.assert_allclose(content[name], value, atol=1e-6, err_msg=name)
    # The steady state of the pumps at 3.15 V is the operating point: inflow is outflow.
    flow = tanks.OUTLET * np.sqrt(2.0 * tanks.GRAVITY * tanks.LEVEL)
    pumped, valve = 3.15 * np.array(tanks.PUMP), np.array(tanks.VALVE)
    inflow = np.concatenate([valve * pumped + flow[2:], ((1 - valve) * pumped)[::-1]])
    np.testing.assert_allclose(flow, inflow, rtol=0.03)  # the paper prints two or three digits
    assert len(content["measurement_matrices"]) == 20
    levels = np.diff(np.reshape(content["censoring_threshold"], (4, 5)))
    np.testing.assert_allclose(levels, 4.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vehicle", "tanks"])
def test_the_page_has_what_the_script_prints(name: str) -> None:
    page = (EXAMPLES.parent / "docs" / "linear_fusion.md").read_text()
    script = str(EXAMPLES / f"{name}.py")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True)
    rows = done.stdout.splitlines()[2:]
    for row, (label, rule) in zip(rows, module(name).RULES.items(), strict=True):
        tokens, error, nees = re.split(r"\s{2,}", row[len(label) :].strip())
        assert f"| `{rule}` | {tokens} | {error} | {nees} |" in page, row
