"""Disturbances: how likely it is that somebody around the agent errs, and which of it happens in which trial."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
