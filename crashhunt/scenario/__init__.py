"""Scenarios: what a trial takes place in, read from ``scenario.toml`` or from a configuration of SUMO."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
