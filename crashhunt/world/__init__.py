"""The road at one step and the distances on it: scenes, outlines, contacts, closest approach and criticality."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
