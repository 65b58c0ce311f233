"""What the paper on filters with unknown inputs claims.

Source: unknown_input, Section 4.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np

from agents.papers.claims import Claim, Claims
from agents.papers.numbers import always, below, cite, percent

claims = Claims()
OURS, FIXED, WALK = 0, 1, 4  # filters and triggers of the page's table
ACCURATE, FEW = 0.1, 0.5  # squared error over mean square, rate
GROWTH = 1.1  # squared error in the second half of the episodes over that in the first


def _both(values: Iterable[Any], form: str = "") -> str:
    """Write a number of the printed example and one of the carts."""
    printed, carts = values
    return f"{printed:{form}} (printed example) and {carts:{form}} (carts)"


# --- errors and bounds ----------------------------------------------------------------------------


def _tracks(kind: str, place: int, filters: Any) -> Any:
    pairs = zip(filters.mse, filters.power, strict=True)
    printed, carts = (mse[:, place] / power[place].mean() for mse, power in pairs)
    return below(printed[OURS], ACCURATE), (
        f"Fused squared error over the mean square of the {kind}s: {cite(printed[OURS])} on the "
        f"printed example, {cite(carts[OURS])} on the carts (we call less than {ACCURATE} "
        f"accurate). A Kalman filter with a random-walk input reaches {cite(printed[WALK])} on the "
        "printed example with the same packets."
    )


for place, kind in enumerate(("state", "input")):
    text, source = f"The {kind} estimates accurately track the true {kind}s.", "Section 4, Figure"
    claims.append(Claim(text, f"{source} {place + 1}", partial(_tracks, kind, place)))


@claims.add("Section 4, Figures 3 to 6")
def _(filters: Any) -> Any:
    """The MSE lies below the trace of the minimum upper bound."""
    shares = [(s <= b).mean() for s, b in zip(filters.square, filters.bound, strict=True)]
    return np.equal(shares, 1), (
        f"At {_both(map(percent, shares))} of all instants, entries and estimates."
    )


@claims.add("Theorem 1")
def _(filters: Any) -> Any:
    """Ξ bounds the error covariances of every node, in the form that our filter computes."""
    largest = [own[1:].max() for own in filters.filled]
    return np.less_equal(largest, 1), (
        "Mean squared errors whitened with Ξ, in their largest direction (1 is the bound), at most "
        f"{_both(largest, '.2g')}."
    )


@claims.add("Theorem 4, (26)")
def _(filters: Any) -> Any:
    """The fused estimate is consistent."""
    largest = [own[0] for own in filters.filled]
    return np.less_equal(largest, 1), (
        f"The same of the fused estimate, at most {_both(largest, '.2g')}."
    )


@claims.add("Theorem 3")
def _(filters: Any) -> Any:
    """The filtering error is bounded in mean square."""
    growth = [last / first.mean() for first, last in filters.steady]
    radius = [own.max() for own in filters.radius]
    return [*(below(own, GROWTH) for own in growth), np.less(radius, 1)], (
        "Fused squared error in the second half of the episodes over that in the first: "
        f"{_both(map(cite, growth))}; the error's largest spectral radius, √(1 + ε) included, is "
        f"{_both(radius, '.2g')}. (The theorem's own condition (23) is met by all positive "
        "numbers.)"
    )


# --- the trigger and the fusion -------------------------------------------------------------------


@claims.add("Lemma 2")
def _(filters: Any) -> Any:
    """The threshold increases monotonically between ρ(0) and ρ̄."""
    changes, low, high = zip(*filters.rho_range, strict=True)
    settled = _both(cite(own, 2) for own in filters.settled)
    return [min(changes) >= 0, min(low) >= 1, max(high) <= 1], (
        f"Its smallest change is {_both(changes, '.2g')}. So it adapts once: every threshold is "
        f"within 1 % of ρ̄ after {settled} instants of an episode."
    )


@claims.add("(5), (6), Lemma 2")
def _(filters: Any) -> Any:
    """A measurement without transmission differs from the last transmission by at most ρ̄."""
    return always(filters.within, filters.episodes), (
        f"In {_both(map(percent, filters.within))} of all silent instants."
    )


@claims.add("Section 1 (contribution 4), Section 3.3")
def _(filters: Any) -> Any:
    """Fusion by covariance intersection improves the estimates."""
    better = np.concatenate([below(own[0], own[1:]).ravel() for own in filters.each])
    errors = "; of ".join(
        f"{name}, {kind}: {cite(own[0, place])}, best node {cite(min(own[1:, place], key=np.mean))}"
        for name, own in zip(filters.names, filters.each, strict=True)
        for place, kind in enumerate(("states", "inputs"))
    )
    return better, (
        f"The fused squared error lies below a node's in {(better == 1).sum()} of {better.size} "
        f"comparisons. Of {errors}."
    )


@claims.add("Remark 3, Figure 7")
def _(filters: Any) -> Any:
    """The trigger significantly reduces the transmissions."""
    rates = [100 * own[OURS] for own in filters.rates]
    mean, fixed = (
        _both(cite(100 * own[lane].mean(0)) for own in filters.rates) for lane in (OURS, FIXED)
    )
    return below(filters.rates[0][OURS], FEW), (
        f"Rates in %: {_both(map(cite, rates))}. On average {mean}, where a fixed threshold, "
        f"ρ(0) = ρ̄, has {fixed}."
    )


# --- the printed recursion, whose first reading is the exact one ----------------------------------


@claims.add("(3), (4), (13)")
def _(printed: Any) -> Any:
    """The lifted system of (3) and (4) can meet the decoupling condition (13)."""
    return printed.rank == printed.columns, (
        f"With ℬ as printed, C ℬ has {printed.columns} columns and rank {printed.rank}: no L makes "
        "L C ℬ the identity. With the input held over a sampling interval it can."
    )


@claims.add("(14), (16)")
def _(printed: Any) -> Any:
    """Under (13) the input does not enter the estimation error."""
    residual = max(printed.hidden[0])
    return residual < 1e-6, (
        f"With the input held: the largest entry of ℬ - N C ℬ is {residual:.1g}, the rounding in "
        "(20) set to zero."
    )


@claims.add("Theorem 1, (18)")
def _(printed: Any) -> Any:
    """(18) as printed, with its factor 1 - 2δ, bounds the error covariance."""
    errors, bounds = printed.node[0, :, 0], printed.trace[0]
    pairs = zip(errors.mean(-1), bounds.mean(-1), strict=True)
    traces = ", ".join(f"{error:.3g} under {bound:.3g}" for error, bound in pairs)
    tighter = 100 * (printed.silent.mean(-1) / printed.sent.mean(-1) - 1)
    return [below(errors, bounds), printed.negative == 0], (
        f"On the printed example the squared errors lie below its trace ({traces} by node). But "
        f"the bound is smaller when nothing is sent ({', '.join(f'{x:.1f} %' for x in tighter)}), "
        f"and with ρ̄ = {printed.small:g} it is indefinite in {percent(printed.negative)} of the "
        "silent instants."
    )


@claims.add("Theorem 2")
def _(printed: Any) -> Any:
    """The gains (19) and (20) minimise the bounds."""
    excess = printed.excess.mean(-1)
    return abs(excess) < 1e-6, (
        "The trace of (18) exceeds the trace for the best gain under (14) by "
        f"{_both(f'{100 * own:.3g} %' for own in excess)}; on the printed example (14) allows one "
        "gain only."
    )
