"""Seeds of SUMO's random generators: in an imitation of libsumo's library, and in libsumo itself."""

from __future__ import annotations

import ctypes
import itertools
from types import SimpleNamespace

import pytest

from crashhunt.native import _generators, reseed_generators, why_no_reseeding
from crashhunt.scenario import argument_values

BYTES = _generators._GENERATOR_BYTES


class Kind:
    """A type of ctypes, whose objects lie in the imitation."""

    def __init__(self, kind) -> None:
        self.kind = kind

    def __mul__(self, count):
        return Kind(self.kind * count)

    def in_dll(self, library, name):
        return self.kind.from_buffer(library.memory[name])


class Library:
    """Imitates the symbols of libsumo; notes the seed of each generator by its address.

    Args:
        lanes: number of the generators of lanes.
        more: bytes by which the vector of these generators is longer.
    """

    def __init__(self, lanes: int, more: int = 0) -> None:
        self.seeds: dict[int, int] = {}
        self.forgets = False
        self.vector = ctypes.create_string_buffer(BYTES * lanes + 8)
        first = ctypes.addressof(self.vector) if lanes else 0
        ends = (ctypes.c_void_p * 3)(first, first + BYTES * lanes + more, first)
        self.memory = {_generators._LANE_GENERATORS_SYMBOL: ends}
        self.memory |= {name: ctypes.create_string_buffer(BYTES) for name in _generators._SINGLE_GENERATOR_SYMBOLS}

        def write(place, is_random, seed):
            assert is_random is False
            assert -(2**31) <= seed < 2**31
            self.seeds[place] = seed

        def read(place):
            return -1 if self.forgets else self.seeds[place]

        self.functions = {_generators._SEED_SYMBOL: write, _generators._READ_SYMBOL: read}

    def __getitem__(self, name):
        return self.functions[name]


@pytest.fixture
def imitate(monkeypatch):
    def imitate(library):
        known = {name: getattr(ctypes, name) for name in ("addressof", "c_bool", "c_int")}
        kinds = {name: Kind(getattr(ctypes, name)) for name in ("c_void_p", "c_char")}
        monkeypatch.setattr(_generators, "ctypes", SimpleNamespace(CDLL=lambda path: library, **known, **kinds))
        return library

    return imitate


def test_each_generator_gets_its_own_seed_and_equal_seeds_give_equal_ones(imitate):
    found = []
    for seed in (3, 3, 4):
        library = imitate(Library(lanes=4))
        assert reseed_generators("libsumo.so", seed) == 4 + 5
        first = ctypes.addressof(library.vector)
        places = {first + BYTES * n for n in range(4)}
        places |= {ctypes.addressof(library.memory[name]) for name in _generators._SINGLE_GENERATOR_SYMBOLS}
        assert set(library.seeds) == places
        found.append(list(library.seeds.values()))
    assert found[0] == found[1]
    assert not set(found[0]) & set(found[2])
    assert len(set(found[0])) == 9
    assert max(itertools.chain(*found)) > 2**30  # all 31 bits are used


@pytest.mark.parametrize(("lanes", "more"), [(0, 0), (2, 1), (2, -3 * BYTES)])
def test_unknown_layout_is_refused_before_anything_is_written(imitate, lanes, more):
    library = imitate(Library(lanes, more))
    with pytest.raises(RuntimeError, match=rf"unknown memory layout \({lanes * BYTES + more} bytes\)"):
        reseed_generators("libsumo.so", 3)
    assert library.seeds == {}


def test_seed_that_is_not_kept_is_refused(imitate):
    library = imitate(Library(lanes=1))
    library.forgets = True
    with pytest.raises(RuntimeError, match="does not keep the seed"):
        reseed_generators("libsumo.so", 3)


def test_reason_names_the_version_or_the_missing_symbol(monkeypatch):
    monkeypatch.setattr(_generators, "_CHECKED_VERSIONS", ("1.28.0",))  # a nightly job adds the newest one
    assert why_no_reseeding("1.0.0", "none") == "libsumo 1.0.0 was not checked for re-seeding (checked: 1.28.0)"
    assert why_no_reseeding("1.28.0", "/nowhere.so").startswith("libsumo's generators cannot be re-seeded: /nowhere.so")
    python = ctypes.pythonapi._name or ""
    assert "undefined symbol: _ZN6MSLane6myRNGsE" in why_no_reseeding("1.28.0", python)


def test_running_simulation_has_the_seeds_and_continues_by_them(sumo_runs):
    simulator = sumo_runs.open("loop")
    if simulator.why_no_reseeding:
        pytest.skip(simulator.why_no_reseeding)
    speeds = []
    for seed in (7, 7, 8):
        simulator.reset(seed=1, options={"arguments": argument_values(simulator._scenario)})
        simulator.reseed(seed)
        for _ in range(20):
            simulator.step({"ego": simulator.actions["ego"].encode((8.0, 0))})
        speeds.append(list(simulator.scene().speeds))
    assert speeds[0] == speeds[1] != speeds[2]
