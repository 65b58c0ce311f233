"""What the paper on event-triggered fusion of Markov jump systems claims.

Source: markov_jump, Section 6 and Theorems 1 to 4.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from agents.papers.claims import Claims
from agents.papers.numbers import below, cite, number_text

claims = Claims()
SAME = 1e-9  # relative difference of two recursions that are the same
SETTLED = 1e-9  # relative change over a period below which a trace repeats itself
_CLEAR = 4.0  # standard errors: not reached by chance in some dozens of comparisons

# --- what is sent, and the covariances ------------------------------------------------------------


@claims.add("Section 6, of Figure 2")
def _(schedule: Any) -> Any:
    """A larger threshold sends less.

    Shares of nodes 1, 2, 3 at {shares} together {schedule.packets:.2f} packets per step.
    """
    pairs = zip(schedule.labels, schedule.shares, strict=True)
    shares = " ".join(f"{label}: {number_text(own, '.2f')};" for label, own in pairs)
    return schedule.packets[:-1] > schedule.packets[1:], locals()


@claims.add("Section 6, of Figure 4")
def _(schedule: Any) -> Any:
    """At m = 0 all local estimates are sent.

    By (33) as printed, all of them from step {first} on; before, the nodes' traces are below
    tr P_d, because x(0) is known well. Our figures send all at m = 0, as the text says.
    """
    sent = schedule.literal
    first, late = (~sent.all(-1)).nonzero()[0].max(initial=-1) + 2, sent[len(sent) // 2 :]
    return {"all steps": sent.all(), "steps after the start": late.all()}, locals()


@claims.add("Remark 4")
def _(schedule: Any) -> Any:
    """Thresholds that make a difference lie between the least and the largest tr P_i - tr P_d;
    below the least everything is sent.

    Settled, from {schedule.range[0]:.3f} to {schedule.range[1]:.3f}. Just below, {below_all:%}
    of the estimates are sent, just above {above_all:%}.
    """
    below_all, above_all = schedule.at_ends
    return [below_all == 1, above_all == 0], locals()


@claims.add("Section 6, of Figure 5")
def _(schedule: Any) -> Any:
    """The larger the threshold, the larger the trace of the fused covariance.

    From one threshold to the next it grows or stays in {schedule.larger:%} of all steps;
    settled means {schedule.settled:.3f} at m = {schedule.m:g}.
    """
    return schedule.larger == 1


@claims.add("Section 6, of Figure 5; Section 7")
def _(schedule: Any) -> Any:
    """The fused covariances are periodically stable.

    Periods at m = {schedule.m:g}: {periods} steps, to a relative 1e-09.
    """
    periods = _periods(schedule.fused_periods)
    return schedule.fused_periods > 0, locals()


@claims.add("Remark 2")
def _(schedule: Any) -> Any:
    """A local filter's covariance is periodic with its own sampling period.

    Periods of nodes 1, 2, 3: {periods} steps.
    """
    periods = _periods(schedule.own_periods)
    return schedule.own_periods == schedule.periods, locals()


@claims.add("Remark 2")
def _(theorems: Any) -> Any:
    """Dummy measurements and an iterated state equation give the same accuracy.

    Local covariances at the sampling times differ by at most {gap:.0e} of the largest entry.
    """
    gap = max(theorems.iterated)
    return gap < SAME, locals()


@claims.add("Section 2")
def _(schedule: Any) -> Any:
    """Every mode of the example is stable, ρ(Φ) < 1, and so is the system.

    ρ(Φ) is {schedule.radii[0]:.3g} and {schedule.radii[1]:.3g}. The mean square depends
    on the radius of the jump system, {schedule.square_radius:.4f} < 1.
    """
    return [max(schedule.radii) < 1, schedule.square_radius < 1]


# --- tracking -------------------------------------------------------------------------------------


@claims.add("Section 6, of Figure 3")
def _(tracking: Any) -> Any:
    """The algorithm tracks position and velocity at every threshold.

    Reduction of the mean squared error relative to an estimate without deliveries (at least a
    tenth if it tracks), at m = {tracking.m:g}: of the position {shares[0]:%}; of the velocity
    {shares[1]:%}.
    """
    shares = 1 - _by_state(tracking) / tracking.silent.mean(-1)[:, None]
    return below(tracking.squares, 0.9 * tracking.silent), locals()


@claims.add("Section 6, of Figures 3 and 4")
def _(tracking: Any) -> Any:
    """The tracking becomes worse as the threshold grows.

    RMSE at m = {tracking.m:g}: position {errors[0]:.3f}; velocity {errors[1]:.3f}. Of
    {raised.size} steps from one threshold to the next, {count} raise the error for sure.
    """
    raised = below(tracking.squares[:-1], tracking.squares[1:])
    count, errors = (raised == 1).sum(), _by_state(tracking) ** 0.5
    return raised, locals()


@claims.add("Section 6, of Figure 4")
def _(tracking: Any) -> Any:
    """The RMSE curve of m = 1.5 is at the top.

    At the top or level with it in {tracking.top[0]:%} of the steps for the position and
    {tracking.top[1]:%} for the velocity; with the first 100 runs alone in {tracking.few_top[0]:%}
    and {tracking.few_top[1]:%}.
    """
    return tracking.top > 0.5


@claims.add("Section 6, of Figure 4")
def _(tracking: Any) -> Any:
    """At m = 0 the accuracy is best.

    Mean squared error of the position {first[0]} at m = 0, {second[0]} at m = 0.9; of the
    velocity {first[1]} and {second[1]}.
    """
    first, second, *_ = tracking.squares
    return below(first, tracking.squares[1:]), locals()


# --- theorems -------------------------------------------------------------------------------------


@claims.add("(10)")
def _(theorems: Any) -> Any:
    """(10) is the second moment of the state.

    Mean square of the state {compared}.
    """
    pairs = [(theorems.moment, theorems.moment_claimed)]
    compared = _compared(pairs)
    return _agree(pairs), locals()


@claims.add("Theorem 1, (12)-(22)")
def _(theorems: Any) -> Any:
    """The local filters know the covariance of their errors.

    Squared errors of nodes 1, 2, 3: {compared}. So the filters account for fading and jumps, as
    Section 6 says.
    """
    pairs = [*zip(theorems.local, theorems.claimed, strict=True)]
    compared = _compared(pairs)
    return _agree(pairs), locals()


@claims.add("Theorems 2 and 4, (57)")
def _(theorems: Any) -> Any:
    """The fused covariance is the covariance of the fused error, for all transmissions.

    At m = {theorems.m:g}: {compared}. The exact joint covariance replaces Theorem 3 here.
    """
    pairs = [*zip(theorems.fused, theorems.traces, strict=True)]
    compared = _compared(pairs)
    return _agree(pairs), locals()


@claims.add("Theorem 3")
def _(theorems: Any) -> Any:
    """(46)-(50) are the cross-covariances of local estimates at the centre.

    As printed, all sent, they differ from the exact ones by {printed:.1e} of the largest entry;
    with corrected indices in the third term of (46) by {corrected:.1e}. Where a node does not
    send, Σ is no covariance: least eigenvalues {theorems.least:.2g} at m = {theorems.m:g}.
    """
    printed, corrected = theorems.difference
    return [printed < SAME, np.array(theorems.least) > -SAME], locals()


@claims.add("Theorem 4")
def _(theorems: Any) -> Any:
    """Matrix weights give the optimal distributed estimate: better than every node, and than fusion
    without the cross-covariances.

    All sent: mean squared error {fused}; nodes {theorems.local}; covariance intersection of the
    same estimates {theorems.ci}.
    """
    fused = theorems.fused[0]
    return [below(fused, theorems.local), below(fused, theorems.ci)], locals()


# --- the use of the trigger -----------------------------------------------------------------------


@claims.add("Abstract, Section 6")
def _(others: Any) -> Any:
    """The trigger reduces the transmission of redundant data and so saves the network.

    Transmissions fall to {shares}. If the omitted packets were redundant, the error would be
    smaller than with random requests: {errors}. A node sends when its own estimate is bad. So
    the best node never sends.
    """
    shares = ", ".join(f"{100 * share:.0f} %" for share in others.shares)
    errors = "; ".join(
        f"m = {m:g}: {cite(paper)}, random requests {cite(chance)}"
        for m, paper, chance in zip(others.m, others.paper, others.chance, strict=True)
    )
    return [max(others.shares) < 1, below(others.paper, others.chance)], locals()


@claims.add("Section 6")
def _(others: Any) -> Any:
    """An appropriate threshold saves communication and keeps the accuracy that is required.

    It saves, at the price of {price:%} more squared error already at m = {others.m[0]:g}. The
    same number of packets at other times gives a smaller error: {schedules}.
    """
    price = others.paper[0].mean() / others.sent.mean() - 1
    schedules = "; ".join(
        f"m = {own['m']:g}, {own['packets']} packets in 6 steps: {cite(own['paper'])}, the best "
        f"schedule of as many {cite(own['best'])}"
        for own in others.schedules
    )
    return [max(others.shares) < 1, 1 - others.far], locals()


@claims.add("Section 1")
def _(others: Any) -> Any:
    """Centralised fusion is globally optimal, distributed fusion suboptimal.

    All sent, mean squared error {others.sent}; one linear filter for all measurements
    {others.centralised}. It is optimal among linear filters: interacting multiple models reach
    {others.modes}.
    """
    return below(others.centralised, others.sent)


def _periods(periods: Iterable[int]) -> str:
    return ", ".join(f"{period}" if period else "none" for period in periods)


def _by_state(tracking: Any) -> Any:
    """Return mean squared errors (states, thresholds)."""
    return tracking.squares.mean(-1).T


def _agree(pairs: Iterable[Any]) -> list[bool]:
    """Return whether the mean of each sample is near its claimed value."""
    errors = [sample.std(ddof=1) / np.sqrt(len(sample)) for sample, _ in pairs]
    return [
        abs(sample.mean() - claim) <= _CLEAR * error
        for (sample, claim), error in zip(pairs, errors, strict=True)
    ]


def _compared(pairs: Iterable[Any]) -> str:
    return "; ".join(f"{cite(own, 4)} where {claim:.4g} is claimed" for own, claim in pairs)
