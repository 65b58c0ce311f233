"""Any options at all: one line that names one of them, or fifty finite steps.

``-m slow`` draws a thousand for every environment; at most one in a thousand may be flawed.
"""

from __future__ import annotations

import pytest
from fuzzing import FREE, Options, flaw, options
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from fusion_gym.envs.registration import ENVIRONMENTS

SEEDS = st.integers(0, 2**31 - 1)
each_id = pytest.mark.parametrize("env_id", list(ENVIRONMENTS))


@each_id
def test_any_options_are_refused_by_name_or_work(env_id: str) -> None:
    @settings(max_examples=25, derandomize=True, phases=[Phase.generate, Phase.shrink], **FREE)
    @given(chosen=options(env_id), seed=SEEDS)
    def sound(chosen: Options, seed: int) -> None:
        assert flaw(env_id, chosen, seed) is None

    sound()


@pytest.mark.slow
@each_id
def test_one_in_a_thousand(env_id: str) -> None:
    flaws: list[tuple[str, Options]] = []
    tries = 1000

    @settings(max_examples=tries, derandomize=True, phases=[Phase.generate], **FREE)
    @given(chosen=options(env_id), seed=SEEDS)
    def look(chosen: Options, seed: int) -> None:
        found = flaw(env_id, chosen, seed)
        if found is not None:
            flaws.append((found, chosen))

    look()
    assert len(flaws) <= tries // 1000, flaws


class TestTheJudge:
    """It finds what it is there to find."""

    ENV_ID = "fusion_gym/RemoteEstimation-v0"

    def test_good_options(self) -> None:
        assert flaw(self.ENV_ID, {"sensors": 2, "coefficient": (0.9, 1.0)}) is None
        assert flaw(self.ENV_ID, {"sensors": 0}) is None

    def test_an_error_that_names_nothing_given(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.replace(monkeypatch, ValueError("token_rate is not allowed"))
        assert "ValueError when made" in str(flaw(self.ENV_ID, {"sensors": 2}))
        from fusion_gym import ConfigurationError

        self.replace(monkeypatch, ConfigurationError("token_rate = 1 is not allowed"))
        assert "names none" in str(flaw(self.ENV_ID, {"sensors": 2}))
        assert flaw(self.ENV_ID, {"token_rate": 1}) is None

    def replace(self, monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
        def make_vec(*_: object, **__: object) -> None:
            raise error

        monkeypatch.setattr("gymnasium.make_vec", make_vec)

    def test_what_is_not_finite(self, monkeypatch: pytest.MonkeyPatch) -> None:
        from fusion_gym.core.batch import EpisodeBatch

        plain = EpisodeBatch.observe
        monkeypatch.setattr(EpisodeBatch, "observe", lambda batch: plain(batch) / 0.0)
        assert "warning" in str(flaw(self.ENV_ID, {})).lower()
        monkeypatch.setattr(EpisodeBatch, "observe", lambda batch: plain(batch) * float("nan"))
        assert "not finite" in str(flaw(self.ENV_ID, {}))
