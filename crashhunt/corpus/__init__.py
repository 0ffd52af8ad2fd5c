"""A corpus: crashes that somebody keeps in their own repository, each with what is expected of today's code."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
