"""Trials on all machines of a Ray cluster; Ray itself is imported in a separate process."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
