"""The verdict over a setting's finished pieces of work."""

from __future__ import annotations

from typing import Any

from fusion_gym.evaluation.envelope import points_of

from ..output.files import load_results, read_json, write
from .classes import names_of, trained
from .committed import Shelf
from .config import Setting, Suite
from .jobs import Folders, finished, jobs
from .reports import VERDICT
from .verdict import judge
from .worth import Tested, at_rates, worths


def conclude(
    suite: Suite, setting: Setting, folders: Folders, shelf: Shelf
) -> dict[str, Any] | None:
    """The verdict over whatever agents of a setting are finished, written as ``verdict.json``.

    Raises:
        ConfigurationError: results that are damaged or were made from other settings.
    """
    every = jobs(suite, [setting], names_of(suite), shelf)
    pieces = [job for job in every if finished(job, suite, folders)]
    reports = {job.name: read_json(folders.report(job), "results") for job in pieces}
    found = {
        job.name: load_results(folders.episodes(job), reports[job.name]["made_from"])
        for job in pieces
    }
    if "baselines" not in found:
        return None
    rules, known = found["baselines"], found.get("references", {})
    references = {"sensors": found.get("informed", {}) | known, "centre": known, "local": {}}
    always = float(rules["always"].rate.mean())
    committed, tested, classes = shelf.classes(setting), {}, {}
    for of in trained(suite, setting):
        own = committed[of.name]
        envelope = {vertex["name"]: rules[vertex["name"]] for vertex in own["vertices"]}
        done = [job.name for job in pieces if job.of == of]
        agents = [list(found[job].values()) for job in done]
        tested[of.name] = Tested(of, envelope, agents, own["searches"])
        if done:
            prices = reports[done[0]]["prices"]
            clairvoyant = found.get("hindsight", {}) if of.packet == "measurement" else {}
            ahead = references[of.mode] if of.packet == "measurement" else {}
            classes[of.name] = {
                **judge(agents, prices, envelope, ahead, always, clairvoyant, own["searches"]),
                "at": at_rates(tested[of.name], always),
                "mode": of.mode,
                "memory": of.memory,
                "broadcast": of.broadcast,
                "packet": of.packet,
                "knows": of.knows,
                "sha256": own["sha256"],
                "envelope": [point._asdict() for point in points_of(envelope)],
            }
    verdict = {
        "setting": setting.name,
        "title": setting.title,
        "always": always,
        "classes": classes,
        "worth": worths(tested, always),
    }
    write(folders.results / setting.name / VERDICT, verdict)
    return verdict
