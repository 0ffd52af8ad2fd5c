"""Recordings: the black box while it happens, ``log.mcap`` of what is kept, and the comparison of two.

Writing and reading logs needs MCAP and protobuf, which a worker never does: they are imported at first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
