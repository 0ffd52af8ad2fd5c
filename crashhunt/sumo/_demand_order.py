"""Finds demand that SUMO omits because its route file is not sorted by departure time."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING
from xml.parsers import expat

from crashhunt.base.errors import ScenarioError
from crashhunt.base.text import count_of
from crashhunt.sumo._ego import seconds
from crashhunt.sumo._files import read_xml

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


SORT_FIX = "sort the file, for example with SUMO's tools/route/sort_routes.py, or put each flow into a file of its own"
_MAX_SEARCHED_BYTES = 20 * 2**20  # of all route files: half a second. SUMO itself reports what a trial omits
_DEPARTING = {
    **dict.fromkeys(("vehicle", "trip", "person", "container"), "depart"),
    **dict.fromkeys(("flow", "personFlow", "containerFlow"), "begin"),
}
"""The elements whose order SUMO checks, and the attribute with the departure time."""


def is_searched(folder: Path, routes: tuple[str, ...]) -> bool:
    """Return whether `unsorted_notes` searches the route files: they are small, and no trial changes their times."""
    with suppress(OSError, ScenarioError):
        size = sum((folder / name).stat().st_size for name in routes)
        return size <= _MAX_SEARCHED_BYTES and not any(b"${" in read_xml(folder / name) for name in routes)
    return False


def unsorted_notes(folder: Path, routes: tuple[str, ...], begin_s: float) -> Iterator[str]:
    """Yield a warning for each route file from which SUMO omits demand that departs before an earlier element.

    Args:
        folder: folder of the scenario.
        routes: names of the route files. SUMO does not check the order of additional files.
        begin_s: start of the simulation, which is the departure time of a flow without one, in s.
    """
    for name in routes if is_searched(folder, routes) else ():
        late: list[tuple[str, str]] = []
        last = [0.0]
        # SUMO itself reports a file that is no XML.
        with suppress(ScenarioError, expat.ExpatError, OSError, LookupError, ValueError, RecursionError):
            _search(folder / name, begin_s, last, late)
            if late:
                what = count_of(len(late), "element")
                example, place = late[0]
                yield (
                    f"warning: SUMO omits {what} of the demand, such as {example} in {place}, because {name} is "
                    f"not sorted by departure time. Fix: {SORT_FIX}"
                )


def _search(file: Path, begin_s: float, last: list[float], late: list[tuple[str, str]]) -> None:
    """Add the elements of a file and of its included files that SUMO omits: tag with id, and file with line."""
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag == "include" and "href" in attributes:
            _search(file.parent / attributes["href"], begin_s, last, late)
        attribute = _DEPARTING.get(tag, "")
        try:
            depart = round(seconds(attributes.get(attribute, repr(begin_s) if attribute == "begin" else ""), file), 3)
        except ScenarioError:  # "triggered" and similar
            return
        if depart < last[0]:
            late.append((f"{tag} {attributes.get('id', '')!r}", f"{file.name}, line {parser.CurrentLineNumber}"))
        else:
            last[0] = depart

    parser.StartElementHandler = start
    parser.Parse(read_xml(file), True)
