"""Re-seeds SUMO's random generators in a running simulation, with symbols that libsumo's library exports.

libsumo has no function for re-seeding. SUMO reads ``--seed`` at load, and a simulation after ``simulation.loadState``
deviates from the original (`crashhunt guide sumo`). The library exports the generators and ``RandHelper::initRand``,
which seeds them at load. The memory layout of the generators differs between versions of libsumo. Therefore other
versions are refused, and each seed is read back after it was written.
"""

from __future__ import annotations

import ctypes
from functools import cache

import numpy as np

_CHECKED_VERSIONS = ("1.28.0",)
"""The versions of libsumo in which the generators were found as they are described here."""
_GENERATOR_BYTES = 5048  # a SumoRNG: its name, its count, and the 624 words of a Mersenne Twister
_LANE_GENERATORS_SYMBOL = (
    "_ZN6MSLane6myRNGsE"  # std::vector<SumoRNG>: noise of the drivers, by the lane on which a vehicle departs
)
_SINGLE_GENERATOR_SYMBOLS = (
    "_ZN10RandHelper23myRandomNumberGeneratorE",  # everything that has no generator of its own
    "_ZN16SUMORouteHandler12myParsingRNGE",  # what is drawn where routes are read, such as types from distributions
    "_ZN8MSDevice14myEquipmentRNGE",  # which vehicles get a device
    "_ZN9OUProcess5myRNGE",  # errors of perception of drivers with a driver state
    "_ZN12MSDevice_ToC17myResponseTimeRNGE",  # response times of drivers who take over
)
_SEED_SYMBOL = "_ZN10RandHelper8initRandEP7SumoRNGbi"  # RandHelper::initRand(SumoRNG*, bool random, int seed)
_READ_SYMBOL = "_ZN10RandHelper7getSeedEP7SumoRNG"  # RandHelper::getSeed(SumoRNG*)


@cache
def why_no_reseeding(libsumo: str, library: str) -> str:
    """Return why the generators cannot be re-seeded with a version of libsumo; empty if they can."""
    if libsumo not in _CHECKED_VERSIONS:
        return f"libsumo {libsumo} was not checked for re-seeding (checked: {', '.join(_CHECKED_VERSIONS)})"
    try:
        loaded = ctypes.CDLL(library)
        for name in (_LANE_GENERATORS_SYMBOL, *_SINGLE_GENERATOR_SYMBOLS, _SEED_SYMBOL, _READ_SYMBOL):
            getattr(loaded, name)
    except (OSError, AttributeError) as error:
        return f"libsumo's generators cannot be re-seeded: {error}"
    return ""


def reseed_generators(library: str, seed: int) -> int:
    """Give each random generator of the running simulation its own seed, derived from one seed.

    Args:
        library: The path of libsumo's library, for which `why_no_reseeding` returned an empty text.
        seed: A seed of at least 0.

    Returns:
        The number of re-seeded generators.

    Raises:
        RuntimeError: The generators have an unknown layout; the simulation must then be discarded.
    """
    loaded = ctypes.CDLL(library)
    first, last, _ = (ctypes.c_void_p * 3).in_dll(loaded, _LANE_GENERATORS_SYMBOL)
    size = (last or 0) - (first or 0)
    if first is None or size <= 0 or size % _GENERATOR_BYTES:
        raise RuntimeError(f"the random generators in libsumo's lanes have an unknown memory layout ({size} bytes)")
    places = [first + offset for offset in range(0, size, _GENERATOR_BYTES)]
    places += [
        ctypes.addressof((ctypes.c_char * _GENERATOR_BYTES).in_dll(loaded, name)) for name in _SINGLE_GENERATOR_SYMBOLS
    ]
    set_seed, get_seed = loaded[_SEED_SYMBOL], loaded[_READ_SYMBOL]
    set_seed.argtypes, set_seed.restype = (ctypes.c_void_p, ctypes.c_bool, ctypes.c_int), None
    get_seed.argtypes, get_seed.restype = (ctypes.c_void_p,), ctypes.c_int
    # SUMO gives all generators the same seed. A SeedSequence gives each its own seed, also for successive seeds.
    drawn = np.random.SeedSequence(seed).generate_state(len(places)) >> 1
    for place, value in zip(places, drawn.tolist(), strict=True):
        set_seed(place, False, value)
        if get_seed(place) != value:
            raise RuntimeError("a random generator of libsumo does not keep the seed that was written to it")
    return len(places)
