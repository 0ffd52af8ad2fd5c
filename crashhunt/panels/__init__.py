"""Panels: what an agent shows of itself. Plain data; Pillow is imported when one is drawn."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
