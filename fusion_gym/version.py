"""The version of this package; cached results name it."""

__version__ = "0.2.0.dev0"
