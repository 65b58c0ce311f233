"""The version of this package; cached results name it."""

__version__ = "0.1.0"
