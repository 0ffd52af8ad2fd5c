"""A crash made smaller while it stays the same kind of crash: fewer others, plainer arguments, fewer disturbances."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
