"""SUMO's XML library, kept ready between trials."""

from __future__ import annotations

import ctypes

from libsumo import _libsumo as sumo

__all__ = ["keep_xml_ready"]

# xercesc_3_2::XMLPlatformUtils::Initialize(locale, nls_home, panic_handler, memory_manager)
_INITIALIZE = "_ZN11xercesc_3_216XMLPlatformUtils10InitializeEPKcS2_PNS_12PanicHandlerEPNS_13MemoryManagerE"


def keep_xml_ready() -> bool:
    """Have SUMO's XML library outlive the simulation that runs; return whether that was possible.

    SUMO ends it after each simulation, and begins it anew with the next, tables of Unicode and all, which is a third
    of the time that a small network takes to load. The library counts who has begun it: with one that never ends, the
    others only count. Called once a process, while a simulation runs: then it does nothing else.
    """
    try:
        initialize = getattr(ctypes.CDLL(sumo.__file__), _INITIALIZE)
    except (OSError, AttributeError):  # another version of it, or built into libsumo: it costs time, and nothing else
        return False
    initialize.argtypes = [ctypes.c_void_p] * 4
    initialize.restype = None
    initialize(None, None, None, None)
    return True
