"""highway-env: the simulator, the description of its table in a scenario, and its accelerator."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
