"""Crash rates: how often an agent crashes, intervals that are valid at any time, and the trials that count."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
