"""Export of a recorded crash as a scenario for other tools.

Written as plain XML with what Python brings along. ``scripts/readers`` tests that the libraries of the formats read
back what was recorded. Writing does not need them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
