"""Panels: plain data that show an agent's internal state; Pillow is imported when a panel is drawn."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
