"""Scenarios: network, traffic, controlled vehicles and arguments, from ``scenario.toml`` or a SUMO configuration."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
