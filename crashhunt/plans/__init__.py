"""Plans: the request of a hunt, its resolved settings in ``hunt.toml``, and the options."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
