"""Every reproduced paper's page against a fresh quick run: numbers, claims and figures."""

import pytest
from reproduction_checks import check_claims, check_numbers, check_pictures, committed, quick

from fusion_gym.agents.papers.paper import NAMES, load_paper

# Episodes, the least count of numbers, the count of figures, and the first words of claims that so
# few episodes leave open: differences of a few per cent, rare errors, wide intervals.
PAPERS: dict[str, tuple[int, int, int, tuple[str, ...]]] = {
    "tobit_token_bucket": (40, 60, 9, (
        "Censoring makes the local", "The fused estimate, fed back", "In most cases",
        "Fusion improves", "Condition (42)",
    )),
    "adaptive_innovation": (12, 50, 7, (
        "The rates of the three sensors", "The MSE is close", "More than 99 %",
        "The actual deviations never exceed", "P̄ is the covariance", "The trigger saves",
    )),
    "markov_jump": (30, 50, 4, (
        "The algorithm tracks", "The tracking becomes worse", "The RMSE curve",
        "The trigger reduces",
    )),
    "unknown_input": (24, 40, 7, ("Fusion by covariance intersection",)),
    "round_robin_tobit": (24, 100, 15, (
        "FTKF", "RMSE", "The bias's RMSE", "The fused", "The narrower", "The smaller", "(12)",
        "(13)", "(9)", "(21)", "The local estimate", "Censored observations",
    )),
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_the_page_is_that_of_a_fresh_run(name: str) -> None:
    episodes, numbers, figures, uncertain = PAPERS[name]
    paper, page = load_paper(name), committed(name)
    fresh, data = quick(paper, episodes)
    assert check_numbers(page, fresh, episodes) > numbers
    check_claims(page, fresh, name, uncertain)
    assert check_pictures(paper, data) == figures
