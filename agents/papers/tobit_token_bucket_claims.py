"""What the paper on Tobit Kalman fusion with a token bucket claims.

Source: tobit_token_bucket, Sections 1 and 4, Theorems 1 to 5.
"""

from typing import Any

import numpy as np

from agents.papers.claims import MISPRINT, Claims
from agents.papers.numbers import always, below, cite, percent
from agents.papers.tobit_token_bucket_runs import PRINTED_OPERATIONS, count_operations

claims = Claims()
LONG, WINDOW = 1000, 200  # steps of a long run, and of the parts whose errors are compared
_CLEAR = 4  # standard errors: of 400 eigenvalues none of 1 is likely to lie as far above
_EIGENVALUE = (
    "Largest eigenvalue of E[P^(-1/2) e eᵀ P^(-1/2)], P the bound and e the error, which is at "
    "most 1 where the bound holds"
)

# --- tokens and events ----------------------------------------------------------------------------


@claims.add("Remark 2, (18)-(20)")
def _(network: Any) -> Any:
    """A measurement is sent only if its event occurs and there are tokens for it."""
    low, high, most = network.lowest, network.highest, network.capacity
    return [network.poor_grants == 0, network.uncalled_grants == 0, 0 <= low <= high <= most], (
        f"Of {network.grants:,} transmissions {network.uncalled_grants} had no event and "
        f"{network.poor_grants} fewer than {network.needed:g} tokens; of the events with as many, "
        f"{network.rich_refusals} were denied. Levels from {low:g} to {high:g} of {most:g}."
    )


@claims.add("Section 1")
def _(network: Any) -> Any:
    """The event trigger saves communication."""
    rate = network.rate_requested
    return below(rate, 1), (
        f"Share of steps with an event, by node: {cite(rate)}, where `always` has 1."
    )


@claims.add("Section 1")
def _(network: Any) -> Any:
    """An event trigger alone does not keep the network from being overused; the bucket does."""
    rate, wanted, spent = network.rate, network.wanted, network.spent
    return [below(rate, wanted), below(spent, rate)], (
        f"Without a bucket the events cost {cite(wanted)} tokens a step, where {rate:g} are "
        f"generated; with it {cite(spent)} are spent."
    )


@claims.add("Remark 4")
def _(network: Any) -> Any:
    """Denied packets cost accuracy: the bucket affects the filtering error."""
    free, mse = network.mse_unlimited, network.mse
    return below(free, mse), (
        f"Mean squared error {cite(mse)} with the bucket, {cite(free)} without."
    )


# --- estimates and errors -------------------------------------------------------------------------


@claims.add("Section 4, of Figures 5-7")
def _(estimates: Any) -> Any:
    """Censoring makes the local estimates fluctuate, most of all the second state at node 3."""
    local, fused = estimates.local_change, estimates.fused_change
    free, censored = estimates.change_uncensored, estimates.change_censored
    rougher = below(fused, local).all()
    node, state = np.unravel_index(local.mean(-1).argmax(), local.shape[:2])
    changes = ", ".join(
        f"node {i + 1} {first:.3f} and {second:.3f}"
        for i, (first, second) in enumerate(local.mean(-1))
    )
    first, second = fused.mean(-1)
    others = below(local.reshape(6, -1)[:-1], local[2, 1]).all()
    return [rougher, others, below(free, censored)], (
        f"Change of the error from step to step, first and second state: {changes}; fused "
        f"{first:.3f} and {second:.3f}. Every node fluctuates more than the centre: "
        f"{'yes' if rougher else 'no'}. Strongest: node {node + 1}, state {state + 1}. Second "
        f"state at node 3: {cite(censored)} where it is censored, {cite(free)} where it is not."
    )


@claims.add("Section 4, of Figures 5-7")
def _(estimates: Any) -> Any:
    """The fused estimate, fed back, smooths the local filters' fluctuations."""
    fused, single = estimates.moved, estimates.single_moved
    return below(fused, single), (
        f"Step-to-step change of the estimate, mean of both states: {cite(fused)} of the centre "
        f"with feedback; of local nodes with a third of the bucket {cite(single)}."
    )


@claims.add("Section 4, last paragraph")
def _(estimates: Any) -> Any:
    """The fusion scheme is effective: better than its nodes without fusion."""
    pairs = zip(estimates.single_mse, estimates.single_rate, strict=True)
    single = ", ".join(f"{cite(mse)} at {rate:.3f}" for mse, rate in pairs)
    return below(estimates.mse, estimates.single_mse), (
        f"Mean squared error {cite(estimates.mse)} of the scheme, at {estimates.rate:.3f} "
        f"transmissions a node and step; nodes without fusion, with a third of the bucket {single}."
    )


@claims.add("Section 4, of Figures 8-10")
def _(errors: Any) -> Any:
    """The trace of the fused bound is smaller than the trace of every node."""
    times = errors.by_fused_trace.mean() / errors.by_fused_error.mean()
    return always(errors.share_trace, errors.episodes), (
        f"In {percent(errors.share_trace.mean(-1))} of all steps beside nodes 1, 2, 3. By (50) the "
        "fused bound is the inverse of a sum that contains every node's inverse, so this must "
        f"hold. It is no statement about errors: the fused bound is {times:.0f} times the error."
    )


@claims.add("Section 4, of Figures 8-10")
def _(errors: Any) -> Any:
    """In most cases the squared error of the fused estimate is smaller than the local one."""
    share = errors.share_error
    return below(0.5, share), f"Share of steps, beside nodes 1, 2, 3: {cite(share)}."


@claims.add("Section 4, last paragraph")
def _(errors: Any) -> Any:
    """Fusion improves the mean squared error of every node."""
    fused, local = errors.by_fused_error, errors.by_local_error
    return below(fused, local), (
        f"Fused {cite(fused)}; nodes {cite(local)}; fused minus local, paired, "
        f"{cite(fused - local, 2)}."
    )


@claims.add("Section 4, of Figures 8-10")
def _(errors: Any) -> Any:
    """The fused error's curve is relatively smooth."""
    fused, local = errors.rough_fused_error, errors.rough_local_error
    return below(fused, local), (
        f"Mean change of lg of the squared error from step to step: fused {cite(fused)}, nodes "
        f"{cite(local)}."
    )


# --- theorems -------------------------------------------------------------------------------------


@claims.add("Theorem 1, (28)")
def _(theorems: Any) -> Any:
    """The local bound is above the covariance of the local error."""
    values = theorems.eigenvalue[1:]
    highest = ", ".join(f"{value:.2f}" for value in values.max(-1))
    return _covered(theorems)[1:], (
        f"{_EIGENVALUE}: its highest value over time is {highest} at nodes 1, 2, 3; its mean says "
        f"that the bound is {1 / values.mean():.0f} times too large. The proof assumes that "
        "censoring is independent of the noise, so this is measured, not proven."
    )


@claims.add("Theorem 5, (52)")
def _(theorems: Any) -> Any:
    """The fused bound is above the covariance of the fused error."""
    values, place = theorems.eigenvalue[0], theorems.eigenvalue[0].argmax()
    margin = _CLEAR * theorems.eigenvalue_error[0][place]
    return _covered(theorems)[0], (
        f"{_EIGENVALUE}: highest {values[place]:.2f} ± {margin:.2f}, at t = {place + 1}; mean over "
        f"time {values.mean():.3f}. The proof uses (53) for the fused estimate; (53) holds for the "
        "feedback."
    )


@claims.add("Theorem 2")
def _(theorems: Any) -> Any:
    """The gain (37) minimises the trace of the bound (30)."""
    larger, difference = theorems.gain_larger, theorems.gain_difference.max()
    return [larger >= 1 - 1e-12, difference < 1e-9], (
        f"Of random other gains {percent(larger.mean())} have a larger trace. (30) written out as "
        "printed, with the readings of the environment's page, agrees with the filter's trace to a "
        f"relative {difference:.0e}, in the {percent(theorems.gain_counted.mean())} of steps in "
        "which no component is nearly surely censored."
    )


@claims.add("Theorem 3, (42)")
def _(theorems: Any) -> Any:
    """Condition (42) holds in the example, and the error is bounded in mean square."""
    delivered, silent = theorems.holds_delivered, theorems.holds_silent
    (_, first, *_, last), (_, early, *_, late) = theorems.windows, theorems.traces
    bounded = [below(last, 1.2 * first), below(late, 1.5 * early)]
    return [delivered.min() == 1, silent.min() == 1, *bounded], (
        f"(42) holds in {percent(delivered.mean())} of the steps in which a node receives and in "
        f"{percent(silent.mean())} of the others, where its left side is at least "
        f"{theorems.least_silent.min():.2f}: the theorem does not apply. The error still stays "
        f"bounded: squared error {cite(first)} in steps {WINDOW + 1} to {2 * WINDOW} and "
        f"{cite(last)} in the last {WINDOW} of {LONG}. Without transmissions the bound grows by a "
        f"factor of {theorems.growth.mean():.2f} a step."
    )


@claims.add("Theorem 3, (43)")
def _(theorems: Any) -> Any:
    """(43) exists, and the error's covariance stays below it."""
    holds, ratio = theorems.holds, theorems.limit_ratio
    return [holds.min() == 1, ratio >= 1], (
        f"It exists where (42) holds, in {percent(holds.mean())} of the steps. There it is at "
        f"least {ratio:.2g} times the norm of the error's covariance."
    )


@claims.add("Remark 5")
def _() -> Any:
    """Algorithm 1 takes the printed number of operations."""
    return count_operations() == PRINTED_OPERATIONS or MISPRINT, (
        "In n_x³ we count 10 l + 1, as printed. B Q Bᵀ, the only product with n_w, takes "
        "2 n_x n_w² + 2 n_x² n_w - n_x n_w in either order; printed are 2 n_x n_w² - 2 n_x n_w, "
        "zero for n_w = 1. Other terms depend on the order."
    )


@claims.add("Section 4, last paragraph")
def _(theorems: Any) -> Any:
    """If a sensor fails, the others' data keep the filters good."""
    failed, healthy, silent = theorems.failed, theorems.healthy, theorems.silent
    return [below(failed, silent), below(failed, 1.1 * healthy)], (
        f"Fused squared error {cite(healthy)} with all sensors; with sensor 1, 2 or 3 silent "
        f"{cite(failed)}; with all three silent {cite(silent)}. Where the error falls although a "
        "sensor fails, the held updates cost accuracy, and the other sensors get its tokens."
    )


# --- other filters --------------------------------------------------------------------------------


@claims.add("Sections 1 and 4")
def _(readings: Any) -> Any:
    """The centre obtains an optimal estimate from the local ones."""
    ours, *_, standard = readings.fused
    return below(ours, 1.01 * standard), (
        f"Mean squared error {cite(ours)}; with standard Tobit Kalman filters at the nodes, the "
        f"same trigger, bucket and fusion rule, {cite(standard)}. The filter minimises a bound far "
        "above the error."
    )


@claims.add("Section 1")
def _(readings: Any) -> Any:
    """The Tobit Kalman filter surpasses the extended and the unscented one."""
    *_, tobit = readings.fused
    others = [readings.extended, readings.unscented]
    return below(tobit, others), (
        f"Mean squared error of standard Tobit filters {cite(tobit)}; on the same deliveries, "
        f"extended {cite(others[0])}, unscented {cite(others[1])}."
    )


@claims.add("Section 1")
def _(readings: Any) -> Any:
    """Federated fusion has the smallest burden and the highest accuracy."""
    fused, local, others = readings.fused[0], readings.local[0], [readings.ci, readings.sci]
    return [below(fused, others), below(fused, local)], (
        f"Mean squared error {cite(fused)}; by covariance intersection of the same nodes "
        f"{cite(others[0])}, sequential {cite(others[1])}, two of the seven rules that the paper "
        f"names. The estimates that it fuses, of nodes 1, 2, 3: {cite(local)}. The burden is not "
        "measured."
    )


@claims.add("Section 1")
def _(readings: Any) -> Any:
    """Traditional Kalman filtering cannot handle censored measurements; the Tobit filter can."""
    tobit, kalman = readings.fused[0], readings.ignoring
    return below(tobit, kalman), (
        f"Mean squared error {cite(tobit)}, and {cite(kalman)} of Kalman filters that ignore "
        "censoring, with the same trigger and bucket."
    )


def _covered(theorems: Any) -> Any:
    values, errors = theorems.eigenvalue, theorems.eigenvalue_error
    return (values - _CLEAR * errors <= 1).all(-1)
