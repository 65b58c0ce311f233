"""Run ``python -m agents.papers``."""

from agents.papers.reproduce import Reproduce

if __name__ == "__main__":
    Reproduce.main()
