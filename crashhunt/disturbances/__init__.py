"""Disturbances: faults of other actors and of the agent's sensors, which are drawn with a known log-likelihood."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
