"""Scripts: training, evaluation, the demo. Run them with ``python -m agents.NAME``."""
