"""What-if runs: a recorded crash is run again with something changed, many times, and the outcomes are counted."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
