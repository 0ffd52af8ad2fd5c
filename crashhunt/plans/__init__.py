"""Plans: the user's request for a hunt, the settings in ``hunt.toml`` that result from it, and all options of hunts."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
