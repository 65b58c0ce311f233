"""What the paper on Tobit Kalman fusion with a token bucket claims.

Source: tobit_token_bucket, Sections 1 and 4, Theorems 1 to 5.
"""

from typing import Any

import numpy as np

from agents.papers.claims import MISPRINT, Claims
from agents.papers.numbers import always, below, cite
from agents.papers.tobit_token_bucket_runs import PRINTED_OPERATIONS, count_operations

claims = Claims()
LONG, WINDOW = 1000, 200  # steps of a long run, and of the parts whose errors are compared
_CLEAR = 4  # standard errors: of 400 eigenvalues none of 1 is likely to lie as far above

# --- tokens and events ----------------------------------------------------------------------------


@claims.add("Remark 2, (18)-(20)")
def _(network: Any) -> Any:
    """A measurement is sent only if its event occurs and there are tokens for it.

    Of {network.grants:,} transmissions {network.uncalled_grants} had no event and
    {network.poor_grants} fewer than {network.needed:g} tokens; of the events with as many,
    {network.rich_refusals} were denied. Levels from {network.lowest:g} to
    {network.highest:g} of {network.capacity:g}.
    """
    within = 0 <= network.lowest <= network.highest <= network.capacity
    return [network.poor_grants == 0, network.uncalled_grants == 0, within]


@claims.add("Section 1")
def _(network: Any) -> Any:
    """The event trigger saves communication.

    Share of steps with an event, by node: {network.rate_requested}, where `always` has 1.
    """
    return below(network.rate_requested, 1)


@claims.add("Section 1")
def _(network: Any) -> Any:
    """An event trigger alone does not keep the network from being overused; the bucket does.

    Without a bucket the events cost {network.wanted} tokens per step, where {network.rate:g} are
    generated; with it {network.spent} are spent.
    """
    return [below(network.rate, network.wanted), below(network.spent, network.rate)]


@claims.add("Remark 4")
def _(network: Any) -> Any:
    """Denied packets cost accuracy: the bucket affects the filtering error.

    Mean squared error {network.mse} with the bucket, {network.mse_unlimited} without.
    """
    return below(network.mse_unlimited, network.mse)


# --- estimates and errors -------------------------------------------------------------------------


@claims.add("Section 4, of Figures 5-7")
def _(estimates: Any) -> Any:
    """Censoring makes the local estimates fluctuate, most of all the second state at node 3.

    Change of the error from step to step, first and second state: {changes}; fused {centre[0]:.3f}
    and {centre[1]:.3f}. Every node fluctuates more than the centre: {every}. Strongest: node
    {node}, state {state}. Second state at node 3: {estimates.change_censored} where it is censored,
    {estimates.change_uncensored} where it is not.
    """
    local, fused = estimates.local_change, estimates.fused_change
    means, centre, rougher = local.mean(-1), fused.mean(-1), below(fused, local).all()
    node, state = np.array(np.unravel_index(means.argmax(), means.shape)) + 1
    pairs = enumerate(means, 1)
    changes = ", ".join(f"node {m} {first:.3f} and {second:.3f}" for m, (first, second) in pairs)
    others = below(local.reshape(6, -1)[:-1], local[2, 1]).all()
    every = "yes" if rougher else "no"
    censored = below(estimates.change_uncensored, estimates.change_censored)
    return [rougher, others, censored], locals()


@claims.add("Section 4, of Figures 5-7")
def _(estimates: Any) -> Any:
    """The fused estimate, fed back, smooths the local filters' fluctuations.

    Step-to-step change of the estimate, mean of both states: {estimates.moved} of the
    centre with feedback; of local nodes with a third of the bucket {estimates.single_moved}.
    """
    return below(estimates.moved, estimates.single_moved)


@claims.add("Section 4, last paragraph")
def _(estimates: Any) -> Any:
    """The fusion scheme is effective: better than its nodes without fusion.

    Mean squared error {estimates.mse} of the scheme, at {estimates.rate:.3f} transmissions a
    node and step; nodes without fusion, with a third of the bucket {single}.
    """
    pairs = zip(estimates.single_mse, estimates.single_rate, strict=True)
    single = ", ".join(f"{cite(mse)} at {rate:.3f}" for mse, rate in pairs)
    return below(estimates.mse, estimates.single_mse), locals()


@claims.add("Section 4, of Figures 8-10")
def _(errors: Any) -> Any:
    """The trace of the fused bound is smaller than the trace of every node.

    In {shares:%} of all steps beside nodes 1, 2, 3. By (50) the fused bound is the inverse of
    a sum that contains every node's inverse, so this must hold. It is no statement about
    errors: the fused bound is {times:.0f} times the error.
    """
    times = errors.by_fused_trace.mean() / errors.by_fused_error.mean()
    shares = errors.share_trace.mean(-1)
    return always(errors.share_trace, errors.episodes), locals()


@claims.add("Section 4, of Figures 8-10")
def _(errors: Any) -> Any:
    """In most cases the squared error of the fused estimate is smaller than the local one.

    Share of steps, beside nodes 1, 2, 3: {errors.share_error}.
    """
    return below(0.5, errors.share_error)


@claims.add("Section 4, last paragraph")
def _(errors: Any) -> Any:
    """Fusion improves the mean squared error of every node.

    Fused {fused}; nodes {local}; fused minus local, paired, {difference}.
    """
    fused, local = errors.by_fused_error, errors.by_local_error
    difference = cite(fused - local, 2)
    return below(fused, local), locals()


@claims.add("Section 4, of Figures 8-10")
def _(errors: Any) -> Any:
    """The fused error's curve is relatively smooth.

    Mean change of lg of the squared error from step to step: fused {errors.rough_fused_error},
    nodes {errors.rough_local_error}.
    """
    return below(errors.rough_fused_error, errors.rough_local_error)


# --- theorems -------------------------------------------------------------------------------------


@claims.add("Theorem 1, (28)")
def _(theorems: Any) -> Any:
    """The local bound is above the covariance of the local error.

    Largest eigenvalue of E[P^(-1/2) e eᵀ P^(-1/2)], P the bound and e the error, which is at most 1
    where the bound holds: its highest value over time is {highest:.2f} at nodes 1, 2, 3; its mean
    says that the bound is {times:.0f} times too large. The proof assumes that censoring is
    independent of the noise, so this is measured, not proven.
    """
    values = theorems.eigenvalue[1:]
    highest, times = values.max(-1), 1 / values.mean()
    return _covered(theorems)[1:], locals()


@claims.add("Theorem 5, (52)")
def _(theorems: Any) -> Any:
    """The fused bound is above the covariance of the fused error.

    Largest eigenvalue of E[P^(-1/2) e eᵀ P^(-1/2)], P the bound and e the error, which is at most 1
    where the bound holds: highest {highest:.2f} ± {margin:.2f}, at t = {time}; mean over time
    {mean:.3f}. The proof uses (53) for the fused estimate; (53) holds for the feedback.
    """
    values, place = theorems.eigenvalue[0], theorems.eigenvalue[0].argmax()
    highest, time, mean = values[place], place + 1, values.mean()
    margin = _CLEAR * theorems.eigenvalue_error[0][place]
    return _covered(theorems)[0], locals()


@claims.add("Theorem 2")
def _(theorems: Any) -> Any:
    """The gain (37) minimises the trace of the bound (30).

    Of random other gains {share:%} have a larger trace. (30) written out as printed, with the
    readings of the environment's page, agrees with the filter's trace to a relative
    {difference:.0e}, in the {steps:%} of steps in which no component is nearly surely
    censored.
    """
    larger, difference = theorems.gain_larger, theorems.gain_difference.max()
    share, steps = larger.mean(), theorems.gain_counted.mean()
    return [larger >= 1 - 1e-12, difference < 1e-9], locals()


@claims.add("Theorem 3, (42)")
def _(theorems: Any) -> Any:
    """Condition (42) holds in the example, and the error is bounded in mean square.

    (42) holds in {shares[0]:%} of the steps in which a node receives and in {shares[1]:%} of the
    others, where its left side is at least {least:.2f}: the theorem does not apply. The error
    still stays bounded: squared error {first} in steps 201 to 400 and {last} in the last 200 of
    1000. Without transmissions the bound grows by a factor of {growth:.2f} per step.
    """
    delivered, silent = theorems.holds_delivered, theorems.holds_silent
    (_, first, *_, last), (_, early, *_, late) = theorems.windows, theorems.traces
    bounded = [below(last, 1.2 * first), below(late, 1.5 * early)]
    shares = delivered.mean(), silent.mean()
    least, growth = theorems.least_silent.min(), theorems.growth.mean()
    return [delivered.min() == 1, silent.min() == 1, *bounded], locals()


@claims.add("Theorem 3, (43)")
def _(theorems: Any) -> Any:
    """(43) exists, and the error's covariance stays below it.

    It exists where (42) holds, in {share:%} of the steps. There it is at least
    {theorems.limit_ratio:.2g} times the norm of the error's covariance.
    """
    share = theorems.holds.mean()
    return [theorems.holds.min() == 1, theorems.limit_ratio >= 1], locals()


@claims.add("Remark 5")
def _() -> Any:
    """Algorithm 1 takes the printed number of operations.

    In n_x³ we count 10 l + 1, as printed. B Q Bᵀ, the only product with n_w, takes 2 n_x n_w² +
    2 n_x² n_w - n_x n_w in either order; printed are 2 n_x n_w² - 2 n_x n_w, zero for n_w = 1.
    Other terms depend on the order.
    """
    return count_operations() == PRINTED_OPERATIONS or MISPRINT


@claims.add("Section 4, last paragraph")
def _(theorems: Any) -> Any:
    """If a sensor fails, the others' data keep the filters good.

    Fused squared error {healthy} with all sensors; with sensor 1, 2 or 3 silent {theorems.failed};
    with all three silent {theorems.silent}. Where the error falls although a sensor fails, the
    held updates cost accuracy, and the other sensors get its tokens.
    """
    failed, healthy = theorems.failed, theorems.healthy
    return [below(failed, theorems.silent), below(failed, 1.1 * healthy)], locals()


# --- other filters --------------------------------------------------------------------------------


@claims.add("Sections 1 and 4")
def _(readings: Any) -> Any:
    """The centre obtains an optimal estimate from the local ones.

    Mean squared error {ours}; with standard Tobit Kalman filters at the nodes, the same
    trigger, bucket and fusion rule, {standard}. The filter minimises a bound far above the
    error.
    """
    ours, *_, standard = readings.fused
    return below(ours, 1.01 * standard), locals()


@claims.add("Section 1")
def _(readings: Any) -> Any:
    """The Tobit Kalman filter surpasses the extended and the unscented one.

    Mean squared error of standard Tobit filters {tobit}; on the same deliveries, extended
    {readings.extended}, unscented {readings.unscented}.
    """
    *_, tobit = readings.fused
    return below(tobit, [readings.extended, readings.unscented]), locals()


@claims.add("Section 1")
def _(readings: Any) -> Any:
    """Federated fusion has the smallest burden and the highest accuracy.

    Mean squared error {fused}; by covariance intersection of the same nodes {readings.ci},
    sequential {readings.sci}, two of the seven rules that the paper names. The estimates that it
    fuses, of nodes 1, 2, 3: {local}. The burden is not measured.
    """
    fused, local = readings.fused[0], readings.local[0]
    return [below(fused, [readings.ci, readings.sci]), below(fused, local)], locals()


@claims.add("Section 1")
def _(readings: Any) -> Any:
    """Traditional Kalman filtering cannot handle censored measurements; the Tobit filter can.

    Mean squared error {readings.fused[0]}, and {readings.ignoring} of Kalman filters that ignore
    censoring, with the same trigger and bucket.
    """
    return below(readings.fused[0], readings.ignoring)


def _covered(theorems: Any) -> Any:
    values, errors = theorems.eigenvalue, theorems.eigenvalue_error
    return (values - _CLEAR * errors <= 1).all(-1)
