"""What the paper on the adaptive innovation trigger claims.

Source: adaptive_innovation, Section 6.
"""

from typing import Any

from agents.papers.claims import MISPRINT, Claims
from agents.papers.numbers import always, below, cite, percent

claims = Claims()
CLOSE = 10.0  # per cent of a trace

# --- the trigger ----------------------------------------------------------------------------------


@claims.add("Abstract, Section 6")
def _(rates: Any) -> Any:
    """The mechanism reduces the communication burden."""
    return below(rates.percent.ours, 100), (
        f"The sensors request in {cite(rates.percent.ours)} % of the steps, where a time trigger "
        "requests in all of them."
    )


@claims.add("Section 6")
def _(rates: Any) -> Any:
    """The rates of the three sensors are 60.67, 48.5, 70.67 %."""
    return rates.agree, (
        f"{sum(rates.agree)} of {len(rates.agree)} lie where 95 % of single runs would; ours are "
        f"{cite(rates.percent.ours)} %."
    )


@claims.add("(10), Section 2.2")
def _(rates: Any) -> Any:
    """The threshold is a decreasing function of the innovation."""
    printed, right = rates.falls
    return MISPRINT if right and not printed else printed, (
        "As printed, (10) increases with |ε|, and then the sensors request in only "
        f"{cite(rates.percent.printed_sign)} % of the steps. With -(b + c |ε|) it decreases; we "
        "take that."
    )


@claims.add("Section 6, Figure 3")
def _(rates: Any) -> Any:
    """The thresholds adapt to the innovations."""
    share = rates.changes[0]
    return below(0, share), (
        f"After a request the threshold differs in {percent(share.mean())} of the steps."
    )


@claims.add("Section 6, Figure 3")
def _(rates: Any) -> Any:
    """The threshold changes when the sensor is not triggered."""
    share = rates.changes[1]
    return share.max() > 0, (
        f"After a step without a request it changes in {percent(share.mean())} of the steps: by "
        "(10) and (11) only a request changes it."
    )


@claims.add("Section 2.2")
def _(rates: Any) -> Any:
    """With a = 0 the mechanism is the time trigger, with c = 0 one with a fixed threshold."""
    shares = rates.percent
    return [(shares.timed == 100).all(), rates.unmoved == 0], (
        f"a = 0: rates {cite(shares.timed)} %. c = 0: the threshold varies by {rates.unmoved:g}, "
        f"and the rates are {cite(shares.fixed)} %."
    )


# --- errors and variances -------------------------------------------------------------------------


@claims.add("Section 6, Figure 4")
def _(fusion: Any) -> Any:
    """Both fused estimates track well."""
    follows = 1 - fusion.at.square.mean(-1) / fusion.at.level.mean(-1)
    return follows > 0.99, (
        f"They explain at least {100 * follows.min():.2f} % of every state's mean square about its "
        "start."
    )


@claims.add("Section 6, Figure 5")
def _(fusion: Any) -> Any:
    """The MSE is close to the trace of the actual error variance."""
    sci, sici = map(cite, fusion.relative)
    return _close(fusion.relative), (
        f"It differs by {sci} % (SCI) and {sici} % (SICI) of the trace; we call {CLOSE:g} % close. "
        "The trigger depends on the noise, and the actual variance neglects this."
    )


@claims.add("Section 6, Figure 5")
def _(fusion: Any) -> Any:
    """The MSE lies below the trace of the conservative error variance."""
    sci, sici = 100 * (fusion.at.mse_steps <= fusion.at.conservative_steps).mean(-1)
    return below(fusion.at.mse, fusion.at.conservative), (
        f"On average over the episode, and at {sci:.2f} % (SCI) and {sici:.2f} % (SICI) of the "
        "steps."
    )


@claims.add("Section 6, Figures 7 and 8")
def _(fusion: Any) -> Any:
    """More than 99 % of the fused errors lie within three actual standard deviations."""
    inside = fusion.inside
    sci, sici = (100 * own.mean() for own in inside)
    return inside > 0.99, (
        f"{(inside > 0.99).sum()} of {inside.size} shares (rule, set of variances, state) exceed "
        f"99 %; the least is {100 * inside.min():.2f} %. Over states and sets: SCI {sci:.2f} %, "
        f"SICI {sici:.2f} %."
    )


@claims.add("Section 6, Figures 7 and 8")
def _(fusion: Any) -> Any:
    """The actual deviations never exceed the robust ones, in all three groups."""
    sci, sici = map(percent, fusion.ordered)
    return always(fusion.ordered, fusion.episodes), (
        f"Least share of the steps over states, by group: SCI {sci}; SICI {sici}."
    )


@claims.add("Theorem 1, (31); Figure 9")
def _(fusion: Any) -> Any:
    """Every node's conservative variance bounds its actual one."""
    return always(fusion.node_share, fusion.episodes), (
        f"P - P̄ is positive semidefinite in {percent(fusion.node_share)} of the steps, nodes and "
        "sets of variances."
    )


@claims.add("Theorem 1")
def _(fusion: Any) -> Any:
    """It is the least such bound: at the bounds of the variances both are equal."""
    return fusion.gap < 1e-9 or not fusion.reached, (
        f"They differ by at most {fusion.gap:.1g} of the largest entry."
    )


@claims.add("Corollary 2, (46)")
def _(fusion: Any) -> Any:
    """SCI's conservative variance bounds its actual one."""
    return always(fusion.bounded[0], fusion.episodes), (
        f"In {percent(fusion.bounded[0].min())} of the steps; the largest ratio of actual to "
        f"conservative variance in any direction is {fusion.worst[0]:.3f}."
    )


@claims.add("Theorem 5, (63)")
def _(fusion: Any) -> Any:
    """SICI's conservative variance bounds its actual one."""
    own = fusion.bounded[1]
    shares = (f"{percent(x)} ({name})" for x, name in zip(own, fusion.settings, strict=True))
    sending, triggered = map(cite, fusion.real)
    return always(own, fusion.episodes), (
        f"P - P̄ is positive semidefinite in {', '.join(shares)} of the steps, by actual variances; "
        f"the largest ratio in any direction is {fusion.worst[1]:.2f}. Real errors, mean square in "
        f"their largest direction after whitening with P (1 is the bound): {sending} when every "
        f"sensor always transmits, {triggered} under the trigger."
    )


@claims.add("Corollary 1, (43); Theorem 4, (55)")
def _(fusion: Any) -> Any:
    """P̄ is the covariance of the actual fused errors."""
    pairs = zip(fusion.rules, fusion.relative, fusion.independent, strict=True)
    differences = "; ".join(
        f"{name} {cite(dependent)} % under the trigger, {cite(independent)} % with the requests of "
        "another episode"
        for name, dependent, independent in pairs
    )
    conditions = [_close(fusion.relative), _close(fusion.independent)]
    return conditions, f"Traces: relative differences of {differences}."


# --- the two rules --------------------------------------------------------------------------------


@claims.add("Section 6, Figure 6")
def _(fusion: Any) -> Any:
    """SICI is more accurate than SCI."""
    (sci, sici), (late, sici_late) = fusion.at.mse, fusion.late
    return [below(sici, sci), sici_late.mean() < late.mean()], (
        f"MSE {cite(sici)} against {cite(sci)}; SICI is the better in "
        f"{percent((sici < sci).mean())} of the runs, and its mean over runs at "
        f"{percent((sici_late < late).mean())} of the steps 400 to 600."
    )


@claims.add("Remark 3")
def _(fusion: Any) -> Any:
    """SICI has higher accuracy, better tightness and better consistency than SCI."""
    (sci, sici), (bound, sici_bound) = fusion.at.mse, fusion.at.conservative
    share, sici_share = fusion.bounded[:, 0]
    return [below(sici, sci), below(sici_bound, bound), sici_share > share], (
        f"Accuracy: as above. Tightness: conservative trace {cite(sici_bound)} against "
        f"{cite(bound)}. Consistency: its variance is a bound in {percent(sici_share)} of the "
        f"steps, SCI's in {percent(share)}."
    )


@claims.add("Remark 3")
def _(fusion: Any) -> Any:
    """SICI costs more than SCI, because of multiple inverses."""
    few, many = fusion.inverses
    return many > few, (
        f"At each weight (42) inverts {few} matrices and (54) {many}. After one joint "
        "diagonalisation of both covariances neither rule needs another inverse."
    )


@claims.add("Section 6, Figure 9")
def _(fusion: Any) -> Any:
    """The robust accuracy of both fusions is higher than each sensor's."""
    beats = fusion.at.beats.mean(-1).min(-1)
    sci, sici = map(percent, beats)
    return [beats > 0.99, *(below(mse, fusion.node) for mse in fusion.at.mse)], (
        f"The fused conservative trace is at most a node's in at least {sci} (SCI) and {sici} "
        f"(SICI) of the steps; MSE of the nodes: {cite(fusion.node)}."
    )


@claims.add("Section 6, Figure 9")
def _(fusion: Any) -> Any:
    """The nodes' conservative ellipses contain the ellipses of both fusions."""
    plane, whole = (
        f"SCI {percent(sci)}; SICI {percent(sici)}" for sci, sici in (fusion.plane, fusion.whole)
    )
    return [fusion.whole > 0.99, fusion.plane > 0.99], (
        f"Share of the steps for sensors 1 to 3, of position and velocity only: {plane}. Of all "
        f"three states: {whole}. A smaller trace does not imply a smaller matrix."
    )


@claims.add("Abstract, Section 6")
def _(fusion: Any) -> Any:
    """The trigger saves communication while the estimation stays effective."""
    sci, sici = map(cite, fusion.price)
    others, ours = (" and ".join(map(cite, pair)) for pair in (fusion.other, fusion.at.mse))
    return below(fusion.at.mse, fusion.other), (
        f"Against always transmitting the MSE is larger by {sci} % (SCI) and {sici} % (SICI); with "
        f"as many requests that do not depend on the noise it is {others} against {ours}."
    )


def _close(relative: Any) -> list[Any]:
    return [below(-CLOSE, relative), below(relative, CLOSE)]
