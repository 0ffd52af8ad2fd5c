"""Conversion of a map to a network of SUMO, by netconvert or netgenerate."""

from __future__ import annotations

import gzip
import math
import re
import shutil
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from crashhunt.base.errors import ScenarioError
from crashhunt.base.extras import install_command
from crashhunt.sumo.maps._road_network import BICYCLE, CAR, PERSON, RoadNetwork, read_network
from crashhunt.sumo.maps._source import BBox, MapSource, fix_of_bbox
from crashhunt.sumo.maps._tools import Tools, first_error

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

NET = "map.net.xml"
_RAIL = frozenset({"rail", "rail_urban", "rail_electric", "rail_fast", "tram", "subway", "cable_car"})
_LEFT_HAND = re.compile(rb"""\brule\s*=\s*["']LHT["']""")
_LENGTH = re.compile(rb"""<(road|geometry)\b[^>]*?\slength\s*=\s*["']([^"']*)["']""")
_LANELET = re.compile(rb"""\bv\s*=\s*["']lanelet["']""")
_BOUNDARY = re.compile(rb'<location [^>]*origBoundary="(?P<boundary>[^"]*)" projParameter="(?P<projection>[^"]*)"')
_AT_LINE = re.compile(r"^\s*At line/column", re.MULTILINE)
"""What the programs add to an error of the XML itself, in contrast to one of its content."""
_COMMENT = re.compile(r"<!--.*?-->\s*", re.DOTALL)
_HEAD_BYTES = 1 << 20

# From SUMO's own recommendations for imports (osmWebWizard.py): junctions of several nodes become one, ramps get
# their acceleration lanes, and lights of one junction switch together.
_OSM_OPTIONS = (
    "--geometry.remove", "--ramps.guess", "--junctions.join", "--tls.guess-signals", "--tls.discard-simple",
    "--tls.join", "--output.street-names",
)  # fmt: skip
_GENERATOR_OPTIONS = ("--default.lanenumber", "2", "--default.speed", "13.89", "--tls.guess", "--no-turnarounds")
_BLOCK_M = "150"
_IGNORE_ERROR_OPTIONS = ("--ignore-errors", "--ignore-errors.connections")


@dataclass(frozen=True, slots=True, kw_only=True)
class ConvertOptions:
    """The options of the conversion of a map to a network."""

    bbox: BBox | None = None  # bounding box of the part of the map to convert, in degrees; None for the whole map
    people: bool = False  # whether the network has sidewalks and crossings
    bicycles: bool = False  # whether the network has lanes and paths for bicycles
    left_hand: bool = False  # whether traffic drives on the left


@dataclass(frozen=True, slots=True)
class Converted:
    """A converted network."""

    network: RoadNetwork
    notes: tuple[str, ...]


def convert(source: MapSource, options: ConvertOptions, tools: Tools, folder: Path) -> Converted:
    """Write the network of a map as ``map.net.xml``.

    Other files in the folder are not removed.

    Raises:
        ScenarioError: a program refuses the map, or the map has no road for cars.
    """
    notes: list[str] = []
    if source.path is not None:
        _copy_map(source, folder)
        if source.kind == "opendrive":
            _check_lengths(source.path)
        if source.kind == "opendrive" and not options.left_hand and _keeps_left(source.path):
            options = replace(options, left_hand=True)
            notes.append("traffic keeps to the left: the map has roads with rule LHT")
    elif options.left_hand:
        notes.append("traffic keeps to the left")
    if source.kind == "net" and options == ConvertOptions():
        (folder / _safe_name(source)).rename(
            folder / f"{NET}.gz" if _is_packed(folder / _safe_name(source)) else folder / NET
        )
        _unpack(folder)
    else:
        notes += _run_converter(source, options, tools, folder)
        _strip_comment(folder / NET)
    try:
        network = read_network(folder / NET)
    except ScenarioError as error:
        raise ScenarioError(error.message, fix=error.fix, where=_place_in_error(source)) from None
    if not network.drivable():
        raise _no_road(source, options, tools, folder)
    return Converted(network, tuple(notes))


def _safe_name(source: MapSource) -> str:
    """Return a file name for the map in the folder, because SUMO splits the user's file names at commas and spaces."""
    assert source.path is not None
    lower = source.path.name.lower()
    stem = {"osm": "given.osm", "opendrive": "given.xodr", "net": "given.net.xml"}[source.kind]
    if lower.endswith(".pbf"):
        return "given.osm"
    return f"{stem}.gz" if lower.endswith(".gz") else stem


def _copy_map(source: MapSource, folder: Path) -> None:
    """Copy the map into the folder, as XML."""
    assert source.path is not None
    target = folder / _safe_name(source)
    if source.path.name.lower().endswith(".pbf"):
        _unpack_pbf(source.path, target)
    else:
        shutil.copyfile(source.path, target)


def _unpack_pbf(path: Path, target: Path) -> None:
    """Convert an OpenStreetMap PBF file to XML, because netconvert does not read PBF.

    Raises:
        ScenarioError: osmium is not installed, or the file is damaged.
    """
    try:
        import osmium
    except ImportError:
        message = "the map is a PBF, and the package osmium is not installed"
        raise ScenarioError(message, fix=install_command("maps"), where=str(path)) from None
    try:
        with osmium.SimpleWriter(str(target)) as writer:
            for one in osmium.FileProcessor(str(path)):
                writer.add(one)
    except RuntimeError as error:
        fix = "download the map again"
        raise ScenarioError(f"osmium cannot read the map: {error}", fix=fix, where=str(path)) from None


def _keeps_left(path: Path) -> bool:
    with path.open("rb") as file:
        return _LEFT_HAND.search(file.read(_HEAD_BYTES)) is not None


def _check_lengths(path: Path) -> None:
    """Refuse roads whose length OpenDRIVE forbids. netconvert would convert them to other roads without a message.

    Raises:
        ScenarioError: the length of a road or a geometry is negative or not a number.
    """
    data = gzip.decompress(path.read_bytes()) if _is_packed(path) else path.read_bytes()
    for element, text in _LENGTH.findall(data):
        try:
            is_length = 0 <= float(text) < math.inf
        except ValueError:
            is_length = False
        if not is_length:
            raise ScenarioError(
                f"a <{element.decode()}> has the length {text.decode('utf-8', 'replace')[:40]!r}",
                fix="correct the map: a length is a number of at least 0, in m",
                where=str(path),
            )


def _is_lanelet(path: Path) -> bool:
    """Return whether a map without roads is a Lanelet2 map, which uses the file format of OpenStreetMap."""
    return not _is_packed(path) and _LANELET.search(path.read_bytes()) is not None


def _is_packed(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(2) == b"\x1f\x8b"


def _unpack(folder: Path) -> None:
    packed = folder / f"{NET}.gz"
    if packed.exists():
        with gzip.open(packed) as read, (folder / NET).open("wb") as write:
            shutil.copyfileobj(read, write)
        packed.unlink()


def _run_converter(source: MapSource, options: ConvertOptions, tools: Tools, folder: Path) -> Iterator[str]:
    """Run the conversion program, and yield notes on parts of the map that it omitted."""
    program = "netconvert" if source.path is not None else "netgenerate"
    words = [*_command_arguments(source, options, tools), "--output-file", NET, "--xml-validation", "never"]
    done = tools.run(program, words, folder)
    if done.code == 0:
        return
    error = first_error(done.output) or "it says no more than that"
    if source.path is not None:
        again = tools.run(program, [*words, *_IGNORE_ERROR_OPTIONS], folder)
        if again.code == 0 and (folder / NET).is_file() and read_network(folder / NET).drivable():
            count = sum(line.startswith("Error:") for line in done.output.splitlines())
            yield (
                f"warning: the map has {count} error{'s' * (count != 1)}, and netconvert omitted the parts that they "
                f"concern; the first is: {error}"
            )
            return
    if "o nodes loaded" in error or "o edges loaded" in error or "could not be found" in error:
        raise _no_road(source, options, tools, folder)
    fix = "correct the map, or choose a part of it with --bbox W,S,E,N" if source.kind == "osm" else "correct the map"
    if _AT_LINE.search(done.output):
        fix = "download or export the map again: it is incomplete, or not valid XML"
    raise ScenarioError(f"{program} cannot read the map: {error}", fix=fix, where=_place_in_error(source))


def _convert_everything(source: MapSource, options: ConvertOptions, tools: Tools, folder: Path) -> bool:
    """Convert all ways of a map, whatever they are for, and despite errors; return whether there is a network."""
    words = [*_command_arguments(source, options, tools, everything=True), *_IGNORE_ERROR_OPTIONS]
    (folder / NET).unlink(missing_ok=True)
    if source.path is not None:
        tools.run("netconvert", [*words, "--xml-validation", "never", "--output-file", NET], folder)
    return (folder / NET).is_file()


def _bounds(source: MapSource, options: ConvertOptions, tools: Tools, folder: Path) -> BBox | None:
    """Return the bounding box of a map in degrees; None if the map is not known to have one."""
    if not _convert_everything(source, options, tools, folder):
        return None
    with (folder / NET).open("rb") as file:
        found = _BOUNDARY.search(file.read(_HEAD_BYTES))
    if found is None or found["projection"] == b"!":
        return None
    west, south, east, north = (float(number) for number in found["boundary"].split(b","))
    return west, south, east, north


def _place_in_error(source: MapSource) -> str:
    return str(source.path) if source.path is not None else f"--{source.kind}"


def _command_arguments(
    source: MapSource, options: ConvertOptions, tools: Tools, *, everything: bool = False
) -> list[str]:
    """Return the program's arguments for a map, except the file to write."""
    words = _input(source, options, tools)
    classes = [CAR, *([BICYCLE] if options.bicycles else []), *([PERSON] if options.people else [])]
    if source.path is not None and not everything:
        # Rails and footways that no trial uses would still bring crossings and lights.
        words += ["--keep-edges.by-vclass", ",".join(classes)]
    if source.path is not None:
        words += ["--no-turnarounds.except-deadend"]
    if source.path is not None and source.kind != "net" and not everything:
        words += ["--keep-edges.components", "1"]  # a vehicle reaches nothing else
    if options.bbox is not None:
        words += ["--keep-edges.in-geo-boundary", ",".join(f"{number:.9g}" for number in options.bbox)]
    if options.left_hand:
        words += ["--lefthand"]
    if options.people:
        words += ["--sidewalks.guess", "--crossings.guess", "--walkingareas"]
    if options.bicycles:
        words += ["--bikelanes.guess"]
    return words


def _input(source: MapSource, options: ConvertOptions, tools: Tools) -> list[str]:
    first, second = (str(number) for number in source.shape)
    if source.kind == "grid":
        sizes = ["--grid.x-number", first, "--grid.y-number", second]
        return ["--grid", *sizes, "--grid.length", _BLOCK_M, "--grid.attach-length", _BLOCK_M, *_GENERATOR_OPTIONS]
    if source.kind == "spider":
        sizes = ["--spider.arm-number", first, "--spider.circle-number", second]
        return [
            "--spider",
            *sizes,
            "--spider.space-radius",
            _BLOCK_M,
            "--spider.attach-length",
            _BLOCK_M,
            *_GENERATOR_OPTIONS,
        ]
    if source.kind == "net":
        return ["--sumo-net-file", _safe_name(source)]
    types = [f"{source.kind}Netconvert"]
    types += [f"{types[0]}Bicycle"] * options.bicycles + [f"{types[0]}Pedestrians"] * options.people
    files = ",".join(str(tools.home / "data" / "typemap" / f"{name}.typ.xml") for name in types)
    if source.kind == "opendrive":
        return ["--opendrive-files", _safe_name(source), "--type-files", files, "--geometry.remove"]
    more = ["--osm.sidewalks", "--osm.crossings"] * options.people + ["--osm.bike-access"] * options.bicycles
    return ["--osm-files", _safe_name(source), "--type-files", files, *_OSM_OPTIONS, *more]


def _strip_comment(path: Path) -> None:
    """Remove the comment that contains the date and paths of this machine, so that equal maps give equal files."""
    text = path.read_text(encoding="utf-8")
    begin, comment, end = text.partition("<net ")
    path.write_text(_COMMENT.sub("", begin) + comment + end, encoding="utf-8")


def _no_road(source: MapSource, options: ConvertOptions, tools: Tools, folder: Path) -> ScenarioError:
    """Return the error for a map without a road for cars; its message describes the contents of the map."""
    held = read_network(folder / NET) if _convert_everything(source, options, tools, folder) else RoadNetwork()
    lanes = [lane for edge in held.edges.values() for lane in edge.lanes]
    fix = "choose a map or a --bbox with streets"
    if not lanes and source.kind == "osm" and _is_lanelet(folder / _safe_name(source)):
        what = "the map is in the format Lanelet2, not OpenStreetMap's"
        fix = "export it as OpenDRIVE, or as a network of SUMO"
    elif not lanes:
        what = "the map has no road in this --bbox" if options.bbox else "the map has no road"
        if options.bbox is not None:
            fix = fix_of_bbox(options.bbox, _bounds(source, replace(options, bbox=None), tools, folder)) or fix
    elif all(any(map(lane.admits, _RAIL)) and not lane.admits(PERSON) for lane in lanes):
        what = f"the map has rails only (tracks: {len(held.edges)})"
    elif all(lane.admits(PERSON) or lane.admits(BICYCLE) or lane.allowed == frozenset() for lane in lanes):
        what = f"the map has only ways for pedestrians and bicycles (ways: {len(held.edges)})"
    else:
        classes = sorted({name for lane in lanes for name in lane.allowed or ()})
        what = f"the map has no road for cars; its {len(held.edges)} ways are for {', '.join(classes[:5])}"
    return ScenarioError(what, fix=fix, where=_place_in_error(source))
