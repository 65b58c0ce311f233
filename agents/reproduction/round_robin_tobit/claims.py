"""The claims of Lemma 1, the theorems and the remarks of round_robin_tobit, and their numbers."""

from typing import Any

import numpy as np

from fusion_gym.arrays import Array
from fusion_gym.evaluation.intervals import mean_interval

from ..judging import cite, estimate, percent, verdict
from ..piece_result import Claim, Number, NumbersTable, PieceResult
from .runs import resampled
from .theory import EXAMPLES, PLACES, SHARES, SURE

_CLEAR = 4.0  # standard errors
_CONSISTENT = 0.05  # deviation of NEES from 1


def show_round_robin_claims(data: dict[str, Any]) -> PieceResult:
    """Claims of Lemma 1, Theorems 1 and 2 and the remarks, with the numbers behind them."""
    claims = [*_lemma_claims(data), *_filter_claims(data), *_fusion_claims(data)]
    numbers = [
        Number.of("NEES of the fused estimate, oscillator", data["oscillator_nees"]),
        Number.of("NEES of the fused estimate, target", data["target_nees"]),
        Number.of("share of uncensored packets, predicted by (9)", data["oscillator_predicted"]),
        Number.of("share of uncensored packets, simulated", data["oscillator_uncensored"]),
    ]
    note = (
        "NEES is the squared error in units of the claimed covariance, over the number of states: "
        "1 for a filter that is as good as it claims."
    )
    return PieceResult(
        tables=[NumbersTable("theory", "What the filter believes", numbers, note)], claims=claims
    )


def _lemma_claims(data: dict[str, Any]) -> list[Claim]:
    def clear(value: str, against: str, error: str) -> Array:
        return np.abs(data[value] - data[against]) > _CLEAR * np.maximum(data[error], 1e-12)

    right = clear("mean", "equation_12", "mean_error")
    printed = clear("mean", "equation_12_printed", "mean_error")
    values = clear("variance", "equation_13", "variance_error")
    total = clear("variance", "total_variance", "variance_error")
    worst = int(np.argmax(np.abs(data["mean"] - data["equation_12_printed"])))
    most = int(np.argmax(np.abs(data["variance"] - data["equation_13"])))
    ends = data["equation_12_printed"]
    return [
        Claim(
            "(12) is the mean of a censored measurement",
            "Lemma 1",
            verdict([not printed.any(), not right.any()]),
            f"at {len(right)} values of x1, simulated means differ clearly at {int(printed.sum())} "
            f"with ϑ over R as printed (x1 = {PLACES[worst]:g}: {data['mean'][worst]:.4f}, by "
            f"(12) {ends[worst]:.4f}), and at {int(right.sum())} with ϑ over √R, as (16) "
            "and (17) imply",
        ),
        Claim(
            "(13) is the variance of a censored measurement",
            "Lemma 1",
            verdict([not values.any()]),
            f"simulated variances differ clearly from it at {int(values.sum())} of {len(values)} "
            f"values of x1 (x1 = {PLACES[most]:g}: {data['variance'][most]:.4g}, by (13) "
            f"{data['equation_13'][most]:.4g}): it is the variance given that nothing is censored. "
            f"They differ at {int(total.sum())} from the law of total variance, which in the place "
            "of (13) lets the filter diverge",
        ),
    ]


def _filter_claims(data: dict[str, Any]) -> list[Claim]:
    predicted, free = data["oscillator_predicted"], data["oscillator_uncensored"]
    gap = estimate(predicted - free)
    claimed, out = data["oscillator_sure"].sum(), data["oscillator_surprised"].sum()
    nees, plain = estimate(data["oscillator_nees"]), estimate(data["target_nees"])
    better = mean_interval(data["mse_adf"] - data["mse_paper"])
    weights = resampled(len(predicted))
    correlation = {
        name: (weights @ data[f"{name}_product"])
        / np.sqrt((weights @ data[f"{name}_first"]) * (weights @ data[f"{name}_second"]))
        for name in ("oscillator", "target")
    }
    ends = {name: np.quantile(value, [0.025, 0.5, 0.975]) for name, value in correlation.items()}
    return [
        Claim(
            "(9) approximates the censoring probabilities",
            "Section II, (9)",
            verdict([abs(gap.mean) < 0.05, out < 2.0 * claimed]),
            f"predicted minus simulated share of uncensored packets: {cite(gap)}; but where it "
            f"gives them less than {percent(SURE)}, on average they come "
            f"{out / claimed:.3g} times as often as it says, for (9) leaves the prediction's own "
            "error out",
        ),
        Claim(
            "(21) is the covariance of the error",
            "Theorem 1",
            verdict([abs(nees.mean - 1) < _CONSISTENT, abs(plain.mean - 1) < _CONSISTENT]),
            f"NEES {cite(nees)} in the oscillator, {cite(plain)} in the target (1 if so)",
        ),
        Claim(
            "The local estimate is E{ξ | y}, of least error",
            "Theorem 1, Section III",
            verdict([better.low > 0.0]),
            "the assumed-density filter, on the same packets, has a squared error of "
            f"{data['mse_adf'].mean():.3g} instead of {data['mse_paper'].mean():.3g} (difference "
            f"{cite(better)})",
        ),
        Claim(
            "Errors of the prediction are uncorrelated in time (supposed)",
            "Proof of Theorem 1; (42) needs it, though it prints ≠ 0",
            verdict(ends[name][0] < 0.0 < ends[name][2] for name in ends),
            "correlation of the bias's prediction errors at successive steps: "
            + ", ".join(
                f"{end[1]:.2f} [{end[0]:.2f}, {end[2]:.2f}] in the {name}"
                for name, end in ends.items()
            )
            + ". Harmless under the round robin: where it would matter (24) has gain zero",
        ),
    ]


def _fusion_claims(data: dict[str, Any]) -> list[Claim]:
    ignored = mean_interval(data["mse_kalman"] - data["mse_paper"])
    worse = [
        first / other for first, other in zip(data["armse_paper"], data["armse_free"], strict=True)
    ]
    calmer = [
        first / other for first, other in zip(data["armse_paper"], data["armse_calm"], strict=True)
    ]
    return [
        Claim(
            "Federated fusion is the global optimum of the local estimates",
            "Lemma 2, Theorem 2",
            verdict([data["shares_gap"] < 1e-6]),
            "with one packet a step it is the centralised Tobit filter whatever the shares ε: with "
            f"{' and '.join(str(share) for share in SHARES[1:])} no estimate moves by more than "
            f"{data['shares_gap']:.1g} from that with {SHARES[0]}",
        ),
        Claim(
            "Without bias and round robin it is the usual Tobit filter",
            "Remark 6",
            verdict([data["without_gap"] < 1e-9]),
            "with B = 0 and all packets at every step, its estimates of x differ by "
            f"{data['without_gap']:.1g} from those of the filter that has no bias in its model",
        ),
        Claim(
            "Censored observations, inadequately handled, impair the performance",
            "Section I",
            verdict([ignored.low > 0.0]),
            f"the Kalman filter that ignores censoring has a squared error of "
            f"{data['mse_kalman'].mean():.3g}, the Tobit filter {data['mse_paper'].mean():.3g} "
            f"(difference {cite(ignored)})",
        ),
        Claim(
            "FTKF is insensitive to dynamical biases and censored observations",
            "Section I",
            verdict([max(worse) < 1.1, max(calmer) < 1.1]),
            f"censoring at ±5 makes ARMSE1, 2, 3 {_times(worse)} times as large; a bias noise of "
            f"Ξ = 0.25 instead of 0.0025 makes them {_times(calmer)} times as large",
        ),
    ]


def _times(values: list[float]) -> str:
    return ", ".join(f"{value:.2g}" for value in values)


def show_bounds(data: dict[str, Any]) -> PieceResult:
    """How often the bounds fail, by reading, and the verdicts on Theorems 4 and 5."""
    numbers = [
        Number.of(f"{_spoken(name)}: {env}", 100 * data[f"{env}:{name}"], unit="%")
        for name in (key.partition(":")[2] for key in data if key.startswith("oscillator:"))
        for env in EXAMPLES
    ]
    note = (
        "Steps in which a bound minus the covariance, or the other way round, has a negative "
        "eigenvalue. Theorem 4 for the filter of one sensor by itself, whose covariance is (46); "
        "Theorem 5 for the nodes of Table I, with Q/ε. Readings of the upper bound: as printed; "
        "the sign of φ as in (15); the bound itself in its own correction, where the text prints "
        "P; both. Of the lower: as printed; with its factor at the turns of the sensor alone; with "
        "the factor of the process covariance that (49) has."
    )
    claims = [
        _bound_claim(data, "4/upper", "P^u is an upper bound on a local filter's covariance",
                     "Theorem 4"),
        _bound_claim(data, "4/lower", "P^l is a lower bound on a local filter's covariance",
                     "Theorem 4"),
        _bound_claim(data, "5/upper", "The joined P^u is an upper bound on the fused covariance",
                     "Theorem 5"),
        _bound_claim(data, "5/lower", "The joined P^l is a lower bound on the fused covariance",
                     "Theorem 5"),
    ]  # fmt: skip
    heads = tuple(EXAMPLES)
    table = NumbersTable("bounds", "Steps in which a bound fails", numbers, note, heads)
    return PieceResult(tables=[table], claims=claims)


def _bound_claim(data: dict[str, Any], start: str, text: str, source: str) -> Claim:
    """It holds if it does as printed; partly if it does in some reading."""
    by: dict[str, list[float]] = {}
    for env in EXAMPLES:
        worst: dict[str, float] = {}
        for key, sample in data.items():
            if key.startswith(f"{env}:{start}/"):
                reading = key.split("/")[2]
                worst[reading] = max(worst.get(reading, 0.0), float(np.mean(sample)))
        for reading, share in worst.items():
            by.setdefault(reading, []).append(share)
    best = min(by, key=lambda reading: sum(by[reading]))
    words = f"as printed it fails in {_shares(by['as printed'])}"
    if best != "as printed":
        words += f"; of {len(by)} readings *{best}* fails least, in {_shares(by[best])}"
    if start.startswith("4"):
        words += " (each at the worse sensor)"
    held = [max(by["as printed"]) == 0.0, max(by[best]) == 0.0]
    return Claim(text, source, verdict(held), words)


def _shares(values: list[float]) -> str:
    text = [f"{percent(value)} ({name})" for value, name in zip(values, EXAMPLES, strict=True)]
    return f"{', '.join(text)} of the steps"


def _spoken(name: str) -> str:
    theorem, end, *rest = name.split("/")
    sensor = f", sensor {int(rest[-1]) + 1}" if theorem == "4" else ""
    return f"Theorem {theorem}, {end} bound, {rest[0]}{sensor}"
