"""rejax: PPO in one program with the environment, as cheap and as good as the page says."""

from __future__ import annotations

import statistics

from integrations.page import run


def test_the_page() -> None:
    names = run("rejax")
    ours, theirs = (statistics.mean(values) for values in names["returns"].values())
    assert 1.05 * theirs < ours < -5.0  # returns are negative
    ours, theirs = (statistics.median(values) for values in names["seconds"].values())
    assert ours < 0.6 * theirs
