"""Any options at all: one line that names one of them, or fifty finite steps.

``-m slow`` draws a hundred for every environment.
"""

import pytest
from fuzzing import FREE, Options, flaw, options
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from fusion_gym.envs.registration import ENVIRONMENTS

SEEDS = st.integers(0, 2**31 - 1)


@pytest.mark.parametrize("tries", [15, pytest.param(100, marks=pytest.mark.slow)])
@pytest.mark.parametrize("env_id", list(ENVIRONMENTS))
def test_any_options_are_refused_by_name_or_work(env_id: str, tries: int) -> None:
    @settings(max_examples=tries, derandomize=True, phases=[Phase.generate, Phase.shrink], **FREE)
    @given(selection=options(env_id), seed=SEEDS)
    def sound(selection: Options, seed: int) -> None:
        assert flaw(env_id, selection, seed) is None

    sound()
