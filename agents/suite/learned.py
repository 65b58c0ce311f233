"""What a study has found so far: its tables, made of the finished lessons."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from filelock import FileLock

from ..output.files import read_json
from .fronts import range_of
from .study import SOLVED, Kind, Lesson, Study
from .tables import grouped, read_rows, write_rows


def finished_lessons(study: Study, kind: Kind, seeds: int) -> list[dict[str, Any]]:
    """What the first so many seeds taught, as far as they are finished.

    Raises:
        ConfigurationError: a file is damaged, or was made from other inputs.
    """
    results = [Lesson(study, kind, seed).result() for seed in range(seeds)]
    return [result for result in results if result is not None]


def report(study: Study, seeds: int) -> dict[str, Any]:
    """Write the study's tables again and return what they hold; lessons may end side by side."""
    folder = study.report.parent
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(study.work / f".{study.setting.name}.lock"):
        speed = study.throughput
        write_study(
            folder,
            {
                "title": study.setting.title,
                "env": study.setting.environment.id,
                "course": study.course.model_dump(mode="json"),
                "prices": study.prices,
                "inner": study.inner,
                "seeds": seeds,
                "fronts": finished_lessons(study, "front", seeds),
                "plain": finished_lessons(study, "plain", min(seeds, study.learning.plain.seeds)),
            }
            | ({"throughput": read_json(speed, "work")} if speed.exists() else {}),
        )
    return read_study(folder)


def write_study(folder: Path, content: Mapping[str, Any]) -> None:
    """Write the tables of a study, the study itself at the end."""
    lessons = [
        {"kind": kind} | lesson
        for kind, key in (("front", "fronts"), ("plain", "plain"))
        for lesson in content[key]
    ]
    tables: dict[str, list[dict[str, Any]]] = {
        "learning_trainings": lessons,
        "learning_curves": [
            lesson | point | {"rate": rate, "mse": mse}
            for lesson in lessons
            for point in lesson["curve"]
            for rate, mse in point["front"]
        ],
        "learning_points": [
            {"seed": front["seed"]} | point
            for front in content["fronts"]
            for point in front["points"]
        ],
        "learning": [dict(content)],
    }
    for table, rows in tables.items():
        write_rows(folder, table, rows)


def read_study(folder: Path) -> dict[str, Any]:
    """Return what a study has found, from its tables.

    Raises:
        ConfigurationError: a table that cannot be read or is of another shape.
    """
    curves: dict[tuple[str, int], dict[int, dict[str, Any]]] = {}
    for row in read_rows(folder, "learning_curves", "output"):
        curve = curves.setdefault((row.pop("kind"), row.pop("seed")), {})
        place = [row.pop("rate"), row.pop("mse")]
        curve.setdefault(row["timesteps"], {"excess": None} | row | {"front": []})
        curve[row["timesteps"]]["front"].append(place)
    points = grouped(read_rows(folder, "learning_points", "output"), "seed")
    lessons: dict[str, list[dict[str, Any]]] = {"front": [], "plain": []}
    for row in read_rows(folder, "learning_trainings", "output"):
        kind = row.pop("kind")
        row["curve"] = list(curves.get((kind, row["seed"]), {}).values())
        if kind == "front":
            row["points"] = points.get(row["seed"], [])
        lessons[kind].append(row)
    result: dict[str, Any] = {"setting": folder.name, "throughput": None}
    result |= dict(*read_rows(folder, "learning", "output")[:1])
    result |= {"fronts": lessons["front"], "plain": lessons["plain"]}
    result["reached"] = {kind: [reached(item) for item in every] for kind, every in lessons.items()}
    return result | {"finished": judge_fronts(result)}


def reached(lesson: Mapping[str, Any]) -> dict[str, Any]:
    """When a training's front first was below the memoryless envelope over its whole range.

    Without ``first`` it never was, or there is no such envelope; ``above_later`` counts the
    measurements after it that were not below.
    """
    curve = lesson["curve"]
    result: dict[str, Any] = {
        "seed": lesson["seed"],
        "timesteps": curve[-1]["timesteps"],
        "cpu_seconds": curve[-1]["cpu_seconds"],
    }
    below = [place for place, point in enumerate(curve) if point.get("below")]
    if below:
        first, later = curve[below[0]], curve[below[0] :]
        result["first"] = {
            "timesteps": first["timesteps"],
            "cpu_seconds": first["cpu_seconds"],
            "excess": first["excess"],
            "rates": range_of(first["front"]),
            "above_later": sum(not point["below"] for point in later),
        }
    return result


def judge_fronts(study: Mapping[str, Any]) -> dict[str, Any] | None:
    """All seeds' finished fronts at the prices that count, beside what they are compared with.

    With an optimum all prices count, otherwise the inner ones. ``above`` are seeds and prices
    whose whole interval lies more than the allowed share above, ``worst`` has the largest
    difference, ``rates`` are the lowest and the highest, ``closed`` the share of the gaps to
    rollout and bound.
    """
    course = study["course"]
    counted = [course["against"] in SOLVED or inside for inside in study["inner"]]
    points = [
        point | {"seed": front["seed"]}
        for front in study["fronts"]
        for point, counts in zip(front["points"], counted, strict=True)
        if counts and "difference" in point
    ]
    if not points:
        return None
    above = [p for p in points if p["difference"]["low"] > course["allowed"]]
    worst = max(points, key=lambda point: float(point["difference"]["mean"]))
    return {
        "compared": len(points),
        "above": [{key: p[key] for key in ("seed", "price", "difference")} for p in above],
        "worst": {key: worst[key] for key in ("seed", "price", "difference")},
        "rates": [choose(point["rate"] for point in points) for choose in (min, max)],
        "mean": sum(p["difference"]["mean"] for p in points) / len(points),
        "closed": {name: closed(points, name) for name in ("rollout", "bound")},
    }


def closed(points: Sequence[Mapping[str, Any]], name: str) -> float | None:
    """The share of the gap between the envelope and what is known beyond it that is closed.

    Over all points whose rate has both; ``None`` where nothing lies between.
    """
    known = [point for point in points if name in point]
    gap = sum(point["envelope"] - point[name] for point in known)
    return sum(point["envelope"] - point["mse"] for point in known) / gap if gap > 0.0 else None
