"""The compiled parts: the optional core with bit-identical results, and the library for the order of SUMO's links."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
