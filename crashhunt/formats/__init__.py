"""Export of a recorded crash as a scenario for other tools.

The files are written as plain XML with Python's standard library. ``scripts/tools/readers`` tests that the formats' own
libraries read back the recorded values. These libraries are not needed for writing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
