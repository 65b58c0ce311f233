"""Every reproduced paper's page against a fresh quick run: numbers, claims and figures."""

from pathlib import Path

import pytest
from command_runs import call
from matplotlib.text import Text
from reproduction_checks import check_claims, check_numbers, check_pictures, committed, quick

from fusion_gym.agents.output import palette
from fusion_gym.agents.papers.paper import NAMES, load_paper
from fusion_gym.agents.reproduce import reproduce_figure
from fusion_gym.policies.settings import parse_settings

# Episodes, and the first words of claims that so few leave open: differences of a few per cent,
# rare errors, wide intervals.
PAPERS: dict[str, tuple[int, tuple[str, ...]]] = {
    "tobit_token_bucket": (40, (
        "Censoring makes the local", "The fused estimate, fed back", "In most cases",
        "Fusion improves", "Condition (42)",
    )),
    "adaptive_innovation": (12, (
        "The rates of the three sensors", "The MSE is close", "More than 99 %",
        "The actual deviations never exceed", "P̄ is the covariance", "The trigger saves",
    )),
    "markov_jump": (30, (
        "The algorithm tracks", "The tracking becomes worse", "The RMSE curve",
        "The trigger reduces",
    )),
    "unknown_input": (24, ("Fusion by covariance intersection",)),
    "round_robin_tobit": (24, (
        "FTKF", "RMSE", "The bias's RMSE", "The fused", "The narrower", "The smaller", "(12)",
        "(13)", "(9)", "(21)", "The local estimate", "Censored observations",
    )),
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_the_page_is_that_of_a_fresh_run(name: str) -> None:
    episodes, uncertain = PAPERS[name]
    paper, page = load_paper(name), committed(name)
    fresh, data = quick(paper, episodes)
    check_numbers(page, fresh, episodes)
    check_claims(page, fresh, name, uncertain)
    check_pictures(paper, data)


@pytest.mark.parametrize(
    ("name", "figure", "changes", "label"),
    [
        ("markov_jump", "5", {"m": "0.7", "policies": "random:rate=0.3"}, "m = 0.7"),
        ("adaptive_innovation", "7", {"scales": "0.5,0.9"}, "(b) 0.9 of bounds"),
        ("round_robin_tobit", "table_2", {"interval": "2,1"}, "[-1, 1]"),
        ("round_robin_tobit", "5", {"policy": "round_robin:period=2"}, "RMSE1 (of x1)"),
    ],
)
def test_a_figure_has_parameters(
    name: str, figure: str, changes: dict[str, str], label: str, tmp_path: Path
) -> None:
    texts = [f"{key}={value}" for key, value in changes.items()]
    words = [name, "--figure", figure, "--episodes", "2", "--set", *texts, "--workers", "1"]
    ended = call("reproduce", [*words, "--output", str(tmp_path), "--work", str(tmp_path)])
    assert ended.status == 0, ended.err
    assert {path.suffix for path in tmp_path.rglob("*_*.*")} >= {".png", ".svg"}
    drawing = reproduce_figure(name, figure, 2, **parse_settings("option", texts))
    assert label in {text.get_text() for text in drawing.findobj(Text)}
    palette.plt.close(drawing)
