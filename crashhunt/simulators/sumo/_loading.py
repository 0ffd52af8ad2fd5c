"""How a simulation is loaded: in the process's only simulator, with the links of its network in a fixed order."""

from __future__ import annotations

import ctypes
from functools import cache
from importlib import metadata
from typing import TYPE_CHECKING

import libsumo
from libsumo import _libsumo as sumo

from crashhunt.native import link_order, why_no_link_order

if TYPE_CHECKING:
    from collections.abc import Sequence


__all__ = ["VERSION", "Loading", "keep_xml_ready", "ready_xml"]


# SUMO's XML library, kept ready between trials.

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


VERSION = metadata.version("libsumo")  # the module itself has had it since 1.26
_UNORDERED = "the order of SUMO's links is not fixed, and trials may differ between processes"
ready_xml = cache(keep_xml_ready)
"""Keep SUMO's XML library ready, once a process."""


class Loading:
    """Loads simulations.

    Args:
        fix_link_order: whether the links of a network are processed in the order of their construction; otherwise in
            the order of their addresses, as SUMO does by itself.
    """

    def __init__(self, *, fix_link_order: bool) -> None:
        self._order = link_order(VERSION, sumo.__file__)
        self._fix_link_order = fix_link_order

    def load(self, program: Sequence[str], command: Sequence[str]) -> str:
        """Load a simulation.

        Args:
            program: the program and its options, which count for the first simulation of a process only.
            command: SUMO's options for the simulation.

        Returns:
            What to report where the order of links is not fixed, though its library is installed; otherwise empty.
            A library that is not installed is reported when the hunt begins.
        """
        self._order.use(self._fix_link_order)
        if libsumo.isLoaded():
            libsumo.load(list(command))
        else:
            libsumo.start([*program, *command])
            ready_xml()
        reason = self._order.check_load()
        if not reason or not self._fix_link_order or why_no_link_order(VERSION):
            return ""
        return f"{_UNORDERED}: {reason}"
