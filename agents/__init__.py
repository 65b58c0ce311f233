"""The commands (train, evaluate, benchmark, …) as modules, and in rooms what they share."""
