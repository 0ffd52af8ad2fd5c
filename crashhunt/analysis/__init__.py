"""Trials run again with a change: what-if runs, avoidability, causes, and minimization."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
