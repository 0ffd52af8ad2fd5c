"""Plans: what was asked of a hunt, resolved and kept in ``hunt.toml``, and the trials that follow from it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
