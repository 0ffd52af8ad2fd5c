"""Gymnasium and PettingZoo environments as a simulator, and the description of their table in a scenario."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
