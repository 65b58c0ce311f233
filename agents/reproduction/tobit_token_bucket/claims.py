"""What the token-bucket paper's Section 4 and introduction say of its figures, held to data."""

from typing import Any

import numpy as np

from ..judging import below, estimate, percent, told, verdict
from ..shown import Claim
from .runs import SENSORS

_NODES = range(SENSORS)


def of_network(found: dict[str, Any]) -> list[Claim]:
    """Claims about events and tokens."""
    wanted, spent = estimate(found["wanted"]), estimate(found["spent"])
    more, less = estimate(found["mse"]), estimate(found["mse_unlimited"])
    rates = [estimate(rate) for rate in found["rate_requested"]]
    kept = [
        found["poor_grants"] == 0,
        found["uncalled_grants"] == 0,
        found["lowest"] >= 0.0 and found["highest"] <= found["capacity"],
    ]
    return [
        Claim(
            "A measurement is sent only if its event occurs and there are tokens for it.",
            "Remark 2, (18)-(20)",
            verdict(kept),
            f"Of {found['grants']:,} transmissions {found['uncalled_grants']} had no event and "
            f"{found['poor_grants']} fewer than {found['needed']:g} tokens; of the events with as "
            f"many, {found['rich_refusals']} were refused. Levels from {found['lowest']:g} to "
            f"{found['highest']:g} of {found['capacity']:g}.",
        ),
        Claim(
            "The event trigger saves communication.",
            "Section 1",
            verdict(rate.high < 1.0 for rate in rates),
            "Share of steps with an event, by node: " + ", ".join(told(rate) for rate in rates)
            + ", where always sending has 1.",
        ),
        Claim(
            "An event trigger alone does not keep the network from being overused; the bucket "
            "does.",
            "Section 1",
            verdict((wanted.low > found["rate"], spent.high <= found["rate"])),
            f"Without a bucket the events cost {told(wanted)} tokens a step, where "
            f"{found['rate']:g} are generated; with it {told(spent)} are spent.",
        ),
        Claim(
            "What the bucket refuses costs accuracy: it acts on the filtering error.",
            "Remark 4",
            verdict([below(found["mse_unlimited"], found["mse"])]),
            f"Mean squared error {told(more)} with the bucket, {told(less)} without.",
        ),
    ]  # fmt: skip


def of_estimates(found: dict[str, Any]) -> list[Claim]:
    """Claims about Figures 5 to 7."""
    local, fused = found["local_change"], found["fused_change"]
    means = local.mean(-1)
    strongest = np.unravel_index(int(means.argmax()), means.shape)
    censored = estimate(found["change_censored"])
    seen = estimate(found["change_uncensored"])
    said = local[2, 1]
    rougher = all(below(fused[s], local[m, s]) for m in _NODES for s in range(2))
    largest = all(below(local[m, s], said) for m in _NODES for s in range(2) if (m, s) != (2, 1))
    by_censoring = below(found["change_uncensored"], found["change_censored"])
    listed = ", ".join(f"node {m + 1} {means[m, 0]:.3f} and {means[m, 1]:.3f}" for m in _NODES)
    smoother = [below(found["moved"], found["alone_moved"][m]) for m in _NODES]
    better = [below(found["mse"], found["alone_mse"][m]) for m in _NODES]
    return [
        Claim(
            "Censoring makes the local estimates fluctuate, most of all that of the second state "
            "at node 3.",
            "Section 4, of Figures 5-7",
            verdict((rougher, largest, by_censoring)),
            f"Change of the error from step to step, first and second state: {listed}; fused "
            f"{fused.mean(-1)[0]:.3f} and {fused.mean(-1)[1]:.3f}. Every node fluctuates more than "
            f"the centre: {'yes' if rougher else 'no'}. Strongest: node {strongest[0] + 1}, state "
            f"{strongest[1] + 1}. Second state at node 3: {told(censored)} where it is censored, "
            f"{told(seen)} where it is not.",
        ),
        Claim(
            "The fused estimate, fed back, smooths the local filters' fluctuations.",
            "Section 4, of Figures 5-7",
            verdict(smoother),
            "Step-to-step change of the estimate, mean of both states: "
            f"{told(estimate(found['moved']))} of the centre with feedback; of nodes that work by "
            "themselves with a third of the bucket "
            + ", ".join(told(estimate(found["alone_moved"][m])) for m in _NODES)
            + ".",
        ),
        Claim(
            "The fusion scheme is effective: better than its nodes by themselves.",
            "Section 4, last paragraph",
            verdict(better),
            f"Mean squared error {told(estimate(found['mse']))} of the scheme, at "
            f"{found['rate']:.3f} transmissions a node and step; nodes by themselves with a third "
            "of the bucket "
            + ", ".join(
                f"{told(estimate(found['alone_mse'][m]))} at {found['alone_rate'][m]:.3f}"
                for m in _NODES
            )
            + ".",
        ),
    ]  # fmt: skip


def of_errors(found: dict[str, Any]) -> list[Claim]:
    """Claims about Figures 8 to 10."""
    local, fused = found["by_local_error"], found["by_fused_error"]
    shares = [estimate(share) for share in found["share_error"]]
    lower = [below(fused, local[m]) for m in _NODES]
    rough, smooth = found["rough_local_error"], found["rough_fused_error"]
    gaps = [estimate(fused - local[m]) for m in _NODES]
    times = found["by_fused_trace"].mean() / fused.mean()
    return [
        Claim(
            "The trace of the fused bound is smaller than that of every node.",
            "Section 4, of Figures 8-10",
            verdict(bool(np.all(share == 1.0)) for share in found["share_trace"]),
            "In "
            + ", ".join(percent(float(share.mean())) for share in found["share_trace"])
            + " of all steps beside nodes 1, 2, 3. It cannot be otherwise: by (50) the fused bound "
            "is the inverse of a sum that holds every node's inverse. It says nothing of errors: "
            f"the fused bound is {times:.0f} times the error.",
        ),
        Claim(
            "In most cases the squared error of the fused estimate is smaller than the local one.",
            "Section 4, of Figures 8-10",
            verdict(share.low > 0.5 for share in shares),
            "Share of steps, beside nodes 1, 2, 3: " + ", ".join(told(share) for share in shares)
            + ".",
        ),
        Claim(
            "Fusion improves the mean squared error of every node.",
            "Section 4, last paragraph",
            verdict(lower),
            f"Fused {told(estimate(fused))}; nodes "
            + ", ".join(told(estimate(local[m])) for m in _NODES)
            + "; fused minus local, paired, "
            + ", ".join(told(gap, 2) for gap in gaps)
            + ".",
        ),
        Claim(
            "The fused error's curve is relatively smooth.",
            "Section 4, of Figures 8-10",
            verdict(below(smooth, rough[m]) for m in _NODES),
            "Mean change of lg of the squared error from step to step: fused "
            f"{told(estimate(smooth))}, nodes "
            + ", ".join(told(estimate(rough[m])) for m in _NODES)
            + ".",
        ),
    ]  # fmt: skip
