"""Oracles: whether a step is a crash, and how near to one it came."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
