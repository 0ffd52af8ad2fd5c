"""Trials: the spaces that arguments are drawn from, what a trial is asked, how it can end, and the result."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
