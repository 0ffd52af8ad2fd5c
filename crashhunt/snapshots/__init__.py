"""Snapshots: the code, scenario and versions that a hunt ran with, stored in its directory."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
