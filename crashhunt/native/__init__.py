"""The compiled parts: the core, which is optional and never another bit, and the fixed order of SUMO's links."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
