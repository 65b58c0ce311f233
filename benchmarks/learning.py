"""Measure this machine's steps per second in settings with a course, for the tables of learning.

    python -m benchmarks.learning [SETTING …] [--work runs/benchmark/full]

``fusion-gym benchmark --parts learning`` puts them beside how fast agents learn.
"""

import argparse
import statistics
import time
from pathlib import Path

from fusion_gym.agents.experiments.config import Setting, load_suite
from fusion_gym.agents.experiments.learning import throughput_path
from fusion_gym.agents.output.ending import report_errors
from fusion_gym.agents.output.files import write
from fusion_gym.validation import choice

from .throughput import measured, remembering, vector


def main() -> None:
    """Measure the settings that the command line names, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("settings", nargs="*", metavar="SETTING", help="all by default")
    parser.add_argument("--config", default="benchmark", help="a YAML file or a shipped config")
    parser.add_argument("--work", type=Path, default=Path("runs/benchmark/full"))
    arguments = parser.parse_args()
    with report_errors():
        every = {item.name: item for item in load_suite(arguments.config).settings if item.course}
        for name in arguments.settings or every:
            setting = every[choice("setting", name, every)]
            write(throughput_path(arguments.work, name), measure_throughput(setting))


def measure_throughput(setting: Setting, seconds: float = 0.3) -> dict[str, int]:
    """Return the steps per second of the processor in a setting."""
    where, clock = setting.environment, time.process_time
    rows = {
        "make_vec": vector(where.options, 1024, where.id, clock),
        "without": remembering(where.id, where.options, "without", clock=clock),
        "values": remembering(where.id, where.options, "values", clock=clock),
    }
    turns = measured(rows, seconds)
    return {name: round(statistics.median(speeds)) for name, speeds in turns.items()}


if __name__ == "__main__":
    main()
