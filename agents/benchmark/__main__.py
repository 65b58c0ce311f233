"""Run ``python -m agents.benchmark``."""

from agents.benchmark.command import Benchmark

if __name__ == "__main__":
    Benchmark.main()
