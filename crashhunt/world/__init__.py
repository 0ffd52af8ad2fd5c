"""What is on the road at one step, and how near things are: scenes, outlines, contacts, the closest approach."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
