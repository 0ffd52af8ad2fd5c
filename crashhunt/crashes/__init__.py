"""Crashes: the bundle of one, its archive, how near it came, whether braking would have helped, whom to trust."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
