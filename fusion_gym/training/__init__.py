"""One training: its config, the algorithms, the model, what watches it."""
