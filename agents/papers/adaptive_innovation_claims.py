"""What the paper on the adaptive innovation trigger claims.

Source: adaptive_innovation, Section 6.
"""

from typing import Any

from agents.papers.claims import MISPRINT, Claims
from agents.papers.numbers import always, below, cite, percent

claims = Claims()

# --- the trigger ----------------------------------------------------------------------------------


@claims.add("Abstract, Section 6")
def _(rates: Any) -> Any:
    """The mechanism reduces the communication burden.

    The sensors request in {rates.percent.ours} % of the steps, where a time trigger requests in
    all of them.
    """
    return below(rates.percent.ours, 100)


@claims.add("Section 6")
def _(rates: Any) -> Any:
    """The rates of the three sensors are 60.67, 48.5, 70.67 %.

    {NUMBER1} of {NUMBER2} lie where 95 % of single runs would; ours are {rates.percent.ours} %.
    """
    return rates.agree, {"NUMBER1": sum(rates.agree), "NUMBER2": len(rates.agree)}


@claims.add("(10), Section 2.2")
def _(rates: Any) -> Any:
    """The threshold is a decreasing function of the innovation.

    As printed, (10) increases with |ε|, and then the sensors request in only
    {rates.percent.printed_sign} % of the steps. With -(b + c |ε|) it decreases; we take that.
    """
    printed, right = rates.falls
    return MISPRINT if right and not printed else printed


@claims.add("Section 6, Figure 3")
def _(rates: Any) -> Any:
    """The thresholds adapt to the innovations.

    After a request the threshold differs in {share:%} of the steps.
    """
    share = rates.changes[0].mean()
    return below(0, rates.changes[0]), locals()


@claims.add("Section 6, Figure 3")
def _(rates: Any) -> Any:
    """The threshold changes when the sensor is not triggered.

    After a step without a request it changes in {share:%} of the steps: by (10) and (11) only
    a request changes it.
    """
    share = rates.changes[1].mean()
    return share > 0, locals()


@claims.add("Section 2.2")
def _(rates: Any) -> Any:
    """With a = 0 the mechanism is the time trigger, with c = 0 one with a fixed threshold.

    a = 0: rates {rates.percent.timed} %. c = 0: the threshold varies by {rates.unmoved:g}, and the
    rates are {rates.percent.fixed} %.
    """
    return [(rates.percent.timed == 100).all(), rates.unmoved == 0]


# --- errors and variances -------------------------------------------------------------------------


@claims.add("Section 6, Figure 4")
def _(fusion: Any) -> Any:
    """Both fused estimates track well.

    They explain at least {least:.2f} % of every state's mean square about its start.
    """
    follows = 1 - fusion.at.square.mean(-1) / fusion.at.level.mean(-1)
    least = 100 * follows.min()
    return follows > 0.99, locals()


@claims.add("Section 6, Figure 5")
def _(fusion: Any) -> Any:
    """The MSE is close to the trace of the actual error variance.

    It differs by {fusion.relative[0]} % (SCI) and {fusion.relative[1]} % (SICI) of the trace; we
    call 10 % close. The
    trigger depends on the noise, and the actual variance neglects this.
    """
    return _close(fusion.relative)


@claims.add("Section 6, Figure 5")
def _(fusion: Any) -> Any:
    """The MSE lies below the trace of the conservative error variance.

    On average over the episode, and at {sci:.2f} % (SCI) and {sici:.2f} % (SICI) of the steps.
    """
    sci, sici = 100 * (fusion.at.mse_steps <= fusion.at.conservative_steps).mean(-1)
    return below(fusion.at.mse, fusion.at.conservative), locals()


@claims.add("Section 6, Figures 7 and 8")
def _(fusion: Any) -> Any:
    """More than 99 % of the fused errors lie within three actual standard deviations.

    {count} of {inside.size} shares (rule, set of variances, state) exceed 99 %; the least is
    {least:.2f} %. Over states and sets: SCI {sci:.2f} %, SICI {sici:.2f} %.
    """
    inside = fusion.inside
    least, (sci, sici) = 100 * inside.min(), 100 * inside.mean((1, 2))
    count = (inside > 0.99).sum()
    return inside > 0.99, locals()


@claims.add("Section 6, Figures 7 and 8")
def _(fusion: Any) -> Any:
    """The actual deviations never exceed the robust ones, in all three groups.

    Least share of the steps over states, by group: SCI {fusion.ordered[0]:%}; SICI
    {fusion.ordered[1]:%}.
    """
    return always(fusion.ordered, fusion.episodes)


@claims.add("Theorem 1, (31); Figure 9")
def _(fusion: Any) -> Any:
    """Every node's conservative variance bounds its actual one.

    P - P̄ is positive semidefinite in {fusion.node_share:%} of the steps, nodes and sets of
    variances.
    """
    return always(fusion.node_share, fusion.episodes)


@claims.add("Theorem 1")
def _(fusion: Any) -> Any:
    """It is the least such bound: at the bounds of the variances both are equal.

    They differ by at most {fusion.gap:.1g} of the largest entry.
    """
    return fusion.gap < 1e-9 or not fusion.reached


@claims.add("Corollary 2, (46)")
def _(fusion: Any) -> Any:
    """SCI's conservative variance bounds its actual one.

    In {least:%} of the steps; the largest ratio of actual to conservative variance in any
    direction is {fusion.worst[0]:.3f}.
    """
    least = fusion.bounded[0].min()
    return always(fusion.bounded[0], fusion.episodes), locals()


@claims.add("Theorem 5, (63)")
def _(fusion: Any) -> Any:
    """SICI's conservative variance bounds its actual one.

    P - P̄ is positive semidefinite in {shares} of the steps, by actual variances; the largest
    ratio in any direction is {fusion.worst[1]:.2f}. Real errors, mean square in their largest
    direction after whitening with P (1 is the bound): {fusion.real[0]} when every sensor
    always transmits, {fusion.real[1]} under the trigger.
    """
    pairs = zip(fusion.bounded[1], fusion.settings, strict=True)
    shares = ", ".join(f"{percent(share)} ({name})" for share, name in pairs)
    return always(fusion.bounded[1], fusion.episodes), locals()


@claims.add("Corollary 1, (43); Theorem 4, (55)")
def _(fusion: Any) -> Any:
    """P̄ is the covariance of the actual fused errors.

    Traces: relative differences of {differences}.
    """
    pairs = zip(fusion.rules, fusion.relative, fusion.independent, strict=True)
    differences = "; ".join(
        f"{name} {cite(dependent)} % under the trigger, {cite(independent)} % with the requests of "
        "another episode"
        for name, dependent, independent in pairs
    )
    return [_close(fusion.relative), _close(fusion.independent)], locals()


# --- the two rules --------------------------------------------------------------------------------


@claims.add("Section 6, Figure 6")
def _(fusion: Any) -> Any:
    """SICI is more accurate than SCI.

    MSE {sici} against {sci}; SICI is the better in {runs:%} of the runs, and its mean over
    runs at {steps:%} of the steps 400 to 600.
    """
    (sci, sici), (late, sici_late) = fusion.at.mse, fusion.late
    runs, steps = (sici < sci).mean(), (sici_late < late).mean()
    return [below(sici, sci), sici_late.mean() < late.mean()], locals()


@claims.add("Remark 3")
def _(fusion: Any) -> Any:
    """SICI has higher accuracy, better tightness and better consistency than SCI.

    Accuracy: as above. Tightness: conservative trace {sici_bound} against {bound}. Consistency:
    its variance is a bound in {sici_share:%} of the steps, SCI's in {share:%}.
    """
    (sci, sici), (bound, sici_bound) = fusion.at.mse, fusion.at.conservative
    share, sici_share = fusion.bounded[:, 0]
    return [below(sici, sci), below(sici_bound, bound), sici_share > share], locals()


@claims.add("Remark 3")
def _(fusion: Any) -> Any:
    """SICI costs more than SCI, because of multiple inverses.

    At each weight (42) inverts {fusion.inverses[0]} matrices and (54) {fusion.inverses[1]}. After
    one joint diagonalisation of both covariances neither rule needs another inverse.
    """
    return fusion.inverses[1] > fusion.inverses[0]


@claims.add("Section 6, Figure 9")
def _(fusion: Any) -> Any:
    """The robust accuracy of both fusions is higher than each sensor's.

    The fused conservative trace is at most a node's in at least {beats[0]:%} (SCI) and
    {beats[1]:%} (SICI) of the steps; MSE of the nodes: {fusion.node}.
    """
    beats = fusion.at.beats.mean(-1).min(-1)
    return [beats > 0.99, *(below(mse, fusion.node) for mse in fusion.at.mse)], locals()


@claims.add("Section 6, Figure 9")
def _(fusion: Any) -> Any:
    """The nodes' conservative ellipses contain the ellipses of both fusions.

    Share of the steps for sensors 1 to 3, of position and velocity only: SCI
    {fusion.plane[0]:%}; SICI {fusion.plane[1]:%}. Of all three states: SCI {fusion.whole[0]:%};
    SICI {fusion.whole[1]:%}. A smaller trace does not imply a smaller matrix.
    """
    return [fusion.whole > 0.99, fusion.plane > 0.99]


@claims.add("Abstract, Section 6")
def _(fusion: Any) -> Any:
    """The trigger saves communication while the estimation stays effective.

    Against always transmitting the MSE is larger by {fusion.price[0]} % (SCI) and
    {fusion.price[1]} % (SICI); with as many requests that do not depend on the noise it is
    {fusion.other[0]} and {fusion.other[1]} against {fusion.at.mse[0]} and {fusion.at.mse[1]}.
    """
    return below(fusion.at.mse, fusion.other)


def _close(relative: Any) -> list[Any]:
    return [below(-10.0, relative), below(relative, 10.0)]
