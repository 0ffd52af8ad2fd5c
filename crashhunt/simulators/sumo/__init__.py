"""SUMO as a simulator, through libsumo, which is imported when a simulator is created."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
