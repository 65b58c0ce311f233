"""What the paper on federated Tobit filters under the round robin claims.

Source: round_robin_tobit.
"""

from collections import defaultdict
from functools import partial
from typing import Any

import numpy as np

from agents.papers.claims import MISPRINT, Claim, Claims
from agents.papers.numbers import above_zero, always, below, by_mean, cite, number_text, percent
from agents.papers.round_robin_tobit_runs import CLEAR, always_below, resampled
from agents.papers.round_robin_tobit_theorems import BOUNDS, EXAMPLES, PLACES, SHARES, SURE
from fusion_gym.evaluation.metrics import Interval

claims = Claims()
PRECISE = 0.9  # share of the open-loop variance that an estimate which tracks precisely explains
SATISFACTORY = 1.5  # times the least error that any filter can have
CONSISTENT = 0.05  # deviation of NEES from 1

# --- the simulations ------------------------------------------------------------------------------


@claims.add("Section IV.A, Figs. 3 and 4")
def _(oscillator: Any) -> Any:
    """FTKF-DB tracks states and bias precisely.

    It explains {explained:%} of the open-loop variance of x1, x2, b (precise: 90 % or more)
    """
    explained = _explained(oscillator, "aware")
    return explained >= PRECISE, locals()


@claims.add("Section IV.A, Figs. 3 and 4")
def _(oscillator: Any) -> Any:
    """FTKF deviates considerably and cannot track the bias.

    It explains {explained:%} of the open-loop variance of x1, x2, b
    """
    explained = _explained(oscillator, "unaware")
    return [explained[:2] < PRECISE, explained[2] < 0.05], locals()


@claims.add("Section IV.A, Fig. 5")
def _(oscillator: Any) -> Any:
    """RMSE1 and RMSE2 of FTKF-DB are always smaller than with FTKF.

    Of 2 states at every step it is {often}
    """
    outcome, often = always_below(oscillator.difference[..., :2])
    return outcome, locals()


@claims.add("Section IV.A, Fig. 6")
def _(oscillator: Any) -> Any:
    """RMSE3 of FTKF-DB is within a satisfactory range.

    {text}
    """
    return _satisfactory(oscillator)


def _fused(states: slice, nodes: Any) -> Any:
    higher, texts = defaultdict(list), []
    for reading, name in (("single filters", "single"), ("nodes of Table I", "node")):
        texts.append(f"{reading[0].upper()}{reading[1:]}:")
        for i in range(2):
            ends = nodes[f"{name}_{i}_increase"]
            mean, low, high = (ends[end][states] for end in ("mean", "low", "high"))
            higher[reading].append(above_zero(low, high))
            rise = cite(list(map(Interval, mean, low, high)))
            _, often = always_below(nodes[f"{name}_{i}_difference"][..., states])
            texts.append(f"S{i + 1}'s ARMSE is larger by {rise}; the fused is {often}.")
    return higher, {"text": " ".join(texts)}


for _quantity, _figure, _states in (
    ("states", "Fig. 7", slice(2)), ("bias", "Figs. 8 and 9", slice(2, 3)),
):  # fmt: skip
    _text = f"The fused filter outperforms both local ones in the {_quantity}."
    claims.append(Claim(_text, f"Section IV.A, {_figure}", "{text}", partial(_fused, _states)))


@claims.add("Section IV.A, Table II")
def _(tables: Any) -> Any:
    """The narrower the censoring interval, the larger the error of states and bias.

    {text}
    """
    return _moves(tables.table_2, 1)


@claims.add("Section IV.A, Table III")
def _(tables: Any) -> Any:
    """The smaller the noise variance R, the smaller the error of states and bias.

    {text}
    """
    return _moves(tables.table_3, -1)


@claims.add("Section IV.B, Fig. 10")
def _(target: Any) -> Any:
    """RMSE of position and velocity of FTKF-DB are always smaller than with FTKF.

    Of 2 states at every step it is {often}
    """
    outcome, often = always_below(target.difference[..., :2])
    return outcome, locals()


@claims.add("Section IV.B, Fig. 11")
def _(target: Any) -> Any:
    """The bias's RMSE is within a satisfactory range.

    {text}
    """
    return _satisfactory(target)


@claims.add("Theorem 2, Section IV.B")
def _(target: Any) -> Any:
    """The fused estimate is the global optimum (nothing censored).

    ARMSE over the Riccati equation's, for this order of transmissions: {ratio:.3g}
    """
    ratio = _ratio(target, "aware", "floor")
    return np.abs(ratio - 1) < 0.03, locals()


# --- Lemma 1, Theorems 1 and 2, remarks -----------------------------------------------------------


@claims.add("Lemma 1")
def _(theory: Any) -> Any:
    """(12) is the mean of a censored measurement.

    At {count} values of x1, simulated means differ clearly at {printed} with ϑ over R as
    printed (x1 = {place:g}: {mean:.4f}, by (12) {claimed:.4f}), and at {right} with ϑ over
    √R, as (16) and (17) imply
    """
    (right, _), (printed, i) = (
        _differences(theory, "mean", f"equation_12{end}") for end in ("", "_printed")
    )
    count, place, mean = len(PLACES), PLACES[i], theory.mean[i]
    claimed = theory.equation_12_printed[i]
    return MISPRINT if right == 0 < printed else always(printed == 0, theory.episodes), locals()


@claims.add("Lemma 1")
def _(theory: Any) -> Any:
    """(13) is the variance of a censored measurement.

    Simulated variances differ clearly from it at {count} of {places} values of x1 (x1 =
    {place:g}: {variance:.4g}, by (13) {claimed:.4g}): it is the variance conditional on no
    censoring. They differ at {total} from the law of total variance; with that law in the place
    of (13) the filter diverges
    """
    (count, i), (total, _) = (
        _differences(theory, "variance", name) for name in ("equation_13", "total_variance")
    )
    places, place = len(PLACES), PLACES[i]
    variance, claimed = theory.variance[i], theory.equation_13[i]
    return always(count == 0, theory.episodes), locals()


@claims.add("Section II, (9)")
def _(theory: Any) -> Any:
    """(9) approximates the censoring probabilities.

    Predicted minus simulated share of uncensored packets: {gap}; but where (9) predicts less
    than {sure:%}, on average they occur {times:.3g} times as often, because (9) neglects the
    prediction's error
    """
    gap = theory.oscillator_predicted - theory.oscillator_uncensored
    sure, times = SURE, theory.oscillator_surprised.sum() / theory.oscillator_sure.sum()
    return [abs(gap.mean()) < 0.05, times < 2], locals()


@claims.add("Theorem 1")
def _(theory: Any) -> Any:
    """(21) is the covariance of the error.

    NEES {theory.oscillator_nees} in the oscillator, {theory.target_nees} in the target (1 if so)
    """
    nees = theory.oscillator_nees, theory.target_nees
    return [abs(own.mean() - 1) < CONSISTENT for own in nees]


@claims.add("Theorem 1, Section III")
def _(theory: Any) -> Any:
    """The local estimate is E{ξ | y}, of least error.

    The assumed-density filter, on the same packets, has a squared error of {means[1]:.3g}
    instead of {means[0]:.3g} (difference {difference})
    """
    means, difference = _difference(theory.mse_paper, theory.mse_adf)
    return below(theory.mse_paper, theory.mse_adf), locals()


@claims.add("Proof of Theorem 1; (42) needs it, though it prints ≠ 0")
def _(theory: Any) -> Any:
    """Errors of the prediction are uncorrelated in time (supposed).

    Correlation of the bias's prediction errors at successive steps: {values}. This has no
    effect under the round robin: where it would matter (24) has gain zero
    """
    weights, conditions, texts = resampled(theory.episodes), [], []
    for name in ("oscillator", "target"):
        parts = (weights @ theory[f"{name}_{part}"] for part in ("product", "first", "second"))
        product, first, second = parts
        low, median, high = np.quantile(product / np.sqrt(first * second), [0.025, 0.5, 0.975])
        conditions.append(low < 0 < high)
        texts.append(f"{median:.2f} [{low:.2f}, {high:.2f}] in the {name}")
    values = ", ".join(texts)
    return conditions, locals()


@claims.add("Lemma 2, Theorem 2")
def _(theory: Any) -> Any:
    """Federated fusion is the global optimum of the local estimates.

    With one packet per step it is the centralised Tobit filter for all shares ε: with
    {shares[1]} and {shares[2]} no estimate differs by more than {theory.shares_gap:.1g} from the
    estimate with {shares[0]}
    """
    shares = [*map(str, SHARES)]
    return theory.shares_gap < 1e-6, locals()


@claims.add("Remark 6")
def _(theory: Any) -> Any:
    """Without bias and round robin it is the usual Tobit filter.

    With B = 0 and all packets at every step, its estimates of x differ by
    {theory.without_gap:.1g} from the estimates of the filter without a bias
    """
    return theory.without_gap < 1e-9


@claims.add("Section I")
def _(theory: Any) -> Any:
    """Censored observations, inadequately handled, impair the performance.

    The Kalman filter that ignores censoring has a squared error of {means[1]:.3g}, the Tobit
    filter {means[0]:.3g} (difference {difference})
    """
    means, difference = _difference(theory.mse_paper, theory.mse_kalman)
    return below(theory.mse_paper, theory.mse_kalman), locals()


@claims.add("Section I")
def _(theory: Any) -> Any:
    """FTKF is insensitive to dynamical biases and censored observations.

    Censoring at ±5 makes ARMSE1, 2, 3 {worse:.2g} times as large; a bias noise of Ξ = 0.25
    instead of 0.0025 makes them {calmer:.2g} times as large
    """
    worse, calmer = (
        np.divide(theory.armse_paper, theory[f"armse_{name}"]) for name in ("free", "calm")
    )
    return [worse < 1.1, calmer < 1.1], locals()


# --- the bounds of Theorems 4 and 5 ---------------------------------------------------------------


def _bound(theorem: int, end: str, bounds: Any) -> Any:
    shares = bounds.shares.mean(-1)
    worst = shares[:, :2].max(1) if theorem == 4 else shares[:, 2]
    by_reading = {row[1]: own for row, own in zip(BOUNDS, worst.T, strict=True) if row[0] == end}

    def steps(reading: str) -> str:
        parts = zip(map(percent, by_reading[reading]), EXAMPLES, strict=True)
        return f"{', '.join(f'{share} ({name})' for share, name in parts)} of the steps"

    best = min(by_reading, key=lambda reading: by_reading[reading].sum())
    text = f"As printed it fails in {steps('as printed')}"
    if best != "as printed":
        text += f"; of {len(by_reading)} readings *{best}* fails least, in {steps(best)}"
    text += " (each at the worse sensor)" * (theorem == 4)
    return {name: always(1 - own, bounds.episodes) for name, own in by_reading.items()}, locals()


for _theorem, _start, _owner in ((4, "", "a local filter's"), (5, "The joined ", "the fused")):
    for _sign, _article, _end in (("u", "an", "upper"), ("l", "a", "lower")):
        _text = f"{_start}P^{_sign} is {_article} {_end} bound on {_owner} covariance."
        _test = partial(_bound, _theorem, _end)
        claims.append(Claim(_text, f"Theorem {_theorem}", "{text}", _test))


def _ratio(piece: Any, name: str, other: str) -> Any:
    return np.divide(piece[f"{name}_armse"]["mean"], piece[other])


def _explained(oscillator: Any, name: str) -> Any:
    return (1 - _ratio(oscillator, name, "silent") ** 2).clip(0)


def _difference(own: Any, other: Any) -> Any:
    """Return both means, and the paired difference."""
    return (own.mean(), other.mean()), other - own


def _satisfactory(piece: Any) -> Any:
    least, silent = (_ratio(piece, "aware", other)[2] for other in ("floor", "silent"))
    text = (
        f"Its mean over time is {least:.3g} times the smallest error of any filter (satisfactory: "
        f"below {SATISFACTORY}), and {silent:.2g} times the error without measurements"
    )
    return by_mean(least < SATISFACTORY, piece.episodes), locals()


def _moves(rows: Any, sign: int) -> Any:
    """Judge which errors change from row to row as claimed: ARMSE and the median."""

    def change(name: str) -> Any:
        ends = ([row[name]["rise"][end] for row in rows[1:]] for end in ("low", "high")[::sign])
        return above_zero(*((sign * np.array(rises)).min(0) for rises in ends))

    ours, other = change("paper"), change("adf")
    chain = " → ".join(f"({number_text(row['paper']['mean'])})" for row in rows)
    medians = " → ".join(f"{row['paper']['median'][0]:.3g}" for row in rows)
    text = (
        f"From row to row of the table, {(ours[:3] == 1).sum()} of 3 ARMSE of the paper's filter "
        f"move as claimed, beyond chance: {chain}; the median run's RMSE of x1 "
        f"{'does' if ours[3] == 1 else 'does not'}: {medians}. Of the assumed-density filter "
        f"{(other[:3] == 1).sum()} of 3 do"
    )
    return ours, locals()


def _differences(theory: Any, own: str, other: str) -> Any:
    """Return at how many values of x1 both differ clearly, and where they do most."""
    gap = np.abs(theory[own] - theory[other])
    clear = gap > CLEAR * np.maximum(theory[f"{own}_error"], 1e-12)
    return clear.sum(), gap.argmax()
