"""Demand that SUMO omits of a simulation with a warning only, or without one; a hunt then tests other traffic.

`unsorted_notes` searches a scenario's files before a hunt, and so imports no libsumo. `OmittedDemand` reads SUMO's
output in a trial.
"""

from __future__ import annotations

import os
import re
import stat
from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple
from xml.parsers import expat

from crashhunt.base.errors import InvalidEpisodeError, ScenarioError
from crashhunt.base.text import NOTICE_TOPIC, count_of
from crashhunt.sumo._ego_choice import seconds
from crashhunt.sumo._files import read_xml
from crashhunt.sumo._options import SumoSetup
from crashhunt.sumo._scenario_check import places_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from crashhunt.scenario import Scenario


# Route files that are not sorted by departure time.

SORT_FIX = "sort the file, for example with SUMO's tools/route/sort_routes.py, or put each flow into a file of its own"
_MAX_SORTED_BYTES = 20 * 2**20  # of all route files: half a second. SUMO itself reports what a trial omits
_DEPARTING = {
    **dict.fromkeys(("vehicle", "trip", "person", "container"), "depart"),
    **dict.fromkeys(("flow", "personFlow", "containerFlow"), "begin"),
}
"""The elements whose order SUMO checks, and the attribute with the departure time."""


def is_searched(folder: Path, routes: tuple[str, ...]) -> bool:
    """Return whether `unsorted_notes` searches the route files: they are small, and no trial changes their times."""
    with suppress(OSError, ScenarioError):
        size = sum((folder / name).stat().st_size for name in routes)
        return size <= _MAX_SORTED_BYTES and not any(b"${" in read_xml(folder / name) for name in routes)
    return False


def unsorted_notes(folder: Path, routes: tuple[str, ...], begin_s: float) -> Iterator[str]:
    """Yield a warning for each route file from which SUMO omits demand that departs before an earlier element.

    A flow without a departure time departs at the start of the simulation. SUMO does not check the order of additional
    files.
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


# What SUMO reports in a trial.

_STANDARD_ERROR = 2
_MAX_OUTPUT_BYTES = 2**20  # of one episode; a scenario with more warnings has reported enough
_MAX_SEARCHED_BYTES = 5 * 2**20  # of the files of the demand, which each trial would search


class _Reason(NamedTuple):
    """Why SUMO omits a part of the demand: its words, ours, and the advice."""

    pattern: re.Pattern[str]
    because: str
    fix: str
    is_reported: bool = True


_UNSORTED = _Reason(
    re.compile(r"Route file should be sorted by departure time, ignoring '(.+)'!"),
    "its route file is not sorted by departure time",
    SORT_FIX,
)
_REASONS = (
    _UNSORTED,
    _Reason(
        re.compile(r"(?:Vehicle|Flow|Removing vehicle) '(.+?)' (?:which )?has no valid route"),
        "it has no valid route",
        "correct its route, for example with SUMO's duarouter",
    ),
    _Reason(
        re.compile(r"Vehicle '(.+?)' will not be able to depart"),
        "it cannot depart as its attributes say",
        "change its departLane, departPos, departSpeed or first stop",
    ),
    _Reason(
        re.compile(r"No valid routes in (?:calibrator) '(.+?)'"),
        "the calibrator has no valid route",
        "correct the routes of the calibrator's flows",
    ),
    _Reason(
        re.compile(r"(?:Person|Container) '(.+?)' aborted waiting"),
        "no vehicle comes for its ride",
        "add a vehicle for the ride, or remove the person or container",
    ),
    _Reason(
        re.compile(r"Flow '(.+?)' has no instances"),
        "the flow has no vehicles",
        "give the flow a number above 0",
        is_reported=False,  # an empty flow changes nothing
    ),
)
_MAX_DEPART_DELAY = "max-depart-delay"


class OmittedDemand:
    """Reads from SUMO's output which vehicles, flows and persons of a scenario take no part in an episode.

    The output is that of the process, if it is a file, as it is in a trial. Elsewhere the user sees the output itself.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        routes = scenario.table(SumoSetup).routes
        # The notes of a scenario already report what they find in its files.
        self._reported_before = [_UNSORTED] if is_searched(scenario.folder, routes) else []
        self._has_limit = _MAX_DEPART_DELAY in scenario.table(SumoSetup).options
        self.begin()

    def begin(self) -> None:
        """Begin another episode, before SUMO loads its files."""
        self._found: dict[str, _Reason] = {}
        self._file, self._end = _output()

    def read(self) -> None:
        """Read SUMO's output since the last call."""
        file, end = _output()
        begin = self._end if file == self._file else 0
        self._file, self._end = file, end
        for line in _lines(begin, end) if end > begin else ():
            for reason in _REASONS:
                if found := reason.pattern.search(line):
                    self._found.setdefault(found[1], reason)
                    break

    def notices(self) -> list[str]:
        """Return a notice for each reason for which SUMO has omitted a part of the demand in the episode so far."""
        self.read()
        notices = []
        for reason in _REASONS:
            names = [name for name, why in self._found.items() if why is reason]
            if names and reason.is_reported and reason not in self._reported_before:
                more = f" and {len(names) - 1} more" if len(names) > 1 else ""
                what = f"SUMO omits {names[0]!r}{more} of the demand, because {reason.because}{self._place(names[0])}"
                notices.append(f"{reason.because}{NOTICE_TOPIC}{what}. Fix: {reason.fix}")
        if count := self._late() if self._has_limit else 0:
            what = f"SUMO has omitted {count} vehicle{'s' * (count > 1)} of the demand in a trial"
            why = f"{_MAX_DEPART_DELAY} was over before there was room for {'it' if count == 1 else 'them'}"
            notices.append(
                f"{_MAX_DEPART_DELAY}{NOTICE_TOPIC}{what}, because {why}. Fix: raise it, or lower the demand"
            )
        return notices

    def explained(self, error: InvalidEpisodeError, vehicles: Iterable[str]) -> InvalidEpisodeError:
        """Return the error of an episode that a vehicle never entered, with the reason if SUMO has omitted it."""
        self.read()
        for vehicle in vehicles:
            for name in (vehicle, vehicle.rpartition(".")[0]):
                if reason := self._found.get(name):
                    what = f"the vehicle {vehicle!r} never enters: SUMO omits {name!r}"
                    return InvalidEpisodeError(f"{what}, because {reason.because}{self._place(name)}", fix=reason.fix)
        return error

    def _place(self, name: str) -> str:
        files = [self._scenario.folder / file for file in self._scenario.texts()]
        if sum(file.stat().st_size for file in files) > _MAX_SEARCHED_BYTES:
            return ""
        places = places_of(name, self._scenario)
        return f" ({places[0]})" if len(places) == 1 else ""

    def _late(self) -> int:
        import libsumo

        try:
            loaded, inserted, waiting = (
                int(libsumo.simulation.getParameter("", f"stats.vehicles.{what}"))
                for what in ("loaded", "inserted", "waiting")
            )
        except (libsumo.TraCIException, libsumo.FatalTraCIError, ValueError):
            return 0
        return loaded - inserted - waiting


def _output() -> tuple[tuple[int, int], int]:
    """Return the file that is the standard error of this process, and its size; the size is 0 if it is no file."""
    try:
        found = os.fstat(_STANDARD_ERROR)
    except OSError:
        return (0, 0), 0
    return (found.st_dev, found.st_ino), found.st_size if stat.S_ISREG(found.st_mode) else 0


def _lines(begin: int, end: int) -> list[str]:
    try:
        file = os.open(f"/proc/self/fd/{_STANDARD_ERROR}", os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return []
    try:
        text = os.pread(file, min(end - begin, _MAX_OUTPUT_BYTES), begin)
    finally:
        os.close(file)
    return [line for line in text.decode(errors="replace").splitlines() if line.startswith(("Warning: ", "Error: "))]
