"""Training on crashes: the environment ``crashhunt/Crashes-v0``, the split of seeds, and ``trained_on.json``."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
