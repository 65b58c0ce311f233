"""The steps of CONTRIBUTING, made in a copy of the package, take what its headings count."""

import re
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from page_blocks import blocks_of
from paths import ROOT

PAGE = (ROOT / "CONTRIBUTING.md").read_text()
COUNTED = dict(re.findall(r"^### (.*): (\d+ (?:file|line).*)$", PAGE, re.MULTILINE))


@dataclass(frozen=True)
class Addition:
    """New files by path; for each new line its path, the line that it follows, and its text."""

    check: str
    files: dict[str, str] = field(default_factory=dict)
    lines: tuple[tuple[str, str, str], ...] = ()

    @property
    def count(self) -> str:
        """Its size as a heading says it."""
        lines = sum(1 for *_, text in self.lines for line in text.splitlines() if line)
        sizes = (("file", len(self.files)), ("line", lines))
        return ", ".join(f"{n} {word}{'s' * (n > 1)}" for word, n in sizes if n)


def block(page: str, mark: str) -> str:
    """The Python block of a page that has a mark, without its last lines from a registration on."""
    path = ROOT / page
    text = next(b.text for b in blocks_of(path, path.read_text()) if mark in b.text)
    return text.split("fusion_gym.register")[0]


FILTER = '''"""A filter that trusts its model less."""

from dataclasses import dataclass, replace

from fusion_gym.systems.tobit.filters import KalmanFilter


@dataclass(frozen=True)
class DoubtfulFilter(KalmanFilter):
    """Kalman filter that keeps twice the variance.

    Equation:
        $$P=2\\\\,P_K$$

    Assumes: nothing.

    Source: none.
    """

    def outcomes(self, matrix, expectation, held, time):
        kalman = super().outcomes(matrix, expectation, held, time)
        return kalman._replace(delivered_covariance=2.0 * kalman.delivered_covariance)
'''
ACTION = '''

class Silence(Action):
    """One bit per sensor; 0 is a request."""

    meaning = "A 0 requests the sensor"
    bits = False

    def decode(self, choices: Choices) -> NDArray[Any]:
        """See :class:`Action`."""
        return np.equal(choices, 0)

    def actions(self, requests: Requests) -> NDArray[Any]:
        """See :class:`Action`."""
        return super().actions(~requests)
'''
BUCKET = "core/token_bucket.py"
RESULTS, METRICS = "evaluation/episodes.py", "evaluation/metrics.py"
TOBIT, LINEAR = "systems/tobit/centres.py", "systems/tobit/linear.py"
ADDITIONS = {
    "a rule": Addition(
        "assert fusion_gym.make_policy('old_news:steps=4', oscillator).steps == 4\n"
        "assert 'old_news' in fusion_gym.policy_names('rule')",
        {"policies/old_news.py": block("CONTRIBUTING.md", "class OldNews")},
        (
            (
                "policies/registry.py",
                '        "never": "rules:Never",',
                '        "old_news": "old_news:OldNews",',
            ),
        ),
    ),
    "a metric": Addition(
        "always = run_episodes(oscillator, fusion_gym.make_policy('always', oscillator), 4)\n"
        "np.testing.assert_allclose(always.senders, always.rate.sum(1))\n"
        "assert summarise(always)['senders']['mean'] == always.senders.mean()",
        lines=(
            (RESULTS, "    diverged: Array", "    senders: Array"),
            (
                RESULTS,
                "        diverged: share of diverged steps (E,).",
                "        senders: sensors that transmit in a step (E,).",
            ),
            (
                RESULTS,
                '    "diverged": lambda step: step.outcome.diverged,',
                '    "senders": lambda step: step.outcome.granted.sum(0),',
            ),
            (METRICS, "METRICS = {", '    "senders": Metric("sensors that transmit in a step"),'),
        ),
    ),
    "an option": Addition(
        "task = fusion_gym.make_task('fusion_gym/LinearFusion-v2', initial_variance=4.0)\n"
        "assert (task.plant.dynamics.initial_covariance[..., 0] == 4.0 * np.eye(2)).all()\n"
        "assert 'initial_variance' in gymnasium.make('fusion_gym/LinearFusion-v2')"
        ".spec.pprint(disable_print=True)",
        lines=(
            (
                LINEAR,
                "    filters: ClassVar[Mapping[str, type]] = centres.classes(_FILTERS)",
                "    initial_variance: float = 1.0",
            ),
            (
                LINEAR,
                "    initial_variance: float = 1.0",
                '    """Factor of ``initial_covariance``."""',
            ),
            (
                LINEAR,
                "    start = np.eye(size) if options.initial_covariance is None else "
                "options.initial_covariance",
                "    start = options.initial_variance * np.array(start)",
            ),
        ),
    ),
    "an option of all environments": Addition(
        "plain, dear = (\n"
        "    fusion_gym.make_task('fusion_gym/TobitOscillator-v1', surcharge=extra)\n"
        "    for extra in (0.0, 2.0)\n"
        ")\n"
        "np.testing.assert_array_equal(dear.network.bucket.cost, plain.network.bucket.cost + 2.0)\n"
        "env = gymnasium.make('fusion_gym/TobitOscillator-v1', surcharge=2.0)\n"
        "assert 'surcharge: float = 2' in env.spec.pprint(disable_print=True)\n"
        "assert 'surcharge' in dear.settings\n"
        "assert dear.options.nominal().surcharge == 2.0",
        lines=(
            (
                BUCKET,
                "    token_cost: Annotated[ArrayLike, Scaling()] = 3.0",
                "    surcharge: Annotated[float, Scaling()] = 0.0\n"
                '    """Tokens that every transmission costs besides ``token_cost``."""',
            ),
            (
                BUCKET,
                '        """Tokens c (sensors, 1) of a transmission."""',
                "        return self.options.surcharge + validation.positive("
                "'token_cost', self.options.token_cost, (self.sensors,))[:, None]",
            ),
        ),
    ),
    "a rule of medium access": Addition(
        "task = fusion_gym.make_task('fusion_gym/TobitOscillator-v1', access='countdown')\n"
        "batch = EpisodeBatch.seeded(task, 2, 0)\n"
        "everyone = np.ones((3, 2), dtype=bool)\n"
        "turns = [batch.step(everyone).granted.argmax(0).tolist() for _ in range(3)]\n"
        "assert turns == [[2, 2], [1, 1], [0, 0]]",
        lines=(
            (
                "core/access.py",
                "ACCESS: dict[str, AccessRow] = {",
                '    "countdown": AccessRow("In turn.", lambda n, step, _: (2 - step) % n),',
            ),
        ),
    ),
    "an action": Addition(
        "env = gymnasium.make('fusion_gym/TobitOscillator-v1', action='silence')\n"
        "env.reset(seed=0)\n"
        "assert env.step(np.array([1, 1, 0]))[-1]['granted'].tolist() == [False, False, True]\n"
        "masks = env.unwrapped.action_masks()\n"
        "assert masks.shape == (6,)\n"
        "assert 'A 0 requests' in env.unwrapped.__doc__\n"
        "always = fusion_gym.make_policy('always', env)\n"
        "assert always.predict(env.reset(seed=0)[0])[0].tolist() == [0, 0, 0]",
        lines=(
            ("core/action.py", "ACTIONS: dict[str, type[Action]] = {", '    "silence": Silence,'),
            (
                "core/action.py",
                "        return super().choose(scores, threshold) & _largest(scores)",
                ACTION,
            ),
        ),
    ),
    "a filter": Addition(
        "task = fusion_gym.make_task('fusion_gym/TobitOscillator-v1', filter='doubtful')\n"
        "assert type(task.estimator.centre.filter).__name__ == 'DoubtfulFilter'\n"
        "run_episodes(task, fusion_gym.make_policy('always', task), 4)",
        {"systems/tobit/doubtful.py": FILTER},
        (
            (
                TOBIT,
                "from fusion_gym.systems.tobit.sensors import CensoredSensors",
                "from fusion_gym.systems.tobit.doubtful import DoubtfulFilter",
            ),
            (TOBIT, "FILTERS = {", '    "doubtful": at_the_nodes(DoubtfulFilter),'),
        ),
    ),
    "an environment": Addition(
        "env = gymnasium.make('fusion_gym/Pendulum-v0')\n"
        "env.reset(seed=0)\n"
        "assert env.step(env.action_space.sample())[1] <= 0.0\n"
        "assert 'fusion_gym/Pendulum-v0' in gymnasium.registry",
        {
            "systems/pendulum/__init__.py": '"""A pendulum."""\n',
            "systems/pendulum/environment.py": block("docs/your_system.md", "# pendulum_ekf.py"),
        },
        (
            (
                "envs/registration.py",
                "ENVIRONMENTS: dict[str, str | Build] = {",
                '    "fusion_gym/Pendulum-v0": "fusion_gym.systems.pendulum.environment:build",',
            ),
        ),
    ),
}
BEGIN = """
import os, gymnasium, numpy as np, fusion_gym
assert fusion_gym.__file__.startswith(os.getcwd())
from fusion_gym.core.batch import EpisodeBatch
from fusion_gym.evaluation import run_episodes, summarise
oscillator = fusion_gym.make_task("fusion_gym/TobitOscillator-v1", horizon=10)
"""


@pytest.mark.parametrize("heading", ADDITIONS)
def test_an_addition_takes_what_the_page_counts(heading: str, tmp_path: Path) -> None:
    addition = ADDITIONS[heading]
    assert COUNTED[heading] == addition.count
    package = tmp_path / "fusion_gym"
    shutil.copytree(ROOT / "fusion_gym", package, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    for name, text in addition.files.items():
        (package / name).parent.mkdir(exist_ok=True)
        (package / name).write_text(text)
    for name, before, line in addition.lines:
        text = (package / name).read_text()
        assert text.count(f"\n{before}\n") == 1, before
        (package / name).write_text(text.replace(f"\n{before}\n", f"\n{before}\n{line}\n"))
    line = [sys.executable, "-c", BEGIN + addition.check]
    result = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
