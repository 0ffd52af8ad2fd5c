"""What-if runs: the trial of a recorded crash runs again many times with a change, and the outcomes are counted."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
