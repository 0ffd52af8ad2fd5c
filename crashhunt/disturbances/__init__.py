"""Disturbances: draws faults of other actors and of the agent's sensors, and returns their log-likelihood."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
