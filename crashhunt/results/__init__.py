"""What the directory of a hunt says: its state, its trials, its crashes, and which code ran them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
