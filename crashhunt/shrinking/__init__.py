"""Minimization: fewer actors, simpler arguments and fewer disturbances, with the same crash type."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
