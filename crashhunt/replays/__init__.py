"""Replays: a crash run again, compared with its recording, edited, or looked at in a debugger or a window."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
