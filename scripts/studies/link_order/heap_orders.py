"""Runs SUMO networks under several orders of memory addresses, and prints how many results each gives.

For each network, `make_demand` draws trips and walks. Each run is a new process, in which an allocator permutes the
addresses (``heap_order.c``). Its result is a digest of the state of each vehicle and person in each step. Whatever in
SUMO depends on addresses gives more than one digest.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import shutil
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

SOURCE = Path(__file__).with_name("heap_order.c")
VEHICLES, PERIOD_S, STEP_LENGTH_S = 500, 0.4, 0.5
_ALWAYS = {
    "step-length": str(STEP_LENGTH_S), "no-step-log": "true", "no-warnings": "true", "ignore-route-errors": "true",
    "time-to-teleport": "-1", "collision.action": "warn", "collision.check-junctions": "true",
}  # fmt: skip


def build_allocator(folder: Path) -> Path:
    """Compile the allocator into a folder; return the library to preload.

    Raises:
        FileNotFoundError: there is no C compiler.
    """
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if compiler is None:
        raise FileNotFoundError("there is no C compiler")
    built = folder / "heap_order.so"
    words = [compiler, "-O2", "-fPIC", "-shared", "-fno-builtin", str(SOURCE), "-o", str(built)]
    subprocess.run(words, check=True, capture_output=True)
    return built


def make_demand(net: Path, routes: Path, seed: int = 1) -> None:
    """Write trips between random edges for cars, buses or trains, and walks where there are sidewalks."""
    cars, rails, walks = [], [], []
    for _, edge in ET.iterparse(net):
        if edge.tag != "edge" or edge.get("function"):
            continue
        lanes = edge.findall("lane")
        if any(_allows(lane, "passenger") for lane in lanes):
            cars.append(edge.get("id"))
        elif any(_allows(lane, "rail") for lane in lanes):
            rails.append(edge.get("id"))
        if any(lane.get("allow") == "pedestrian" for lane in lanes):
            walks.append(edge.get("id"))
        edge.clear()
    draw = random.Random(seed)
    lines = ['<routes><vType id="rail" vClass="rail"/><vType id="bus" vClass="bus"/>']
    for number in range(VEHICLES):
        depart, edges = number * PERIOD_S, rails if rails and (not cars or number % 9 == 0) else cars
        kind = "rail" if edges is rails else "bus" if number % 11 == 0 else "DEFAULT_VEHTYPE"
        trip = (
            f'id="{number}" type="{kind}" depart="{depart:.1f}" from="{draw.choice(edges)}" to="{draw.choice(edges)}"'
        )
        lines.append(f'<trip {trip} departLane="best" departSpeed="max"/>')
        if walks and number % 3 == 0:
            walk = f'<walk from="{draw.choice(walks)}" to="{draw.choice(walks)}"/>'
            lines.append(f'<person id="p{number}" depart="{depart:.1f}">{walk}</person>')
    routes.write_text("\n".join([*lines, "</routes>\n"]))


def _allows(lane: ET.Element, kind: str) -> bool:
    if allowed := lane.get("allow"):
        return allowed == "all" or kind in allowed.split()
    return lane.get("disallow") != "all" and kind not in (lane.get("disallow") or "").split()


def simulate(
    net: Path, routes: Path, *, seed: int, steps: int, fix: bool, options: dict[str, str], loads: int = 1
) -> list[str]:
    """Simulate in this process; return a digest for each load. Call it once per process."""
    import libsumo
    from libsumo import _libsumo

    from crashhunt.native import link_order

    order = link_order(metadata.version("libsumo"), _libsumo.__file__)
    order.use(fix)
    words = ["-n", str(net), "-r", str(routes), "--seed", str(seed)]
    for name, value in {**_ALWAYS, **options}.items():
        words += [f"--{name}", value]
    found = []
    for _ in range(loads):
        if libsumo.isLoaded():
            libsumo.load(words)
        else:
            libsumo.start(["sumo", *words])
        if fix and (reason := order.check_load()):
            raise RuntimeError(reason)
        found.append(_digest_of(libsumo, steps))
    return found


def _digest_of(libsumo: Any, steps: int) -> str:
    digest = hashlib.blake2b(digest_size=8)
    vehicle, person = libsumo.vehicle, libsumo.person
    for _ in range(steps):
        libsumo.simulationStep()
        for name in vehicle.getIDList():
            state = (vehicle.getPosition(name), vehicle.getSpeed(name), vehicle.getAngle(name), vehicle.getLaneID(name))
            digest.update(repr((name, state)).encode())
        for name in person.getIDList():
            digest.update(repr((name, person.getPosition(name), person.getSpeed(name))).encode())
    return digest.hexdigest()


def run_digests(
    net: Path, routes: Path, *, allocator: Path, order: int, fix: bool, seed: int = 1, steps: int = 400,
    options: dict[str, str] | None = None, loads: int = 1,
) -> list[str]:  # fmt: skip
    """Simulate in a new process; return a digest for each load.

    Args:
        net: the network.
        routes: the demand.
        allocator: the library of `build_allocator`.
        order: which order of addresses; 0 is the C library's own.
        fix: whether crashhunt fixes the order of the links.
        seed: SUMO's.
        steps: number of steps.
        options: further options of SUMO.
        loads: how often the process loads and simulates the same.

    Raises:
        RuntimeError: the process failed; with its last line.
    """
    words = [sys.executable, __file__, "--run", str(net), str(routes), "--seed", str(seed), "--steps", str(steps)]
    words += [f"--loads={loads}", *["--fix"] * fix]
    words += [f"--set={name}={value}" for name, value in (options or {}).items()]
    environment = {**os.environ, "LD_PRELOAD": str(allocator), "HEAP_ORDER": str(order)}
    done = subprocess.run(words, capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        raise RuntimeError((done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1])
    return done.stdout.split()[-loads:]


def main() -> None:
    """Run what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="+", type=Path, metavar="NET.net.xml")
    parser.add_argument("--orders", type=int, default=10, help="number of orders of addresses (default: 10)")
    parser.add_argument("--steps", type=int, default=400, help="steps of 0.5 s (default: 400)")
    parser.add_argument("--seed", type=int, default=1, help="SUMO's seed (default: 1)")
    parser.add_argument("--set", action="append", default=[], metavar="OPTION=VALUE", help="a further option of SUMO")
    parser.add_argument("--loads", type=int, default=1, help="loads of the same in each process (default: 1)")
    parser.add_argument("--run", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--fix", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    options = dict(pair.split("=", 1) for pair in given.set)
    if given.run:
        net, routes = given.files
        found = simulate(
            net, routes, seed=given.seed, steps=given.steps, fix=given.fix, options=options, loads=given.loads
        )
        print(*found)
        return
    print("| network | results with SUMO's own order | with the fixed order | fixed = a new process |")
    print("| --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        allocator = build_allocator(folder)
        for net in given.files:
            routes = folder / "demand.rou.xml"
            make_demand(net, routes)
            results: dict[bool, list[str]] = {}
            try:
                for fix in (False, True):
                    for order in range(given.orders):
                        digests = run_digests(
                            net.resolve(), routes, allocator=allocator, order=order, fix=fix, seed=given.seed,
                            steps=given.steps, options=options, loads=given.loads,
                        )  # fmt: skip
                        results.setdefault(fix, []).extend(digests)
            except RuntimeError as error:
                print(f"| {net.name.removesuffix('.net.xml')} | {error} | | |", flush=True)
                continue
            own, fixed = (len(set(results[fix])) for fix in (False, True))
            same = "yes" if results[False][0] == results[True][0] else "no"
            print(f"| {net.name.removesuffix('.net.xml')} | {own} | {fixed} | {same} |", flush=True)


if __name__ == "__main__":
    main()
