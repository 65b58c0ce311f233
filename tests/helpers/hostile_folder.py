"""A folder in which commands are tried: small configs and results, and much that is neither."""

import os
from pathlib import Path

import yaml

ENV = "fusion_gym/TobitOscillator-v1"

TRAINING = {
    "environment": {"id": ENV, "options": {"horizon": 4}},
    "algorithm": {"name": "ppo", "n_steps": 8, "batch_size": 16, "network": {"hidden": [4]}},
    "training": {"timesteps": 32, "num_envs": 2},
    "validation": {"every": 32, "episodes": 2},
    "output": "made",
}
ROWS = {"environment": ENV, "rows": [{"label": "a", "policy": "always"}]}
BROKEN: dict[str, bytes] = {
    "empty": b"",
    "text": b"this is no structure: at: all\n\t- x",
    "latin": "Größe: 1".encode("latin-1"),
    "binary": bytes(range(256)),
    "list": b"[1, 2]",
    "number": b"3",
    "null": b"null",
    "half": b'{"policies": {"always": ',
    "date": b"output: 2020-13-45",
    "deep": b"[" * 1050,
    "tag": b"!!python/object:os.system x",
    "stamp": b"output: !!timestamp x",
    "digits": b"output: " + b"9" * 5000,
    "itself": b"output: &a [*a]",
    "bomb": b"a0: &a0 [1]\n"
    + b"".join(
        b"a%d: &a%d [%s]\n" % (n, n, b",".join([b"*a%d" % (n - 1)] * 9)) for n in range(1, 12)
    ),
    "merges": b"a0: &a0 {b: 1}\n"
    + b"".join(
        b"a%d: &a%d {<<: [%s]}\n" % (n, n, b",".join([b"*a%d" % (n - 1)] * 9)) for n in range(1, 12)
    ),
    "code": b"environment: {id: 'os:x', options: {error: 'os:abort'}}\npolicy: 'os:abort'",
    "sixty": b"training: {num_envs: 1:30}",
    "escape": b'output: "made\\0\\e[0m"',
    "twice": b"output: made\noutput: other",
    "other": b'{"something": {"else": 1}}',
}


def scratch(folder: Path) -> None:
    """A folder with what the tries need, where everybody may write."""
    configs = {"training": TRAINING, "rows": ROWS}
    for name, content in configs.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(content))
    for name, raw in BROKEN.items():
        for suffix in ("", ".yaml", ".json"):
            (folder / f"{name}{suffix}").write_bytes(raw)
    rows = (f"2026-01-01 {hour:02}:00,{hour}\n" for hour in range(24))
    (folder / "log.csv").write_text("time,a\n" + "".join(rows))
    (folder / "folder").mkdir()
    (folder / "folder" / "file").write_text("kept")
    (folder / "locked").mkdir()
    (folder / "locked" / "file.yaml").write_text("kept: 1")
    for name in ("loop", "loop.yaml"):
        (folder / name).symlink_to(name)
    os.mkfifo(folder / "pipe")
    for path in (folder, *folder.rglob("*")):
        if not path.is_symlink():
            path.chmod(0o777 if path.is_dir() else 0o666)
    (folder / "locked").chmod(0)


def contents(folder: Path) -> dict[str, bytes | None]:
    """All that is in a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }
