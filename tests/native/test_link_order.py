"""The fixed order of SUMO's links: the library by itself, in a simulator, and under two orders of addresses."""

from __future__ import annotations

import ctypes
import importlib.util
import json
import shutil
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import pytest

from crashhunt.native import LinkOrder, _link_order, link_order, why_no_link_order
from crashhunt.plans import RunSettings
from crashhunt.plans._plan import _with_notes
from crashhunt.scenario import load_order_change, load_order_of, load_scenario, with_recorded_load_order
from crashhunt.sumo import SumoSetup

ROOT = Path(__file__).parents[2]
NETS = ROOT / "tests" / "on_sumo" / "nets"
LIBRARY = importlib.util.find_spec("_crashhunt_link_order")
COMPILER = shutil.which("c++") or shutil.which("g++")
needs_library = pytest.mark.skipif(LIBRARY is None, reason="the library is not built")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C++ compiler")

# The part of libsumo that the library replaces. The recheck notes the pairs instead of appending to conflicts.
LIBSUMO = """
#include <new>
#include <set>
#include <utility>
class MSLane; class MSTrafficLightLogic;
enum class LinkDirection : int {}; enum class LinkState : int {};
int seen[64], count = 0;
class MSLink {
public:
    MSLink(MSLane*, MSLane*, MSLane*, LinkDirection, LinkState, double, double, bool, MSTrafficLightLogic*, int, bool);
    static void recheckSetRequestInformation();
    int number;
#ifdef OTHER_TYPE
    static int myRecheck[3];
#else
    static std::set<std::pair<MSLink*, MSLink*>> myRecheck;
#endif
};
MSLink::MSLink(MSLane*, MSLane*, MSLane*, LinkDirection, LinkState, double length, double, bool keep,
               MSTrafficLightLogic*, int index, bool indirect)
    : number(length == 2.5 && keep && !indirect ? index : -99) {}
#ifdef OTHER_TYPE
int MSLink::myRecheck[3];
void MSLink::recheckSetRequestInformation() {}
#else
std::set<std::pair<MSLink*, MSLink*>> MSLink::myRecheck;
void MSLink::recheckSetRequestInformation() {
    for (auto pair : myRecheck) {
        seen[count++] = pair.first->number;
        seen[count++] = pair.second->number;
    }
    myRecheck.clear();
}
// Constructs four links at the given places of an array, in the order 0, 1, 2, 3, and pairs them.
extern "C" int load(const int* places, int unknown) {
    static char memory[8][sizeof(MSLink)];
    MSLink* links[4];
    for (int i = 0; i < 4; i++) {
        links[i] = new (memory[places[i]])
            MSLink(0, 0, 0, LinkDirection(), LinkState(), 2.5, 0, true, 0, i, false);
    }
    if (unknown) {
        static MSLink* other = reinterpret_cast<MSLink*>(memory[7]);
        other->number = 9;
        links[3] = other;
    }
    MSLink::myRecheck = {{links[0], links[3]}, {links[0], links[1]}, {links[2], links[0]}, {links[1], links[2]}};
    count = 0;
    MSLink::recheckSetRequestInformation();
    return count;
}
#endif
"""
USE = """
import ctypes, json, sys
libsumo, order = ctypes.CDLL(sys.argv[1]), ctypes.CDLL(sys.argv[2])
bind = order.crashhunt_link_order_bind
bind.restype = ctypes.c_char_p
seen = []
def load(*places, unknown=0):
    count = libsumo.load((ctypes.c_int * 4)(*places), unknown)
    seen.append(list((ctypes.c_int * 64).in_dll(libsumo, "seen")[:count]))
exec(sys.argv[3])
loads = [order.crashhunt_link_order_ordered_loads(), order.crashhunt_link_order_unordered_loads()]
print(json.dumps([seen, loads]))
"""
IN_ORDER = [0, 1, 0, 3, 1, 2, 2, 0]
"""The pairs in the order of construction, which is that of their addresses too where these ascend."""


@pytest.fixture(scope="module")
def imitation(tmp_path_factory):
    """Return a function that compiles the imitation of libsumo with further arguments, once each."""
    folder, built = tmp_path_factory.mktemp("libsumo"), {}
    source = folder / "libsumo.cpp"
    source.write_text(LIBSUMO)

    def build(*arguments):
        if arguments not in built:
            built[arguments] = str(folder / f"libsumo{len(built)}.so")
            words = [COMPILER, "-std=c++17", "-fPIC", "-shared", *arguments, str(source), "-o", built[arguments]]
            subprocess.run(words, check=True)
        return built[arguments]

    return build


def used(libsumo: str, code: str):
    """Run code in a process that has loaded both libraries; return what was seen, and the numbers of loads."""
    words = [sys.executable, "-I", "-c", USE, libsumo, str(LIBRARY.origin), code]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert not done.returncode, done.stderr
    return json.loads(done.stdout)


@needs_library
@needs_compiler
def test_pairs_are_processed_in_the_order_of_construction(imitation):
    code = "assert bind(sys.argv[1].encode()) is None; load(0, 1, 2, 3); load(3, 2, 1, 0); load(1, 3, 0, 2)"
    seen, loads = used(imitation(), code)
    assert seen == [IN_ORDER] * 3
    assert loads == [3, 0]


@needs_library
@needs_compiler
def test_own_order_is_kept_where_it_is_asked_for_or_the_library_is_not_bound(imitation):
    seen, loads = used(imitation(), "load(3, 2, 1, 0)")
    (reverse,) = seen
    assert reverse != IN_ORDER
    assert loads == [0, 0]
    code = (
        "bind(sys.argv[1].encode()); order.crashhunt_link_order_use(0); load(3, 2, 1, 0); "
        "order.crashhunt_link_order_use(1); load(3, 2, 1, 0)"
    )
    assert used(imitation(), code) == [[reverse, IN_ORDER], [1, 1]]


@needs_library
@needs_compiler
def test_a_link_that_was_constructed_elsewhere_leaves_the_load_unordered(imitation):
    code = "bind(sys.argv[1].encode()); load(3, 2, 1, 0, unknown=1); load(3, 2, 1, 0)"
    (first, second), loads = used(imitation(), code)
    assert len(first) == 8
    assert 9 in first
    assert second == IN_ORDER
    assert loads == [1, 1]


@needs_library
@needs_compiler
@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("-DOTHER_TYPE",), "MSLink::myRecheck of libsumo is not an empty std::set"),
        (("-Wl,-Bsymbolic",), "libsumo calls functions of its class MSLink in another way"),
        (("-DMSLink=Another",), "libsumo lacks a function or variable of its class MSLink"),
    ],
)
def test_a_libsumo_that_is_built_in_another_way_is_left_alone(imitation, arguments, reason):
    code = f"assert bind(sys.argv[1].encode()) == {reason.encode()!r}; hasattr(libsumo, 'load') and load(3, 2, 1, 0)"
    seen, loads = used(imitation(*arguments), code)
    assert loads == [0, 0]
    assert seen == [] or len(seen[0]) == 8


@needs_library
def test_a_library_that_is_not_loaded_is_refused():
    code = "assert bind(b'/no/such/libsumo.so') == b'libsumo is not loaded'"
    assert used(str(LIBRARY.origin), code) == [[], [0, 0]]


def test_reason_names_what_is_missing(monkeypatch):
    monkeypatch.setattr(_link_order, "_load_library", lambda: "/somewhere/library.so")
    monkeypatch.setattr(_link_order, "_interface", lambda: _link_order._INTERFACE)
    assert why_no_link_order("1.28.0") == ""
    assert "this is 1.99.0" in why_no_link_order("1.99.0")
    monkeypatch.setattr(_link_order, "_interface", lambda: 77)
    assert "of another version of crashhunt (77 instead of 1)" in why_no_link_order("1.28.0")
    monkeypatch.setattr(_link_order, "_load_library", lambda: None)
    assert why_no_link_order("1.28.0") == "the library is not built"
    link_order.cache_clear()
    try:
        assert link_order("1.28.0", "libsumo.so").reason == "the library is not built"
    finally:
        link_order.cache_clear()


@pytest.mark.parametrize("content", [b"", b"no library"])
def test_a_damaged_library_is_of_no_version(monkeypatch, tmp_path, content):
    (tmp_path / "library.so").write_bytes(content)
    monkeypatch.setattr(_link_order, "_load_library", lambda: str(tmp_path / "library.so"))
    _link_order._interface.cache_clear()
    try:
        assert "(0 instead of 1)" in why_no_link_order("1.28.0")
    finally:
        _link_order._interface.cache_clear()


def sumo_scenario(folder: Path, **table: object):
    shutil.copy(NETS / "lefts.net.xml", folder)
    shutil.copy(NETS / "lefts.rou.xml", folder)
    (folder / "scenario.toml").write_text(
        'title = "t"\nschema = 1\nsimulator = "sumo"\nstep_length_s = 0.5\nwarmup_s = 0.0\n'
        '[sumo]\nnet = "lefts.net.xml"\nroutes = ["lefts.rou.xml"]\n'
        '[agents.ego]\nagent = "keep-lane"\nedges = ["WC", "CE"]\ndepart_lane = "1"\n'
    )
    scenario = load_scenario(folder)
    return scenario.with_table(replace(scenario.table(SumoSetup), **table))


def simulator(folder: Path, **table: object):
    from crashhunt.sumo import SumoSimulator

    return closing(SumoSimulator(sumo_scenario(folder, **table), folder))


@needs_library
@pytest.mark.parametrize("native", [None, False])
@pytest.mark.parametrize("fix", [None, False])
def test_each_load_of_a_simulator_is_ordered_with_and_without_the_core(tmp_path, native, fix):
    library = ctypes.CDLL(str(LIBRARY.origin))
    counts = library.crashhunt_link_order_ordered_loads, library.crashhunt_link_order_unordered_loads
    with simulator(tmp_path, native=native, fix_link_order=fix) as made:
        before = [count() for count in counts]
        made.reset(seed=1)
        made.reset(seed=2)
        assert [count() - earlier for count, earlier in zip(counts, before, strict=True)] == (
            [2, 0] if fix is None else [0, 2]
        )
        assert made.notices == []


@needs_library
def test_a_load_that_is_not_ordered_is_reported_once(tmp_path, monkeypatch):
    monkeypatch.setattr(LinkOrder, "check_load", lambda _: "libsumo does not call the library")
    with simulator(tmp_path) as made:
        made.reset(seed=1)
        made.reset(seed=2)
        (notice,) = made.notices
    assert notice == (
        "the order of SUMO's links is not fixed, and trials may differ between processes: "
        "libsumo does not call the library"
    )


@needs_library
def test_check_load_reports_whether_the_library_was_called():
    loads = [(0, 0), (1, 0), (1, 1), (1, 1)]
    order = LinkOrder(None, "")
    order._count_calls = lambda: loads.pop(0)  # type: ignore[method-assign]
    order._loads = order._count_calls()
    assert order.check_load() == ""
    assert order.check_load() == "libsumo constructs links in another way"
    assert order.check_load() == "libsumo does not call the library"


def test_recorded_order_is_kept(tmp_path, monkeypatch):
    scenario = sumo_scenario(tmp_path)
    for recorded, kept in ((None, False), ("not fixed: the library is not built", False), ("fixed", None)):
        assert with_recorded_load_order(scenario, recorded).table(SumoSetup).fix_link_order is kept
    monkeypatch.setattr(_link_order, "_load_library", lambda: None)
    missing = "not fixed: the library is not built"
    assert load_order_of(scenario) == missing
    assert load_order_change(scenario, "fixed") == f"the order of SUMO's links was fixed and is {missing}"
    assert load_order_change(scenario, missing) == load_order_change(scenario, None) == ""
    own = with_recorded_load_order(scenario, None)
    assert load_order_of(own) == "not fixed: the scenario says so"
    toy = replace(scenario, simulator="toy")
    assert load_order_of(toy) is None
    assert with_recorded_load_order(toy, None) is toy


def test_hunt_states_where_the_order_is_not_fixed(tmp_path, monkeypatch):
    scenario = sumo_scenario(tmp_path)
    monkeypatch.setattr(_link_order, "_load_library", lambda: "/somewhere/library.so")
    monkeypatch.setattr(_link_order, "_interface", lambda: _link_order._INTERFACE)
    monkeypatch.setattr(metadata, "version", lambda _: "1.28.0")
    assert not [note for note in _with_notes(scenario, RunSettings()).notes if "order" in note]
    text = (tmp_path / "scenario.toml").read_text().replace("[sumo]\n", "[sumo]\nfix_link_order = false\n")
    (tmp_path / "scenario.toml").write_text(text)
    (note,) = (note for note in _with_notes(load_scenario(tmp_path), RunSettings()).notes if "order" in note)
    assert note == (
        "the order of SUMO's links is not fixed: the scenario says so; a trial may differ between processes"
    )
    monkeypatch.setattr(_link_order, "_load_library", lambda: None)
    (note,) = (note for note in _with_notes(scenario, RunSettings(native=False)).notes if "order" in note)
    assert "not fixed: the library is not built;" in note


@pytest.fixture(scope="module")
def heap_orders():
    """Return scripts/studies/link_order/heap_orders.py as a module."""
    specification = importlib.util.spec_from_file_location(
        "heap_orders", ROOT / "scripts" / "studies" / "link_order" / "heap_orders.py"
    )
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


needs_allocator = pytest.mark.skipif(
    LIBRARY is None or not sys.platform.startswith("linux") or not (shutil.which("cc") or shutil.which("gcc")),
    reason="the library is not built, or there is no C compiler",
)


@pytest.mark.nightly  # by day, the orders of the tests below
@needs_allocator
def test_other_addresses_give_the_same_result(heap_orders, tmp_path):
    """Without the fixed order they give two results, of which the fixed order has that of an ordinary process."""
    allocator = heap_orders.build_allocator(tmp_path)

    def results(order, *, fix, loads):
        return heap_orders.run_digests(
            NETS / "lefts.net.xml", NETS / "lefts.rou.xml", allocator=allocator, order=order, fix=fix, steps=120,
            loads=loads,
        )  # fmt: skip

    (ordinary,) = results(0, fix=False, loads=1)
    assert set(results(1, fix=True, loads=4)) == {ordinary}
    if metadata.version("libsumo") == "1.28.0":  # a load has other addresses, and the other order in one of four
        unordered = set(results(1, fix=False, loads=4))
        if len(unordered) == 1:  # on a machine where these four have the same order
            unordered |= {*results(1, fix=False, loads=8), *results(2, fix=False, loads=8)}
        assert len(unordered) == 2


NETWORKS = sorted([*NETS.glob("*.net.xml"), *(ROOT / "scenarios").glob("*/*.net.xml")])


@pytest.mark.nightly
@needs_allocator
@pytest.mark.parametrize("net", NETWORKS, ids=[net.name.removesuffix(".net.xml") for net in NETWORKS])
def test_ten_orders_of_addresses_give_one_result(heap_orders, tmp_path, net):
    allocator, routes = heap_orders.build_allocator(tmp_path), tmp_path / "demand.rou.xml"
    heap_orders.make_demand(net, routes)
    found = [heap_orders.run_digests(net, routes, allocator=allocator, order=order, fix=True) for order in range(10)]
    assert found == [heap_orders.run_digests(net, routes, allocator=allocator, order=0, fix=False)] * 10
