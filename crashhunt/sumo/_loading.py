"""Loads simulations into the process's only SUMO instance, with the links of the network in a fixed order."""

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


# SUMO's XML library, which stays initialized between trials.

# xercesc_3_2::XMLPlatformUtils::Initialize(locale, nls_home, panic_handler, memory_manager)
_XERCES_INITIALIZE_SYMBOL = (
    "_ZN11xercesc_3_216XMLPlatformUtils10InitializeEPKcS2_PNS_12PanicHandlerEPNS_13MemoryManagerE"
)


@cache
def keep_xml_ready() -> bool:
    """Keep SUMO's XML library (Xerces) initialized after the running simulation; return whether that was possible.

    SUMO terminates the library after each simulation and initializes it again for the next one. Each initialization
    builds Unicode tables, which takes a third of the time for loading a small network. The library counts its
    initializations. With one more initialization, the count never reaches 0, so that the tables stay. Call this
    function once per process, while a simulation runs.
    """
    try:
        initialize = getattr(ctypes.CDLL(sumo.__file__), _XERCES_INITIALIZE_SYMBOL)
    except (
        OSError,
        AttributeError,
    ):  # another version, or linked statically into libsumo: loading is slower, but correct
        return False
    initialize.argtypes = [ctypes.c_void_p] * 4
    initialize.restype = None
    initialize(None, None, None, None)
    return True


VERSION = metadata.version("libsumo")  # libsumo before 1.26 has no version attribute
_LINK_ORDER_WARNING = "the order of SUMO's links is not fixed, and trials may differ between processes"


class Loading:
    """Loads simulations into the process's SUMO instance.

    Args:
        fix_link_order: Whether SUMO processes the links of a network in the order of their construction. By default,
            SUMO processes them in the order of their memory addresses, which differs between processes.
    """

    def __init__(self, *, fix_link_order: bool) -> None:
        self._order = link_order(VERSION, sumo.__file__)
        self._fix_link_order = fix_link_order

    def load(self, program: Sequence[str], command: Sequence[str]) -> str:
        """Load a simulation.

        Only the first simulation of a process uses the program and its options.

        Returns:
            A notice if the order of links is not fixed although the library for it is installed; otherwise empty. The
            hunt reports a missing library when it begins.
        """
        self._order.use(self._fix_link_order)
        if libsumo.isLoaded():
            libsumo.load(list(command))
        else:
            libsumo.start([*program, *command])
            keep_xml_ready()
        reason = self._order.check_load()
        if not reason or not self._fix_link_order or why_no_link_order(VERSION):
            return ""
        return f"{_LINK_ORDER_WARNING}: {reason}"
