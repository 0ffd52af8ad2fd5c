"""Replays: run a crash again, compare the run with the recording, edit it, or examine it in a debugger or a window."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
