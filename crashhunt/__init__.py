"""A parallel crash-hunting fuzzer for traffic agents."""

__version__ = "0.1.0"
