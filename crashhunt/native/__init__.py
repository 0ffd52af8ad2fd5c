"""The compiled core: what every step on SUMO does, in C++, where it is there; optional, and never another bit."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
