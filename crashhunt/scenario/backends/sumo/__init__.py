"""SUMO in scenarios: its configurations, options and files, and the options for untrusted scenarios."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
