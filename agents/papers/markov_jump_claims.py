"""What the paper on event-triggered fusion of Markov jump systems claims.

Source: markov_jump, Section 6 and Theorems 1 to 4.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from agents.papers.claims import Claims
from agents.papers.numbers import below, cite, number_text, percent

claims = Claims()
SAME = 1e-9  # relative difference of two recursions that are the same
SETTLED = 1e-9  # relative change over a period below which a trace repeats itself
_CLEAR = 4.0  # standard errors: not reached by chance in some dozens of comparisons

# --- what is sent, and the covariances ------------------------------------------------------------


@claims.add("Section 6, of Figure 2")
def _(schedule: Any) -> Any:
    """A larger threshold sends less."""
    packets = schedule.packets
    shares = " ".join(
        f"{label}: {number_text(own, '.2f')};"
        for label, own in zip(schedule.labels, schedule.shares, strict=True)
    )
    return packets[:-1] > packets[1:], (
        f"Shares of nodes 1, 2, 3 at {shares} together {number_text(packets, '.2f')} packets a "
        "step."
    )


@claims.add("Section 6, of Figure 4")
def _(schedule: Any) -> Any:
    """At m = 0 all local estimates are sent."""
    sent = schedule.literal
    quiet = (~sent.all(-1)).nonzero()[0].max(initial=-1) + 1
    return {"all steps": sent.all(), "steps after the start": sent[len(sent) // 2 :].all()}, (
        f"By (33) as printed, all of them from step {quiet + 1} on; before, the nodes' traces are "
        "below tr P_d, because x(0) is known well. Our figures send all at m = 0, as the text says."
    )


@claims.add("Remark 4")
def _(schedule: Any) -> Any:
    """Thresholds that make a difference lie between the least and the largest tr P_i - tr P_d;
    below the least everything is sent.
    """
    below_all, above_all = schedule.at_ends
    return [below_all == 1, above_all == 0], (
        f"Settled, from {schedule.range[0]:.3f} to {schedule.range[1]:.3f}. Just below, "
        f"{percent(below_all)} of the estimates are sent, just above {percent(above_all)}."
    )


@claims.add("Section 6, of Figure 5")
def _(schedule: Any) -> Any:
    """The larger the threshold, the larger the trace of the fused covariance."""
    return schedule.larger == 1, (
        f"From one threshold to the next it grows or stays in {percent(schedule.larger)} of all "
        f"steps; settled means {number_text(schedule.settled, '.3f')} at m = "
        f"{number_text(schedule.m, 'g')}."
    )


@claims.add("Section 6, of Figure 5; Section 7")
def _(schedule: Any) -> Any:
    """The fused covariances are periodically stable."""
    return schedule.fused_periods > 0, (
        f"Periods at m = {number_text(schedule.m, 'g')}: {_periods(schedule.fused_periods)} steps, "
        f"to a relative {SETTLED:.0e}."
    )


@claims.add("Remark 2")
def _(schedule: Any) -> Any:
    """A local filter's covariance is periodic with its own sampling period."""
    own = schedule.own_periods
    return own == schedule.periods, f"Periods of nodes 1, 2, 3: {_periods(own)} steps."


@claims.add("Remark 2")
def _(theorems: Any) -> Any:
    """Dummy measurements and an iterated state equation give the same accuracy."""
    gap = max(theorems.iterated)
    return gap < SAME, (
        f"Local covariances at the sampling times differ by at most {gap:.0e} of the largest entry."
    )


@claims.add("Section 2")
def _(schedule: Any) -> Any:
    """Every mode of the example is stable, ρ(Φ) < 1, and so is the system."""
    radii = " and ".join(map(number_text, schedule.radii))
    return [max(schedule.radii) < 1, schedule.square_radius < 1], (
        f"ρ(Φ) is {radii}. The mean square depends on the radius of the jump system, "
        f"{schedule.square_radius:.4f} < 1."
    )


# --- tracking -------------------------------------------------------------------------------------


@claims.add("Section 6, of Figure 3")
def _(tracking: Any) -> Any:
    """The algorithm tracks position and velocity at every threshold."""
    shares = 1 - _by_state(tracking) / tracking.silent.mean(-1)[:, None]
    return below(tracking.squares, 0.9 * tracking.silent), (
        "Reduction of the mean squared error relative to an estimate without deliveries (at least "
        f"a tenth if it tracks), at m = {number_text(tracking.m, 'g')}: of the position "
        f"{percent(shares[0])}; of the velocity {percent(shares[1])}."
    )


@claims.add("Section 6, of Figures 3 and 4")
def _(tracking: Any) -> Any:
    """The tracking becomes worse as the threshold grows."""
    raised = below(tracking.squares[:-1], tracking.squares[1:])
    position, velocity = (number_text(own, ".3f") for own in _by_state(tracking) ** 0.5)
    return raised, (
        f"RMSE at m = {number_text(tracking.m, 'g')}: position {position}; velocity {velocity}. Of "
        f"{raised.size} steps from one threshold to the next, {(raised == 1).sum()} raise the "
        "error for sure."
    )


@claims.add("Section 6, of Figure 4")
def _(tracking: Any) -> Any:
    """The RMSE curve of m = 1.5 is at the top."""
    position, velocity = map(percent, tracking.top)
    few = " and ".join(map(percent, tracking.few_top))
    return tracking.top > 0.5, (
        f"At the top or level with it in {position} of the steps for the position and {velocity} "
        f"for the velocity; with the first 100 runs alone in {few}."
    )


@claims.add("Section 6, of Figure 4")
def _(tracking: Any) -> Any:
    """At m = 0 the accuracy is best."""
    (position, velocity), (later, slower) = (map(cite, own) for own in tracking.squares[:2])
    return below(tracking.squares[0], tracking.squares[1:]), (
        f"Mean squared error of the position {position} at m = 0, {later} at m = 0.9; of the "
        f"velocity {velocity} and {slower}."
    )


# --- theorems -------------------------------------------------------------------------------------


@claims.add("(10)")
def _(theorems: Any) -> Any:
    """(10) is the second moment of the state."""
    pair = theorems.moment, theorems.moment_claimed
    return _agrees(*pair), f"Mean square of the state {_compared([pair])}."


@claims.add("Theorem 1, (12)-(22)")
def _(theorems: Any) -> Any:
    """The local filters know the covariance of their errors."""
    pairs = [*zip(theorems.local, theorems.claimed, strict=True)]
    return [_agrees(*pair) for pair in pairs], (
        f"Squared errors of nodes 1, 2, 3: {_compared(pairs)}. So the filters account for fading "
        "and jumps, as Section 6 says."
    )


@claims.add("Theorems 2 and 4, (57)")
def _(theorems: Any) -> Any:
    """The fused covariance is the covariance of the fused error, for all transmissions."""
    pairs = [*zip(theorems.fused, theorems.traces, strict=True)]
    return [_agrees(*pair) for pair in pairs], (
        f"At m = {number_text(theorems.m, 'g')}: {_compared(pairs)}. The exact joint covariance "
        "replaces Theorem 3 here."
    )


@claims.add("Theorem 3")
def _(theorems: Any) -> Any:
    """(46)-(50) are the cross-covariances of local estimates at the centre."""
    printed, corrected = theorems.difference
    return [printed < SAME, np.array(theorems.least) > -SAME], (
        f"As printed, all sent, they differ from the exact ones by {printed:.1e} of the largest "
        f"entry; with corrected indices in the third term of (46) by {corrected:.1e}. Where a node "
        "does not send, Σ is no covariance: least eigenvalues "
        f"{number_text(theorems.least, '.2g')} at m = {number_text(theorems.m, 'g')}."
    )


@claims.add("Theorem 4")
def _(theorems: Any) -> Any:
    """Matrix weights give the optimal distributed estimate: better than every node, and than fusion
    without the cross-covariances.
    """
    fused = theorems.fused[0]
    return [below(fused, theorems.local), below(fused, theorems.ci)], (
        f"All sent: mean squared error {cite(fused)}; nodes {cite(theorems.local)}; covariance "
        f"intersection of the same estimates {cite(theorems.ci)}."
    )


# --- the use of the trigger -----------------------------------------------------------------------


@claims.add("Abstract, Section 6")
def _(others: Any) -> Any:
    """The trigger reduces the transmission of redundant data and so saves the network."""
    shares = ", ".join(f"{100 * share:.0f} %" for share in others.shares)
    errors = "; ".join(
        f"m = {m:g}: {cite(paper)}, random requests {cite(chance)}"
        for m, paper, chance in zip(others.m, others.paper, others.chance, strict=True)
    )
    return [max(others.shares) < 1, below(others.paper, others.chance)], (
        f"Transmissions fall to {shares}. If the omitted packets were redundant, the error would "
        f"be smaller than with random requests: {errors}. A node sends when its own estimate is "
        "bad. So the best node never sends."
    )


@claims.add("Section 6")
def _(others: Any) -> Any:
    """An appropriate threshold saves communication and keeps the accuracy that is required."""
    price = others.paper[0].mean() / others.sent.mean() - 1
    schedules = "; ".join(
        f"m = {own['m']:g}, {own['packets']} packets in 6 steps: {cite(own['paper'])}, the best "
        f"schedule of as many {cite(own['best'])}"
        for own in others.schedules
    )
    return [max(others.shares) < 1, 1 - others.far], (
        f"It saves, at the price of {percent(price)} more squared error already at m = "
        f"{others.m[0]:g}. The same number of packets at other times gives a smaller error: "
        f"{schedules}."
    )


@claims.add("Section 1")
def _(others: Any) -> Any:
    """Centralised fusion is globally optimal, distributed fusion suboptimal."""
    return below(others.centralised, others.sent), (
        f"All sent, mean squared error {cite(others.sent)}; one linear filter for all measurements "
        f"{cite(others.centralised)}. It is optimal among linear filters: interacting multiple "
        f"models reach {cite(others.modes)}."
    )


def _periods(periods: Iterable[int]) -> str:
    return ", ".join(f"{period}" if period else "none" for period in periods)


def _by_state(tracking: Any) -> Any:
    """Return mean squared errors (states, thresholds)."""
    return tracking.squares.mean(-1).T


def _agrees(sample: Any, claim: float) -> bool:
    error = sample.std(ddof=1) / np.sqrt(len(sample))
    return bool(abs(sample.mean() - claim) <= _CLEAR * error)


def _compared(pairs: Iterable[Any]) -> str:
    return "; ".join(f"{cite(own, 4)} where {claim:.4g} is claimed" for own, claim in pairs)
