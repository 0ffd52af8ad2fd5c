"""The descriptors of the simulators that come with crashhunt: a module or package for each, named after it.

Each module has a ``BACKEND`` with the dataclass of its table, its checks and its files. Nothing here imports a
simulator.
"""

__all__ = ["DEFAULT_SIMULATOR"]

DEFAULT_SIMULATOR = "sumo"
"""The simulator of a ``scenario.toml`` without one. It may never change: it is part of the file format, and messages to
workers of older versions omit default values."""
