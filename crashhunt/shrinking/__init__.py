"""Minimization: fewer actors, simpler arguments and fewer disturbances, while the crash type stays the same."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
