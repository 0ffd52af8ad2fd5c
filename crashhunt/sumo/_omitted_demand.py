"""Demand that SUMO omits of a simulation with a warning only, or without one; a hunt then tests other traffic."""

from __future__ import annotations

import os
import re
import stat
from typing import TYPE_CHECKING, NamedTuple

import libsumo

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.base.text import NOTICE_TOPIC
from crashhunt.sumo._demand_order import SORT_FIX, is_searched
from crashhunt.sumo._names import places_of
from crashhunt.sumo._options import SumoSetup

if TYPE_CHECKING:
    from collections.abc import Iterable

    from crashhunt.scenario import Scenario

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
