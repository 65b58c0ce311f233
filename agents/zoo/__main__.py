"""Run ``python -m agents.zoo``."""

from agents.zoo.zoo import Zoo

if __name__ == "__main__":
    Zoo.main()
