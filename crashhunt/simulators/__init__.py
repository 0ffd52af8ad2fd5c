"""Simulators: the world that agents drive in. Nothing here imports libsumo; `crashhunt.sumo` does."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
