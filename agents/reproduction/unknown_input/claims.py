"""What both unknown-input examples say about the paper's claims."""

from typing import Any

from fusion_gym.arrays import Array

from ..judging import below, cite, estimate, percent, verdict
from ..piece_result import Claim, Number, NumbersTable, PieceResult
from .figures import unknown_input_pictures
from .filters import FIXED, OURS, WALK
from .runs import CARTS, EXAMPLES, NAMES, PRINTED

_TRACKED = 0.1  # of a quantity's mean square: an error below it is called accurate
_FEW = 0.5  # a rate below it is called a significant reduction
_GROWN = 1.1  # second half over first half of an episode: more is growth
KINDS = ("states", "inputs")


def show_unknown_input_claims(data: dict[str, Any]) -> PieceResult:
    """The paper's figures, a table of other filters, and the claims about both."""
    columns = ("rate in %", "MSE of the states", "MSE of the inputs")
    numbers = []
    for example in EXAMPLES:
        mse, rates = data[f"{example}_mse"], data[f"{example}_rates"]
        for place, setting in enumerate(data["settings"]):
            samples = (100.0 * rates[place].mean(0), *mse[place])
            numbers += [
                Number.of(f"{NAMES[example]}, {setting}: {column}", sample)
                for column, sample in zip(columns, samples, strict=True)
            ]
    powers = {e: data[f"{e}_power"].mean(-1) for e in EXAMPLES}
    own = "; ".join(f"{NAMES[e]} {powers[e][0]:.3g} and {powers[e][1]:.3g}" for e in EXAMPLES)
    return PieceResult(
        pictures=unknown_input_pictures(data),
        tables=[
            NumbersTable(
                "settings",
                "Fused errors under several filters and triggers",
                numbers,
                f"Mean squares of the states and inputs themselves: {own}. Carts in SI units.",
                columns,
            )
        ],
        claims=[*_tracking(data), *_theorems(data), *_saving(data)],
    )


def _relative(data: dict[str, Any], example: str, block: int, setting: str = OURS) -> Array:
    """Fused squared errors (E,) over the mean square of what is estimated."""
    mse = data[f"{example}_mse"][data["settings"].index(setting), block]
    return mse / data[f"{example}_power"][block].mean()


def _tracking(data: dict[str, Any]) -> list[Claim]:
    claims = []
    for block, (text, figure) in enumerate(
        (
            ("The state estimates accurately track the true states.", "Figure 1"),
            ("The input estimates accurately track the true inputs.", "Figure 2"),
        )
    ):
        ours, carts = (estimate(_relative(data, e, block)) for e in EXAMPLES)
        walk = estimate(_relative(data, PRINTED, block, WALK))
        claims.append(
            Claim(
                text,
                f"Section 4, {figure}",
                verdict([ours.high < _TRACKED]),
                f"Fused squared error over the mean square of the {KINDS[block]}: {cite(ours)} on "
                f"the printed example, {cite(carts)} on the carts (we call less than {_TRACKED:g} "
                "accurate). A Kalman filter with a random-walk input reaches "
                f"{cite(walk)} on the printed example with the same packets.",
            )
        )
    return claims


def _theorems(data: dict[str, Any]) -> list[Claim]:
    under = {e: (data[f"{e}_square"] <= data[f"{e}_bound"]).mean() for e in EXAMPLES}
    filled = {e: data[f"{e}_filled"] for e in EXAMPLES}
    tops = {
        e: [[estimate(sample) for sample in place] for place in each] for e, each in filled.items()
    }
    nodes = {e: max(t.high for place in tops[e][1:] for t in place) for e in EXAMPLES}
    fused = {e: max(t.high for t in tops[e][0]) for e in EXAMPLES}
    radius = {e: float(data[f"{e}_radius"].max()) for e in EXAMPLES}
    growth = {e: estimate(_growth(data[f"{e}_steady"])) for e in EXAMPLES}
    ranges = {e: data[f"{e}_rho_range"] for e in EXAMPLES}
    settled = {e: estimate(data[f"{e}_settled"]) for e in EXAMPLES}
    return [
        Claim(
            "The MSE lies below the trace of the minimum upper bound.",
            "Section 4, Figures 3 to 6",
            verdict(share == 1.0 for share in under.values()),
            "At "
            + by_example({e: percent(float(under[e])) for e in EXAMPLES})
            + " of all instants, entries and estimates.",
        ),
        Claim(
            "Ξ bounds the error covariances of every node, in the form that our filter computes.",
            "Theorem 1",
            verdict(each <= 1.0 for each in nodes.values()),
            "Mean squared errors whitened with Ξ, in their largest direction (1 is the bound), at "
            "most " + by_example({e: f"{nodes[e]:.2g}" for e in EXAMPLES}) + ".",
        ),
        Claim(
            "The fused estimate is consistent.",
            "Theorem 4, (26)",
            verdict(each <= 1.0 for each in fused.values()),
            "The same of the fused estimate, at most "
            + by_example({e: f"{fused[e]:.2g}" for e in EXAMPLES})
            + ".",
        ),
        Claim(
            "The filtering error is bounded in mean square.",
            "Theorem 3",
            verdict(
                [each.low <= _GROWN for each in growth.values()]
                + [each < 1.0 for each in radius.values()]
            ),
            "Fused squared error in the second half of the episodes over that in the first: "
            + by_example({e: cite(growth[e]) for e in EXAMPLES})
            + "; the error's largest spectral radius, √(1 + ε) included, is "
            + by_example({e: f"{radius[e]:.2g}" for e in EXAMPLES})
            + ". (The theorem's own condition (23) is met by all positive numbers.)",
        ),
        Claim(
            "The threshold increases monotonically between ρ(0) and ρ̄.",
            "Lemma 2",
            verdict(
                least >= 0.0 and low >= 1.0 and high <= 1.0 for least, low, high in ranges.values()
            ),
            "Its least change is "
            + by_example({e: f"{ranges[e][0]:.2g}" for e in EXAMPLES})
            + ". So it adapts once: every threshold is within 1 % of ρ̄ after "
            + by_example({e: cite(settled[e], 2) for e in EXAMPLES})
            + " instants of an episode.",
        ),
        Claim(
            "Whatever is not transmitted differs from the last transmission by at most ρ̄.",
            "(5), (6), Lemma 2",
            verdict(data[f"{e}_kept"] == 1.0 for e in EXAMPLES),
            "In "
            + by_example({e: percent(data[f"{e}_kept"]) for e in EXAMPLES})
            + " of all silent instants.",
        ),
    ]


def _growth(steady: Array) -> Array:
    return steady[1] / steady[0].mean()


def _saving(data: dict[str, Any]) -> list[Claim]:
    ours, fixed = (data["settings"].index(name) for name in (OURS, FIXED))
    rates = {e: data[f"{e}_rates"][ours] for e in EXAMPLES}
    every = {e: [cite(estimate(100.0 * each)) for each in rates[e]] for e in EXAMPLES}
    constant = {e: cite(estimate(100.0 * data[f"{e}_rates"][fixed].mean(0))) for e in EXAMPLES}
    adaptive = {e: cite(estimate(100.0 * rates[e].mean(0))) for e in EXAMPLES}
    better, evidence = [], []
    for example in EXAMPLES:
        each = data[f"{example}_each"]
        for block, kind in enumerate(KINDS):
            fused, nodes = each[0, block], each[1:, block]
            better += [below(fused, node) for node in nodes]
            best = nodes[nodes.mean(-1).argmin()]
            evidence.append(
                f"{NAMES[example]}, {kind}: {cite(estimate(fused))}, best node "
                f"{cite(estimate(best))}"
            )
    return [
        Claim(
            "Fusion by covariance intersection improves the estimates.",
            "Section 1 (contribution 4), Section 3.3",
            verdict(better),
            f"The fused squared error lies below a node's in {sum(better)} of {len(better)} "
            f"comparisons. Of {'; of '.join(evidence)}.",
        ),
        Claim(
            "The trigger significantly reduces the transmissions.",
            "Remark 3, Figure 7",
            verdict(estimate(each).high < _FEW for each in rates[PRINTED]),
            "Rates in %: "
            + by_example({e: ", ".join(every[e]) for e in EXAMPLES})
            + ". On average "
            + by_example(adaptive)
            + ", where a fixed threshold, ρ(0) = ρ̄, has "
            + by_example(constant)
            + ".",
        ),
    ]


def by_example(texts: dict[str, str]) -> str:
    """A text of each example."""
    return f"{texts[PRINTED]} (printed example) and {texts[CARTS]} (carts)"
