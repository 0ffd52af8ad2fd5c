"""The version of crashhunt."""

__version__ = "0.1.0"
