"""Episodes in Minari's format, with their infos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from integrations.page import run


def test_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = run("Store episodes with Minari")["dataset"]
    assert dataset.total_episodes == 4
    for episode in dataset:
        assert episode.observations.shape[0] == 51
        total = episode.infos["reward_error"][1:] + episode.infos["reward_cost"][1:]
        np.testing.assert_allclose(total, episode.rewards)
