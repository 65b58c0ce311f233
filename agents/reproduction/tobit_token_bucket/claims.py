"""What the token-bucket paper's Section 4 and introduction say of its figures, held to data."""

from typing import Any

import numpy as np

from ..judging import below, cite, estimate, percent, verdict
from ..piece_result import Claim
from .runs import SENSORS

_NODES = range(SENSORS)


def of_network(data: dict[str, Any]) -> list[Claim]:
    """Claims about events and tokens."""
    required, spent = estimate(data["wanted"]), estimate(data["spent"])
    more, less = estimate(data["mse"]), estimate(data["mse_unlimited"])
    rates = [estimate(rate) for rate in data["rate_requested"]]
    stored = [
        data["poor_grants"] == 0,
        data["uncalled_grants"] == 0,
        data["lowest"] >= 0.0 and data["highest"] <= data["capacity"],
    ]
    return [
        Claim(
            "A measurement is sent only if its event occurs and there are tokens for it.",
            "Remark 2, (18)-(20)",
            verdict(stored),
            f"Of {data['grants']:,} transmissions {data['uncalled_grants']} had no event and "
            f"{data['poor_grants']} fewer than {data['needed']:g} tokens; of the events with as "
            f"many, {data['rich_refusals']} were refused. Levels from {data['lowest']:g} to "
            f"{data['highest']:g} of {data['capacity']:g}.",
        ),
        Claim(
            "The event trigger saves communication.",
            "Section 1",
            verdict(rate.high < 1.0 for rate in rates),
            "Share of steps with an event, by node: " + ", ".join(cite(rate) for rate in rates)
            + ", where always sending has 1.",
        ),
        Claim(
            "An event trigger alone does not keep the network from being overused; the bucket "
            "does.",
            "Section 1",
            verdict((required.low > data["rate"], spent.high <= data["rate"])),
            f"Without a bucket the events cost {cite(required)} tokens a step, where "
            f"{data['rate']:g} are generated; with it {cite(spent)} are spent.",
        ),
        Claim(
            "What the bucket refuses costs accuracy: it acts on the filtering error.",
            "Remark 4",
            verdict([below(data["mse_unlimited"], data["mse"])]),
            f"Mean squared error {cite(more)} with the bucket, {cite(less)} without.",
        ),
    ]  # fmt: skip


def of_estimates(data: dict[str, Any]) -> list[Claim]:
    """Claims about Figures 5 to 7."""
    local, fused = data["local_change"], data["fused_change"]
    means = local.mean(-1)
    strongest = np.unravel_index(int(means.argmax()), means.shape)
    censored = estimate(data["change_censored"])
    observed = estimate(data["change_uncensored"])
    text = local[2, 1]
    rougher = all(below(fused[s], local[m, s]) for m in _NODES for s in range(2))
    largest = all(below(local[m, s], text) for m in _NODES for s in range(2) if (m, s) != (2, 1))
    by_censoring = below(data["change_uncensored"], data["change_censored"])
    listed = ", ".join(f"node {m + 1} {means[m, 0]:.3f} and {means[m, 1]:.3f}" for m in _NODES)
    smoother = [below(data["moved"], data["alone_moved"][m]) for m in _NODES]
    better = [below(data["mse"], data["alone_mse"][m]) for m in _NODES]
    return [
        Claim(
            "Censoring makes the local estimates fluctuate, most of all that of the second state "
            "at node 3.",
            "Section 4, of Figures 5-7",
            verdict((rougher, largest, by_censoring)),
            f"Change of the error from step to step, first and second state: {listed}; fused "
            f"{fused.mean(-1)[0]:.3f} and {fused.mean(-1)[1]:.3f}. Every node fluctuates more than "
            f"the centre: {'yes' if rougher else 'no'}. Strongest: node {strongest[0] + 1}, state "
            f"{strongest[1] + 1}. Second state at node 3: {cite(censored)} where it is censored, "
            f"{cite(observed)} where it is not.",
        ),
        Claim(
            "The fused estimate, fed back, smooths the local filters' fluctuations.",
            "Section 4, of Figures 5-7",
            verdict(smoother),
            "Step-to-step change of the estimate, mean of both states: "
            f"{cite(estimate(data['moved']))} of the centre with feedback; of nodes that work by "
            "themselves with a third of the bucket "
            + ", ".join(cite(estimate(data["alone_moved"][m])) for m in _NODES)
            + ".",
        ),
        Claim(
            "The fusion scheme is effective: better than its nodes by themselves.",
            "Section 4, last paragraph",
            verdict(better),
            f"Mean squared error {cite(estimate(data['mse']))} of the scheme, at "
            f"{data['rate']:.3f} transmissions a node and step; nodes by themselves with a third "
            "of the bucket "
            + ", ".join(
                f"{cite(estimate(data['alone_mse'][m]))} at {data['alone_rate'][m]:.3f}"
                for m in _NODES
            )
            + ".",
        ),
    ]  # fmt: skip


def of_errors(data: dict[str, Any]) -> list[Claim]:
    """Claims about Figures 8 to 10."""
    local, fused = data["by_local_error"], data["by_fused_error"]
    shares = [estimate(share) for share in data["share_error"]]
    lower = [below(fused, local[m]) for m in _NODES]
    rough, smooth = data["rough_local_error"], data["rough_fused_error"]
    gaps = [estimate(fused - local[m]) for m in _NODES]
    times = data["by_fused_trace"].mean() / fused.mean()
    return [
        Claim(
            "The trace of the fused bound is smaller than that of every node.",
            "Section 4, of Figures 8-10",
            verdict(bool(np.all(share == 1.0)) for share in data["share_trace"]),
            "In "
            + ", ".join(percent(float(share.mean())) for share in data["share_trace"])
            + " of all steps beside nodes 1, 2, 3. It cannot be otherwise: by (50) the fused bound "
            "is the inverse of a sum that holds every node's inverse. It says nothing of errors: "
            f"the fused bound is {times:.0f} times the error.",
        ),
        Claim(
            "In most cases the squared error of the fused estimate is smaller than the local one.",
            "Section 4, of Figures 8-10",
            verdict(share.low > 0.5 for share in shares),
            "Share of steps, beside nodes 1, 2, 3: " + ", ".join(cite(share) for share in shares)
            + ".",
        ),
        Claim(
            "Fusion improves the mean squared error of every node.",
            "Section 4, last paragraph",
            verdict(lower),
            f"Fused {cite(estimate(fused))}; nodes "
            + ", ".join(cite(estimate(local[m])) for m in _NODES)
            + "; fused minus local, paired, "
            + ", ".join(cite(gap, 2) for gap in gaps)
            + ".",
        ),
        Claim(
            "The fused error's curve is relatively smooth.",
            "Section 4, of Figures 8-10",
            verdict(below(smooth, rough[m]) for m in _NODES),
            "Mean change of lg of the squared error from step to step: fused "
            f"{cite(estimate(smooth))}, nodes "
            + ", ".join(cite(estimate(rough[m])) for m in _NODES)
            + ".",
        ),
    ]  # fmt: skip
