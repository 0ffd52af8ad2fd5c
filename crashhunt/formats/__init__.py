"""A crash in formats of others: what was recorded, as a scenario that tools of other people run.

Written as plain XML with what Python brings along. ``scripts/readers`` tests that the libraries of the formats read
back what was recorded. Writing does not need them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
