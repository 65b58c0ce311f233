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


def _tracks(place: int, filters: Any) -> Any:
    pairs = zip(filters.mse, filters.power, strict=True)
    printed, carts = (mse[:, place] / power[place].mean() for mse, power in pairs)
    ours, walk, accurate = printed[OURS], printed[WALK], ACCURATE
    return below(ours, accurate), locals()


for _place, _kind in enumerate(("state", "input")):
    _text = f"The {_kind} estimates accurately track the true {_kind}s."
    _evidence = (
        f"Fused squared error over the mean square of the {_kind}s: {{ours}} on the printed "
        "example, {carts[0]} on the carts (we call less than {accurate} accurate). A Kalman filter "
        "with a random-walk input reaches {walk} on the printed example with the same packets."
    )
    _source = f"Section 4, Figure {_place + 1}"
    claims.append(Claim(_text, _source, _evidence, partial(_tracks, _place)))


@claims.add("Section 4, Figures 3 to 6")
def _(filters: Any) -> Any:
    """The MSE lies below the trace of the minimum upper bound.

    At {both} of all instants, entries and estimates.
    """
    shares = [(s <= b).mean() for s, b in zip(filters.square, filters.bound, strict=True)]
    both = _both(map(percent, shares))
    return np.equal(shares, 1), locals()


@claims.add("Theorem 1")
def _(filters: Any) -> Any:
    """Ξ bounds the error covariances of every node, in the form that our filter computes.

    Mean squared errors whitened with Ξ, in their largest direction (1 is the bound), at most
    {both}.
    """
    largest = [own[1:].max() for own in filters.filled]
    both = _both(largest, ".2g")
    return np.less_equal(largest, 1), locals()


@claims.add("Theorem 4, (26)")
def _(filters: Any) -> Any:
    """The fused estimate is consistent.

    The same of the fused estimate, at most {both}.
    """
    largest = [own[0] for own in filters.filled]
    both = _both(largest, ".2g")
    return np.less_equal(largest, 1), locals()


@claims.add("Theorem 3")
def _(filters: Any) -> Any:
    """The filtering error is bounded in mean square.

    Fused squared error in the second half of the episodes over that in the first: {ratios};
    the error's largest spectral radius, √(1 + ε) included, is {radii}. (The theorem's own
    condition (23) is met by all positive numbers.)
    """
    growth = [last / first.mean() for first, last in filters.steady]
    radius = [own.max() for own in filters.radius]
    ratios, radii = _both(map(cite, growth)), _both(radius, ".2g")
    return [*(below(own, GROWTH) for own in growth), np.less(radius, 1)], locals()


# --- the trigger and the fusion -------------------------------------------------------------------


@claims.add("Lemma 2")
def _(filters: Any) -> Any:
    """The threshold increases monotonically between ρ(0) and ρ̄.

    Its smallest change is {least}. So it adapts once: every threshold is within 1 % of ρ̄
    after {settled} instants of an episode.
    """
    changes, low, high = zip(*filters.rho_range, strict=True)
    least, settled = _both(changes, ".2g"), _both(cite(own, 2) for own in filters.settled)
    return [min(changes) >= 0, min(low) >= 1, max(high) <= 1], locals()


@claims.add("(5), (6), Lemma 2")
def _(filters: Any) -> Any:
    """A measurement without transmission differs from the last transmission by at most ρ̄.

    In {both} of all silent instants.
    """
    both = _both(map(percent, filters.within))
    return always(filters.within, filters.episodes), locals()


@claims.add("Section 1 (contribution 4), Section 3.3")
def _(filters: Any) -> Any:
    """Fusion by covariance intersection improves the estimates.

    The fused squared error lies below a node's in {count} of {better.size} comparisons. Of
    {errors}.
    """
    better = np.concatenate([below(own[0], own[1:]).ravel() for own in filters.each])
    errors = "; of ".join(
        f"{name}, {kind}: {cite(own[0, place])}, best node {cite(min(own[1:, place], key=np.mean))}"
        for name, own in zip(filters.names, filters.each, strict=True)
        for place, kind in enumerate(("states", "inputs"))
    )
    count = (better == 1).sum()
    return better, locals()


@claims.add("Remark 3, Figure 7")
def _(filters: Any) -> Any:
    """The trigger significantly reduces the transmissions.

    Rates in %: {both}. On average {mean}, where a fixed threshold, ρ(0) = ρ̄, has {fixed}.
    """
    percents = [100 * own for own in filters.rates]
    both = _both(cite(own[OURS]) for own in percents)
    mean, fixed = (_both(cite(own[i].mean(0)) for own in percents) for i in (OURS, FIXED))
    return below(filters.rates[0][OURS], FEW), locals()


# --- the printed recursion, whose first reading is the exact one ----------------------------------


@claims.add("(3), (4), (13)")
def _(printed: Any) -> Any:
    """The lifted system of (3) and (4) can meet the decoupling condition (13).

    With ℬ as printed, C ℬ has {printed.columns} columns and rank {printed.rank}: no L makes L C
    ℬ the identity. With the input held over a sampling interval it can.
    """
    return printed.rank == printed.columns


@claims.add("(14), (16)")
def _(printed: Any) -> Any:
    """Under (13) the input does not enter the estimation error.

    With the input held: the largest entry of ℬ - N C ℬ is {residual:.1g}, the rounding in (20)
    set to zero.
    """
    residual = max(printed.hidden[0])
    return residual < 1e-6, locals()


@claims.add("Theorem 1, (18)")
def _(printed: Any) -> Any:
    """(18) as printed, with its factor 1 - 2δ, bounds the error covariance.

    On the printed example the squared errors lie below its trace ({traces} by node). But the
    bound is smaller when nothing is sent ({tighter}), and with ρ̄ = {printed.small:g} it is
    indefinite in {printed.negative:%} of the silent instants.
    """
    errors, bounds = printed.node[0, :, 0], printed.trace[0]
    pairs = zip(errors.mean(-1), bounds.mean(-1), strict=True)
    traces = ", ".join(f"{error:.3g} under {bound:.3g}" for error, bound in pairs)
    shares = 100 * (printed.silent.mean(-1) / printed.sent.mean(-1) - 1)
    tighter = ", ".join(f"{share:.1f} %" for share in shares)
    return [below(errors, bounds), printed.negative == 0], locals()


@claims.add("Theorem 2")
def _(printed: Any) -> Any:
    """The gains (19) and (20) minimise the bounds.

    The trace of (18) exceeds the trace for the best gain under (14) by {both}; on the
    printed example (14) allows one gain only.
    """
    excess = printed.excess.mean(-1)
    both = _both(f"{100 * own:.3g} %" for own in excess)
    return abs(excess) < 1e-6, locals()
