"""A plant with an unknown input: unknown_input."""
