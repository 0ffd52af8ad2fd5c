"""The episode: the only place where agent, simulator, oracle and recorder interact."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
