"""The descriptors of the simulators that come with crashhunt, a module or package each, by the simulator's name.

Each has a ``BACKEND``, with the dataclass of its table, checks and files. Nothing here imports a simulator.
"""

__all__ = ["DEFAULT_SIMULATOR"]

DEFAULT_SIMULATOR = "sumo"
"""What a ``scenario.toml`` means that names none. Part of the file format, and of what is sent to workers of older
versions, which leaves out what is at its default: it may never change."""
