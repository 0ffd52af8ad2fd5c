"""The source of a scenario: a map file, or the shape of a generated map."""

from __future__ import annotations

import gzip
import math
import xml.etree.ElementTree as ET
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, BinaryIO, Literal, TypeAlias

from crashhunt.base.errors import ScenarioError, UsageError
from crashhunt.base.text import any_of, near_path

if TYPE_CHECKING:
    from pathlib import Path

BBox: TypeAlias = tuple[float, float, float, float]
"""West, south, east, north, in degrees."""
Kind: TypeAlias = Literal["osm", "opendrive", "net", "grid", "spider"]

ENDINGS: dict[str, tuple[str, ...]] = {
    "osm": (".osm", ".osm.gz", ".osm.xml", ".osm.xml.gz", ".pbf"),
    "opendrive": (".xodr", ".xodr.gz"),
    "net": (".net.xml", ".net.xml.gz"),
}
"""Kind of a map to the endings of its files."""
_DOWNLOAD_FIX = "download or export the map again"
_GZIP = b"\x1f\x8b"
_TITLES = {"osm": "OpenStreetMap", "opendrive": "OpenDRIVE", "net": "a SUMO network"}
_ROOTS = {"osm": "osm", "OpenDRIVE": "opendrive", "net": "net"}
_MAX_BYTES = 500_000_000
"""Of a file: netconvert needs 3 to 6 bytes of memory for each, and hours for a country."""
_MAX_PBF_BYTES = 50_000_000  # about a tenth of the same map in XML
_SMALLEST_SHAPE, _LARGEST_SHAPE = 2, 40
_MAX_DIGITS = 20  # Python refuses to convert thousands
_CHUNK_BYTES = 1 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class MapSource:
    """The source of a map: a file or a shape."""

    kind: Kind  # format of the map file, or kind of the generated map
    path: Path | None = None  # path of the file; None if the map is generated
    # shape of a generated map: columns and rows of a grid, or arms and rings of a spider web
    shape: tuple[int, int] = (0, 0)

    @property
    def title(self) -> str:
        """The name of the map format."""
        if self.path is not None:
            return self.path.name
        first, second = self.shape
        return f"a grid of {first} by {second} junctions" if self.kind == "grid" else (
            f"a spider's web of {first} arms and {second} rings"
        )  # fmt: skip

    @property
    def name(self) -> str:
        """The name of the place: the name of the file without its ending."""
        if self.path is None:
            return f"{self.kind}-{self.shape[0]}x{self.shape[1]}"
        for ending in sorted(ENDINGS[self.kind], key=len, reverse=True):
            if self.path.name.lower().endswith(ending):
                return self.path.name[: -len(ending)].removesuffix(".osm") or self.path.name
        return self.path.stem


def kind_of_file(path: Path) -> Kind | None:
    """Return the kind of map that a file has according to the ending of its name; None for other files."""
    for kind, endings in ENDINGS.items():
        if path.name.lower().endswith(endings):
            return kind  # type: ignore[return-value]
    return None


def parse_shape(text: str, option: str) -> tuple[int, int]:
    """Return the two numbers of a shape such as ``4x4``.

    Raises:
        UsageError: the text has another form, or a number is too small or too large.
    """
    parts = text.lower().split("x")
    fix = f"give two numbers from {_SMALLEST_SHAPE} to {_LARGEST_SHAPE}, such as {option} 4x4"
    if len(parts) != 2 or not all(part.isdecimal() and part.isascii() and len(part) < _MAX_DIGITS for part in parts):
        raise UsageError(f"{option} {text!r} is not of the form NxM", fix=fix)
    first, second = int(parts[0]), int(parts[1])
    if not all(_SMALLEST_SHAPE <= number <= _LARGEST_SHAPE for number in (first, second)):
        raise UsageError(f"{option} {text!r} is out of range", fix=fix)
    if option == "--spider" and first < 3:
        raise UsageError(f"{option} {text!r} has {first} arms", fix="give at least 3 arms, such as --spider 5x3")
    return first, second


def parse_bbox(text: str) -> BBox:
    """Return the four numbers of a bounding box ``W,S,E,N``, in degrees.

    Raises:
        UsageError: the text has not four numbers, or they are in the wrong order or out of range.
    """
    fix = "give west,south,east,north in degrees, such as --bbox=11.54,48.18,11.56,48.19"
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"--bbox {text!r} is not four numbers", fix=fix) from None
    if not all(map(math.isfinite, (west, south, east, north))):
        raise UsageError(f"--bbox {text!r} is not four finite numbers", fix=fix)
    if max(abs(west), abs(east)) > 180:
        raise UsageError(f"--bbox {text!r} has a longitude beyond 180 degrees", fix=fix)
    if max(abs(south), abs(north)) > 90:
        raise UsageError(f"--bbox {text!r} has a latitude beyond 90 degrees", fix=fix)
    if west >= east or south >= north:
        raise UsageError(f"--bbox {text!r} is empty: west must be below east, and south below north", fix=fix)
    return west, south, east, north


def fix_of_bbox(bbox: BBox, bounds: BBox | None) -> str:
    """Return the fix for a bounding box without roads: the bounding box of the map; empty if it is unknown.

    If the box would overlap the map with latitude and longitude exchanged, the fix is that box.
    """
    if bounds is None:
        return ""
    south, west, north, east = bbox
    exchanged = west, south, east, north
    if _overlaps(exchanged, bounds) and not _overlaps(bbox, bounds):
        return (
            f"give --bbox={_in_degrees(exchanged)}, since the order is west,south,east,north; the map spans "
            f"{_in_degrees(bounds)}"
        )
    return f"choose a --bbox with streets; the map spans {_in_degrees(bounds)}"


def _overlaps(one: BBox, other: BBox) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _in_degrees(bounds: BBox) -> str:
    return ",".join(f"{number:.6g}" for number in bounds)


def check_source(source: MapSource) -> None:
    """Refuse a file that cannot be a map of its kind, before a program reads the file.

    Raises:
        ScenarioError: the file does not exist, is empty or too large, or its ending or contents are wrong.
    """
    path = source.path
    if path is None:
        return
    where, allowed = str(path), ENDINGS[source.kind]
    if path.is_dir():
        raise ScenarioError("is a folder, not a map", fix=f"give a file that ends in {any_of(allowed)}", where=where)
    if not path.is_file() and (path.exists() or path.is_symlink()):
        fix = "give the path of a regular file"
        raise ScenarioError("is a device, a pipe or a broken link, not a map", fix=fix, where=where)
    if not path.is_file():
        fix = f"{near_path(path, *allowed)}give the path of an existing file"
        raise ScenarioError("there is no such map", fix=fix, where=where)
    if not path.name.lower().endswith(allowed):
        other = kind_of_file(path)
        fix = f"give it with --{other}" if other else f"give a file that ends in {any_of(allowed)}"
        raise ScenarioError(f"does not have the ending of {_TITLES[source.kind]}", fix=fix, where=where)
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(64)
    except OSError as error:
        raise ScenarioError(f"cannot be read: {error.strerror}", fix="check its permissions", where=where) from None
    if size == 0:
        raise ScenarioError("the file is empty", fix=_DOWNLOAD_FIX, where=where)
    most = _MAX_PBF_BYTES if path.name.lower().endswith(".pbf") else _MAX_BYTES
    if size > most:
        raise _too_large(source, f"the map has {size / 1e6:,.0f} MB (allowed: up to {most / 1e6:,.0f} MB)")
    if path.name.lower().endswith(".pbf"):
        if b"OSMHeader" not in head:
            fix = "download the map again, or give it the ending of its format"
            raise ScenarioError("the file is not an OpenStreetMap PBF", fix=fix, where=where)
        return
    if b"OSMHeader" in head:
        fix = f"rename it to {source.name}.osm.pbf"
        raise ScenarioError("the file is an OpenStreetMap PBF, not XML", fix=fix, where=where)
    _check_root(source, head)
    if head.startswith(_GZIP):
        _check_unpacked(source, path)


def _too_large(source: MapSource, message: str) -> ScenarioError:
    fix = "cut out a part first: osmium extract --bbox W,S,E,N" if source.kind == "osm" else "cut out a part first"
    return ScenarioError(message, fix=fix, where=str(source.path))


def _check_unpacked(source: MapSource, path: Path) -> None:
    """Refuse a compressed map that is too large or damaged, before it fills the memory or the disk."""
    size = 0
    try:
        with gzip.open(path) as file:
            while chunk := file.read(_CHUNK_BYTES):
                size += len(chunk)
                if size > _MAX_BYTES:
                    message = f"the map has over {_MAX_BYTES / 1e6:,.0f} MB when it is unpacked, which is the most"
                    raise _too_large(source, message)
    except (OSError, EOFError, zlib.error) as error:
        raise _not_unpacked(path, error) from None


def _not_unpacked(path: Path, error: Exception) -> ScenarioError:
    return ScenarioError(f"cannot be unpacked: {error}", fix=_DOWNLOAD_FIX, where=str(path))


def _check_root(source: MapSource, head: bytes) -> None:
    path = source.path
    assert path is not None
    try:
        with _opened(path, head) as file:
            root = next(element.tag for _, element in ET.iterparse(file, events=("start",)))
    except (ET.ParseError, UnicodeDecodeError, LookupError, ValueError, StopIteration) as error:
        detail = f": {error}" if str(error) else ""
        raise ScenarioError(f"not valid XML{detail}", fix=_DOWNLOAD_FIX, where=str(path)) from None
    except (OSError, EOFError, zlib.error) as error:
        raise _not_unpacked(path, error) from None
    root = root.rpartition("}")[2]  # some tools write a name space
    kind = _ROOTS.get(root)
    if kind != source.kind:
        known = f"give it with --{kind}" if kind else _DOWNLOAD_FIX
        raise ScenarioError(
            f"the file begins with <{root[:40]}>, so it is not {_TITLES[source.kind]}", fix=known, where=str(path)
        )


def _opened(path: Path, head: bytes) -> BinaryIO:
    return gzip.open(path) if head.startswith(_GZIP) else path.open("rb")  # type: ignore[return-value]
