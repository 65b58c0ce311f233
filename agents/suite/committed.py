"""The tables of a setting's envelopes: made piece by piece, read with its hashes checked."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fusion_gym.evaluation.envelope import EnvelopePoint
from fusion_gym.validation import ConfigurationError

from ..output.folders import check_inputs
from . import envelopes
from .classes import Class, classes_of
from .config import Setting, Suite
from .tables import Row, grouped, read_rows, write_rows
from .team import Team
from .workers import Work, side_by_side

FOLDER = "envelopes"  # of the table for readers, in that of the results
TABLES = ("setting", "vertices", "searches", "curves", "classes")  # written in this order
_POINT = ("name", "rate", "mse")


def path_of(results: Path, setting: str) -> Path:
    """Where the index of a setting's envelopes is, which is written last."""
    return results / setting / f"{TABLES[-1]}.csv"


def read_envelopes(folder: Path) -> dict[str, Any]:
    """Return the envelopes in a setting's folder.

    Raises:
        ConfigurationError: a table cannot be read, is of another shape, or a class is not what
            its hash says.
    """
    result: dict[str, Any] = dict(*read_rows(folder, "setting", "envelopes")[:1])
    vertices, searches = (
        grouped(read_rows(folder, table, "envelopes"), "class") for table in TABLES[1:3]
    )
    result |= {"setting": folder.name, "classes": {}, "curves": []}
    for row in read_rows(folder, "classes", "envelopes"):
        name, sha256 = row.pop("class"), row.pop("sha256")
        by_seed = grouped(searches.get(name, []), "seed")
        content = {"broadcast": None} | row | {
            "vertices": [_nested(vertex) for vertex in vertices.get(name, [])],
            "searches": [[[p["rate"], p["mse"]] for p in points] for points in by_seed.values()],
        }  # fmt: skip
        if envelopes.digest(result.get("inputs", {}), name, content) != sha256:
            path = str(path_of(folder.parent, folder.name))
            raise ConfigurationError(
                f"envelopes = {path!r}: sha256 = {sha256[:12]!r}… of the class {name!r} is not "
                "that of what the tables hold: they were changed after they were written"
            )
        result["classes"][name] = content | {"sha256": sha256}
    curves: dict[tuple[str, str], dict[str, Any]] = {}
    for row in read_rows(folder, "curves", "envelopes"):
        curve = {key: row[key] for key in ("family", "options", "trials")} | {"points": []}
        curve = curves.setdefault((row["family"], str(row["options"])), curve)
        curve["points"].append({key: row[key] for key in _POINT})
    return result | {"curves": list(curves.values())}


def _nested(row: dict[str, Any]) -> dict[str, Any]:
    """Return a vertex as its hash is made of."""
    for kind in ("tuning", "test"):
        row[kind] = {"rate": row.pop(f"{kind}_rate"), "mse": row.pop(f"{kind}_mse")}
    return row


def write_envelopes(folder: Path, content: Mapping[str, Any]) -> None:
    """Write the tables of a setting's envelopes, the index of classes at the end.

    Whoever reads after a kill finds the classes that were there before: their rows stay the same.
    """
    classes = content["classes"]
    tables: dict[str, list[dict[str, Any]]] = {
        "setting": [dict(content)],
        "vertices": [
            {**vertex, "class": name}
            | {f"{kind}_{key}": vertex[kind][key] for kind in ("tuning", "test")
               for key in ("rate", "mse")}
            for name, of in classes.items() for vertex in of["vertices"]
        ],
        "searches": [
            {"class": name, "seed": seed, "rate": rate, "mse": mse}
            for name, of in classes.items()
            for seed, points in enumerate(of["searches"]) for rate, mse in points
        ],
        "curves": [curve | point for curve in content["curves"] for point in curve["points"]],
        "classes": [{**of, "class": name} for name, of in classes.items()],
    }  # fmt: skip
    for table in TABLES:
        write_rows(folder, table, tables[table])


def hull_of(content: Mapping[str, Any]) -> list[EnvelopePoint]:
    """Return a committed class's envelope on the test seeds."""
    points = [
        EnvelopePoint(v["name"], v["test"]["rate"], v["test"]["mse"]["mean"])
        for v in content["vertices"]
    ]
    return sorted(points, key=lambda point: (point.rate, point.mse))


def measured(folder: Path) -> tuple[list[EnvelopePoint], int]:
    """Return the rollout in a setting's folder, if it was run, and its number of episodes.

    Raises:
        ConfigurationError: the table is of another shape.
    """
    rows = read_rows(folder, "rollout") if (folder / "rollout.csv").exists() else []
    points = [EnvelopePoint(f"{row['rate']}", row["rate"], row["mse"]["mean"]) for row in rows]
    episodes = rows[0]["episodes"] if rows else 0
    return sorted(points, key=lambda point: point.rate), episodes


def bound_of(folder: Path) -> Row | None:
    """Return the lower bound in a setting's folder, if it was computed.

    Raises:
        ConfigurationError: the table is of another shape.
    """
    rows = read_rows(folder, "bounds") if (folder / "bounds.csv").exists() else []
    return rows[0] | {"costs": rows} if rows else None


def at_least(bound: Row, rate: float) -> float:
    """Return the least error at a rate that the prices' lines leave, between two rates as well."""
    packets = bound["sensors"] * rate
    lines = [cost["lower"] - cost["price"] * packets for cost in bound["costs"]]
    return float(max([bound["floor"], *lines]))


def present(suite: Suite, setting: Setting, results: Path) -> dict[str, Any]:
    """The classes of a setting that are there, by name, made from these inputs.

    Raises:
        ConfigurationError: as :func:`read_envelopes`, or they were made from other inputs.
    """
    path = path_of(results, setting.name)
    if not path.exists():
        return {}
    content = read_envelopes(path.parent)
    check_inputs(envelopes.envelope_inputs(suite, setting), content["inputs"], repr(str(path)))
    return content["classes"]


class Shelf(NamedTuple):
    """Where the envelopes are that agents are compared with, and the suite that made them."""

    suite: Suite
    results: Path

    def classes(self, setting: Setting) -> dict[str, Any]:
        """What is there of a setting, as :func:`present`."""
        return present(self.suite, setting, self.results)

    def envelopes(self, setting: Setting) -> dict[str, Any]:
        """What is there of a setting; nothing, if that was made from another suite."""
        try:
            return self.classes(setting)
        except ConfigurationError:
            return {}

    def vertices(self, setting: Setting, names: Sequence[str]) -> list[dict[str, Any]]:
        """The rules of some classes, each once."""
        classes = self.classes(setting)
        result = {v["name"]: v for name in names for v in classes[name]["vertices"]}
        return list(result.values())


def complete(
    suite: Suite, settings: Sequence[Setting], names: Sequence[str], results: Path, work: Path,
    team: Team,
) -> None:  # fmt: skip
    """Tune, choose and measure what is missing of these classes (none: all), setting by setting.

    Everything is made once before anything runs, so that a family that does not fit is told.

    Raises:
        ConfigurationError: a family that does not fit, or envelopes made from other inputs.
    """
    missing = {}
    for setting in settings:
        there = present(suite, setting, results)
        every = [c for c in classes_of(setting) if not names or c.name in names]
        missing[setting.name] = [c for c in every if c.name not in there]
        for search in envelopes.searches_of(suite, setting, missing[setting.name]):
            search.check()
    for setting in settings:
        if missing[setting.name]:
            _complete(suite, setting, missing[setting.name], results, work, team)


def _complete(
    suite: Suite, setting: Setting, required: Sequence[Class], results: Path, work: Path, team: Team
) -> None:
    searches = envelopes.searches_of(suite, setting, required)
    left = [search for search in searches if not search.path(work).exists()]
    left.sort(key=lambda search: -len(search.family.parameters))  # the long ones first
    side_by_side(
        [Work(10.0, envelopes.run_search, (item, work)) for item in left],
        team,
        f"{setting.name}: tuning",
    )
    vertices = [
        vertex
        for of in required
        for vertex in envelopes.select_candidates(
            envelopes.candidates_of(setting, of, searches, work)[0]
        )
    ]
    tests = {item.path(work): item for item in envelopes.tests_of(suite, setting, vertices)}
    side_by_side(
        [
            Work(2.0, envelopes.run_test, (test, work))
            for path, test in tests.items()
            if not path.exists()
        ],
        team,
        f"{setting.name}: testing",
    )
    classes = present(suite, setting, results)
    inputs = envelopes.envelope_inputs(suite, setting)
    for of in required:
        content = envelopes.content_of(suite, setting, of, searches, work)
        classes[of.name] = content | {"sha256": envelopes.digest(inputs, of.name, content)}
    task, path = envelopes.envelope_task(setting), path_of(results, setting.name)
    earlier = read_envelopes(path.parent)["curves"] if path.exists() else []
    curves = merged_curves(earlier, list(envelopes.curves_of(searches, work)))
    always = next(curve for curve in curves if curve["family"] == "always")
    order = [c.name for c in classes_of(setting)]
    report = {
        "setting": setting.name,
        "title": setting.title,
        "env": setting.environment.id,
        "options": setting.environment.options,
        "horizon": task.horizon,
        "always": always["points"][0]["rate"],
        "inputs": inputs,
        "classes": {name: classes[name] for name in order if name in classes},
        "curves": curves,
    }
    write_envelopes(path.parent, report)


def merged_curves(
    earlier: Sequence[dict[str, Any]], new: Sequence[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Each family's curve in each world, once: classes that are added take none away."""
    every = {(item["family"], str(item["options"])): item for item in (*earlier, *new)}
    return list(every.values())
