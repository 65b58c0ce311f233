"""A Python that has imported what all programs of an environment import, and forks one for each.

Importing torch takes longer than most blocks of the documentation do. What runs is in a process of
its own, in its own folder and with its own output; nothing of one reaches another.
"""

from __future__ import annotations

import os
import signal
import subprocess
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from wheel_environments import Environment

PRELOADED = (
    *("gymnasium", "numpy", "fusion_gym", "fusion_gym.evaluation", "torch", "stable_baselines3"),
    *(f"fusion_gym.agents.{name}" for name in ("train", "evaluate", "mismatch", "bound", "watch")),
)
_SERVER = """
import contextlib, importlib, json, os, socket, sys, types
place, *modules = sys.argv[1:]
for name in modules:
    with contextlib.suppress(ImportError):
        importlib.import_module(name)
import fusion_gym
assert fusion_gym.__file__.startswith(sys.prefix), fusion_gym.__file__
server = socket.socket(socket.AF_UNIX)
server.bind(place)
server.listen()
server.settimeout(1.0)
parent = os.getppid()
while True:
    try:
        client, _ = server.accept()
    except TimeoutError:
        if os.getppid() != parent:  # which was ended from outside
            os._exit(1)
        continue
    client.setblocking(True)
    text, streams, _, _ = socket.recv_fds(client, 1_000_000, 3)
    child = os.fork()
    if child == 0:
        break
    for stream in streams:
        os.close(stream)
    _, status, used = os.wait4(child, 0)
    with open(place + ".seconds", "a") as file:
        print(used.ru_utime + used.ru_stime, file=file)
    client.sendall(str(os.waitstatus_to_exitcode(status)).encode())
    client.close()
for number, stream in enumerate(streams):
    os.dup2(stream, number)
sys.stdin, sys.stdout, sys.stderr = open(0), open(1, "w"), open(2, "w", buffering=1)
folder, sys.argv, variables = json.loads(text)
os.environ.clear()
os.environ.update(variables)
os.chdir(folder)
sys.path.insert(0, os.path.dirname(os.path.abspath(sys.argv[0])))
if os.path.basename(sys.argv[0]) == "fusion-gym":
    from fusion_gym.agents.__main__ import main
    sys.exit(main())
module = sys.modules["__main__"] = types.ModuleType("__main__")
module.__file__ = sys.argv[0]
with open(sys.argv[0], encoding="utf-8") as file:
    exec(compile(file.read(), sys.argv[0], "exec"), module.__dict__)
"""
_CLIENT = """#!{python} -ISE
import json, os, socket, sys
client = socket.socket(socket.AF_UNIX)
client.connect({place!r})
words = sys.argv if {program} else sys.argv[1:]
text = json.dumps([os.getcwd(), words, dict(os.environ)])
socket.send_fds(client, [text.encode()], [0, 1, 2])
code = int(client.recv(32) or 1)
sys.exit(code if code >= 0 else 128 - code)
"""


@dataclass(frozen=True)
class Warm:
    """The warm Python of an environment; ``variables`` are those of all its programs."""

    environment: Environment
    variables: dict[str, str]

    @property
    def place(self) -> Path:
        """Of its socket."""
        return self.environment.folder / "warm"

    @cached_property
    def programs(self) -> Path:
        """A folder with ``fusion-gym`` and ``run``, which takes a script: both end in the fork."""
        folder = self.environment.folder / "warm_programs"
        folder.mkdir()
        for name in ("fusion-gym", "run"):
            text = _CLIENT.format(
                python=self.environment.programs / "python",
                place=str(self.place),
                program=name == "fusion-gym",
            )
            (folder / name).write_text(text)
            (folder / name).chmod(0o755)
        return folder

    @cached_property
    def process(self) -> subprocess.Popen[bytes]:
        """The server, which is there when it has imported everything."""
        words = [str(self.environment.programs / "python"), "-Pc", _SERVER, str(self.place)]
        process = subprocess.Popen([*words, *PRELOADED], env=self.variables, start_new_session=True)
        while not self.place.exists():
            if process.poll() is not None:
                raise SystemExit("the warm Python has ended")
            time.sleep(0.02)
        return process

    @property
    def seconds(self) -> float:
        """Of the processor, for all that has ended."""
        file = Path(f"{self.place}.seconds")
        return sum(map(float, file.read_text().split())) if file.exists() else 0.0

    def end(self) -> None:
        """Nothing more is asked of it, and what is unfinished ends."""
        process = self.__dict__.pop("process", None)
        if process is not None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            self.place.unlink()
