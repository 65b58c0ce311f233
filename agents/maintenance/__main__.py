"""The maintainers' commands: ``python -m fusion_gym.agents.maintenance COMMAND``."""

from ..__main__ import MAINTENANCE, main

if __name__ == "__main__":
    main(MAINTENANCE)
