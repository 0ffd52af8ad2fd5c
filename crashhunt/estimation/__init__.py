"""Estimation: crash rates and comparisons of agents from the trials of hunts, with intervals."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
