"""Recordings: the black box during a trial, ``log.mcap`` of kept trials, and the comparison of two recordings.

Writing and reading logs needs MCAP and protobuf, which a worker never does, so these libraries are imported at first
use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
