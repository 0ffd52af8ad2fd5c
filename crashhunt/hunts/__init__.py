"""Hunts: the loop, its directory and ledger, and everything that can be asked of them afterwards."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
