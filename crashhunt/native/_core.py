"""The interface of the compiled core, and the check whether the installed core can be used."""

from __future__ import annotations

import importlib
from functools import cache
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

# Not part of this package: a snapshot of the code has no compiled part, and uses the one that is installed, if any.
_MODULE = "_crashhunt_core"
_INTERFACE = 22
"""Version of the core's functions; a core with another version is not used. scripts/build_core.py reads this number."""
_CHECKED_VERSIONS = ("1.28.0",)
"""The versions of libsumo whose functions the core can call."""

DONE, ASK, REFUSED, ANSWERED, SIMULATED = range(5)
"""Results of `UsualSteps.take`, in this order:

- the step is complete,
- the step is complete, and the oracles must evaluate it,
- nothing was done,
- the agent has answered an observation,
- the step was simulated as well, and all the rest remains to be done.
"""

Points = list[tuple[float, float]]
Part = tuple[object, int, "list[float] | Vehicles", list[float] | None, list[int] | None]
"""Successive scenes: the columns of a `Frame`, the row of the agent or -1, of each actor length, width and a number.

`Vehicles` may replace lengths and widths, and None numbers that are equal to the rows."""


class Columns(Protocol):
    """The positions, headings and speeds of one scene, in the form in which they are recorded."""

    points: Points
    """x and y (m), as a new list, like the other attributes."""
    headings: list[float]
    """In rad."""
    speeds: list[float]
    """In m/s."""
    recorded: bytes
    """All numbers in the order of their record, as float64."""

    def speed(self, row: int, /) -> float:
        """Return the speed of an actor, in m/s."""


class Vehicles(Protocol):
    """Some vehicles of the running simulation, and the sizes of all actors of the same scene."""

    def read(self) -> Columns | None:
        """Return the state of the vehicles; None if libsumo fails."""

    def look(self, controlled: Vehicles, squared: float, /) -> Columns | tuple[str, ...] | None:
        """Return the state of the vehicles; None if a vehicle entered, left or collided, or if a person is present.

        Args:
            controlled: The vehicles around which this group of vehicles was selected.
            squared: A squared distance, in m²; 0 for none. If the vehicles within this distance differ from this group,
                the method returns their ids.
        """


class UsualSteps(Protocol):
    """Runs steps of an episode with one agent and without any event, each in one call.

    A step has the same effects as `Episode.step` with a recorder, SUMO and crashhunt's own oracles, in the same order.
    After the first event, this object runs no more steps.
    """

    answer: object
    """The last answer of the agent; reading it removes it."""
    step: int
    """The number of the step that is complete."""
    simulating: bool
    """Whether the last call reached the simulator; otherwise it stopped at the agent."""

    def take(self, agents: Mapping[str, object], /) -> int:
        """Run a step; return its status, such as `DONE`. Exceptions of agent and simulator are not caught."""

    def note(self, action: object, /) -> bool:
        """Record an action after the status `ANSWERED`; return whether that was possible."""

    def go_on(self, quiet: bool, /) -> int:
        """Simulate after the status `ANSWERED`, and read the scene if there was no event; return the status."""

    def heed(self, limits: dict[str, float], limit: float, stood: dict[str, int], standstill: int, /) -> None:
        """Set the limits of events: hard braking (m/s², 0 for each vehicle's own limit) and standstill (steps)."""

    def meet(
        self,
        known: dict[str, Any],
        know: Callable[[str, str, float, float, float, bool], object],
        measure: Callable[[str, float, float], float | None],
        adopt: Callable[[_Vehicles, tuple[str, ...], Any, int], object],
        /,
    ) -> None:
        """Set what is needed for vehicles that come into sight.

        Args:
            known: the actors that the simulator knows, by id. The core reads the properties of all other vehicles.
            know: function that receives id, kind, length, width and height (m) of a vehicle, and whether it is parked.
                It returns the actor, and adds it to the known actors. The core calls this function later: before it
                passes a step or a report to Python.
            measure: function that receives kind, length and width (m) of a vehicle, and returns its reach (m). It
                returns None if the core cannot continue with such a vehicle. The core calls it once for each size.
            adopt: function that receives the vehicles in sight, their ids and actors, and the row of the agent; it
                returns their roster. If the core makes the observations, it calls this function later, too.
        """

    def listen(self, numbers: dict[Any, int], record_roster: Callable[[tuple[bytes, bytes]], object], /) -> None:
        """Set what is needed to record actors.

        Args:
            numbers: the numbers of the actors that are recorded. The core adds the actors that it records.
            record_roster: function that receives the payloads of two records: of those actors in sight that are not
                recorded yet, and of a roster of all of them. The core calls it if the buffer is full; it writes these
                records and provides a recording buffer again.
        """

    def perceive(
        self,
        make: Callable[[Columns, float, int, str], NDArray[np.generic]],
        restore: Callable[[NDArray[np.generic]], object],
        draft: _Draft | None,
        record: np.dtype[np.void] | None,
        names: tuple[str, ...],
        /,
    ) -> None:
        """Set the functions for observations that consist of parts.

        Args:
            make: function that returns the recorded array. It receives the columns of a scene, its time (s), and the
                row and the lane of the agent.
            restore: function that returns what the agent receives, from the recorded array.
            draft: what `make` writes into; None if it writes into none. The core then calls `make` only if it cannot
                write the array from the draft again.
            record: type of the whole array as one value, of which the agent receives the fields, as `restore` returns
                them; None if `restore` must be called.
            names: names of these fields.
        """

    def perceived(self, step: int, /) -> NDArray[np.generic] | None:
        """Return the recorded array that was made after a step, even if the step is not complete; None without one."""

    def judge(self, overlaps: bool, hardest: float, always: bool, last: int, now_and_then: int, /) -> None:
        """Set the conditions under which oracles examine a step.

        Args:
            overlaps: Whether the oracle ``overlap`` may detect a contact.
            hardest: Upper bound of the deceleration of vehicles, in m/s².
            always: Whether oracles examine every step.
            last: The step from which on oracles examine all steps.
            now_and_then: A number n: oracles examine every n-th step.
        """

    def resume(
        self,
        who: tuple[_Vehicles, tuple[str, ...], int, dict[str, object], tuple[object, ...]],
        observation: object,
        columns: Columns,
        time_s: float,
        lanes: str,
        where: tuple[str, int, str, float],
        follower: str,
        step: int,
        /,
    ) -> None:
        """Resume after a completed step.

        Args:
            who: The vehicles of the scene, their ids, the row of the agent, the controlled vehicles, and all actors.
            observation: The next observation of the agent.
            columns: The positions, headings and speeds of the scene.
            time_s: The time of the scene, in s.
            lanes: The lanes of all vehicles in the scene, one per line, or an empty text.
            where: The agent's edge, the number and the name of its lane, and the distance of the lane from the leftmost
                lane (m).
            follower: The vehicle behind the agent.
            step: The number of the step.
        """

    def borrow(
        self, tape: object, offset: int, reserved: int, tags: tuple[int, int, int, int, int, int], roster: object,
        numbers: bytes, /,
    ) -> None:  # fmt: skip
        """Record into a buffer from an offset on, up to a number of reserved bytes.

        The tags are those of observation, action, step, lanes, roster and actors. The roster has the actors in sight
        and must have been recorded; ``numbers`` is the payload of its record.
        """

    def give_back(self) -> tuple[int, int, Any, list[tuple[Any, bytes]]]:
        """Stop recording; return the end of the records, the last complete step, the last roster, and all steps.

        Consecutive steps with the same roster are given as this roster and the offsets of their numbers, as uint64.
        """

    def pause(self) -> None:
        """Run no steps and report nothing until `resume`, while other code runs a step."""

    def stop(self) -> None:
        """Run no further steps; completed steps are still reported."""

    def ahead(self) -> tuple[str, float, float] | None:
        """Return name, gap (m) and speed (m/s) of the vehicle ahead of the agent, in a complete step without persons.

        Without a vehicle ahead, the name is empty, and the numbers are infinite. The method returns None if libsumo
        fails.
        """

    def state(self) -> tuple[float, float, float, float] | None:
        """Return x and y (m), heading (rad) and speed (m/s) of the agent; None if the core runs no steps."""

    def told(
        self,
    ) -> tuple[int, object, float, str, tuple[_Vehicles, float, str], tuple[_Vehicles, float, str]] | None:
        """Return the state after the last completed step; None if there is none.

        Returns:
            The step, the observation, the reward and the follower; then, for the last and the previous scene, the
            vehicles, the time in s and the lanes.
        """

    def columns(self, back: bool, /) -> Columns | None:
        """Return the columns of the last scene, or of the previous scene if ``back`` is true."""

    def reads(self, vehicles: _Vehicles, /) -> tuple[object, ...] | None:
        """Return the values that are read only by this object, for a comparison with libsumo's getters."""


class LaneBlock(Protocol):
    """The candidates of the lanes around a vehicle."""


class Streams(Protocol):
    """The streams that conflict with a path across a junction, and the vehicles that were found on them."""


class Draft(Protocol):
    """An observation that is being written, part by part. A place is the index of a part's first value.

    The methods that are named like a part write it, and return whether they could; if not, the equivalent Python code
    has to write it. `UsualSteps` writes the parts of such calls again in the steps that follow, as long as the vehicle
    stays on its lane and its route. Python then writes the other parts, if there are any.
    """

    def begin(self, columns: Columns | None, row: int, lane: str, time_s: float, /) -> None:
        """Begin the observation of a step, or continue the one whose other parts the core has written.

        Args:
            columns: The columns of the scene; None if there are none.
            row: The row of the agent's vehicle in the scene.
            lane: The lane of the vehicle.
            time_s: The simulation time, in s.
        """

    def has(self, place: int, /) -> bool:
        """Return whether the core has already written a part."""

    def enter(self, vehicles: Vehicles, row: int, /) -> None:
        """Set the vehicles in sight from now on, and the row of the agent's vehicle."""

    def put(self, place: int, values: tuple[float, ...], /) -> None:
        """Write numbers."""

    def put_array(self, place: int, array: object, /) -> None:
        """Write an array of float64."""

    def ego(self, place: int, last: list[float], facts: tuple[float, float, float, float], /) -> bool:
        """Write the part ``ego``.

        Args:
            place: The place of the part.
            last: Heading and speed after the last step, which are replaced by those after this step; empty at first.
            facts: The distance that the vehicle had driven at the start (m), the time then (s), the step length (s),
                and the index of the lane.
        """

    def actors(
        self,
        place: int,
        who: tuple[list[float], list[str]],
        limits: tuple[float, int, float],
        last: tuple[dict[str, float], list[int]],
        path: tuple[frozenset[str], Callable[[str], bool]],
        /,
    ) -> bool:
        """Write the part ``actors``.

        Args:
            place: The place of the part.
            who: The value of ``kind`` and the id of each actor in sight; the caller changes both lists before `enter`.
            limits: The radius (m), the number of rows, and the step length (s).
            last: The speeds after the last step, by id, and the rows of these actors in its scene; both are replaced
                by those after this step.
            path: The lanes on the path of the vehicle; a function that returns whether a lane leads into the lane of
                the vehicle.
        """

    def lanes(
        self, place: int, ask: Callable[[int, int], LaneBlock], shape: tuple[int, int, int, int, float, float], /
    ) -> bool:
        """Write the part ``lanes``.

        Args:
            place: The place of the part.
            ask: Function that returns the candidates for a square, by its column and its row.
            shape: The numbers of lanes and of points, the points behind, the prepared points per point, the largest
                distance of a lane (m), and the size of a square (m).
        """

    def route(self, place: int, rows: object, window: tuple[int, int, int, int], /) -> bool:
        """Write the part ``route``.

        Args:
            place: The place of the part.
            rows: The points of a path.
            window: The first and the last row that can be the nearest, the number of points, and the prepared points
                per point.
        """

    def signals(self, place: int, lights: list[tuple[float, str, int, list[float]]], step_s: float, /) -> bool:
        """Write the part ``signals``.

        Args:
            place: The place of the part.
            lights: The distance from the start of the lane (m), the id and the index of the link of each traffic light.
                Its state and the time when the state began (s) follow. The core replaces both if the state changes.
            step_s: The step length, in s.
        """

    def right_of_way(self, place: int, streams: Streams, facts: tuple[float, float, int], /) -> bool:
        """Write the part ``right_of_way``.

        Args:
            place: The place of the part.
            streams: The streams that conflict with the path of the vehicle.
            facts: The position of the stop line on the lane (m), the value of ``stop_sign``, and the number of rows.
        """

    def along(self, place: int, values: tuple[float, ...], moving: list[tuple[int, float, float, float]], /) -> bool:
        """Write numbers, some of which depend on the position on the lane.

        Args:
            place: The place of the part.
            values: The numbers.
            moving: The index of each such number, and three numbers a, b and c. The number is a + (b - position), and
                at least c.
        """

    def speed_limit(self, place: int, /) -> bool:
        """Write the part ``speed_limit``."""

    def take(self) -> bytes:
        """Return the values."""


_Draft = Draft
_LaneBlock = LaneBlock
_Streams = Streams
_Vehicles = Vehicles  # `Core` has methods with the names of these classes
_UsualSteps = UsualSteps


class Core(Protocol):
    """The compiled module. If only the equivalent Python code can do the work, a function returns None."""

    INTERFACE: int

    def bind(self, library: str) -> None:
        """Find the functions of libsumo in its loaded library.

        Raises:
            OSError: The library lacks a function.
        """

    def Vehicles(  # noqa: N802 - a class
        self, ids: tuple[str, ...], lengths: list[float], widths: list[float], reaches: list[float], /
    ) -> _Vehicles:
        """Return vehicles by their ids, with the sizes of all actors of a scene, as in `Roster`."""

    def UsualSteps(  # noqa: N802 - a class
        self,
        agent: str,
        libsumo: object,
        array: tuple[object, object, object],
        others: int,
        step_s: float,
        lateral: bool,
        takes: int,
        sight: tuple[_Vehicles, int, float],
        start_m: float,
        /,
    ) -> _UsualSteps:
        """Return the object that runs the uneventful steps of an episode.

        Args:
            agent: Identifier of the agent that acts.
            libsumo: The module whose function ``simulationStep`` is called.
            array: The class, the shape and the type of an observation.
            others: Number of other actors in an observation.
            step_s: Step length, in s.
            lateral: Whether vehicles may leave the centre line of a lane.
            takes: The first of the two components of actions, before the lane change: 1 for a speed, 2 for an
                acceleration; 0 for actions of other forms, which Python applies.
            sight: The vehicles around which actors are selected, the steps between two selections, and the squared
                range (m²).
            start_m: The distance that the agent had driven at the start, in m.
        """

    def Draft(self, agent: str, size: int, /) -> _Draft:  # noqa: N802 - a class
        """Return an observation of an agent with this number of values."""

    def LaneBlock(  # noqa: N802 - a class
        self, paths: Sequence[tuple[object, object, int, int] | None], middle_x: float, middle_y: float, window: int, /,
    ) -> _LaneBlock:  # fmt: skip
        """Return candidates of lanes.

        Args:
            paths: The rows of each path, its places, and the first and the last row that can be the nearest; None
                without a lane.
            middle_x: x of the middle of the square, in m.
            middle_y: y of the middle of the square, in m.
            window: Number of rows among which the nearest row is, wherever in the square the vehicle is.
        """

    def Streams(  # noqa: N802 - a class
        self, lanes: tuple[str, ...], ask: Callable[[str, str, int, str], Sequence[object]], /
    ) -> _Streams:
        """Return the streams that conflict with a path.

        Args:
            lanes: The lanes on which vehicles may take these streams.
            ask: Function that returns a list of the streams that a vehicle takes. Its arguments are the id of the
                vehicle, its lane, the index of the edge on its route, and its route.

        A stream is a tuple of these values:

        - whether the vehicle on the path must yield,
        - begin and end of the conflict area on the path and on the stream, in m,
        - the distance from the stop line of the stream to the lane, in m,
        - the traffic light of the stream, empty without one, and the index of its link.
        """

    def vehicle_states(self, vehicles: _Vehicles, /) -> list[tuple[str, float, float, int, int, float, str]] | None:
        """Return the states of vehicles that are read for observations alone; None if libsumo fails.

        A state is lane, lateral position, acceleration, signals, index on the route, position on the lane, route.
        """

    def light_state(self, light: str, /) -> str | None:
        """Return the state of each link of a traffic light; None if libsumo fails."""

    def columns(
        self, vehicles: _Vehicles, points: Sequence[object], headings: Sequence[float], speeds: Sequence[float], /
    ) -> Columns | None:
        """Return the columns of a scene with persons; None if the arguments are not lists of numbers."""

    def is_coming_or_going(self) -> bool | None:
        """Return whether a vehicle has entered or left in the last step, or has begun or ended parking."""

    def in_sight(self, controlled: _Vehicles, squared: float, /) -> tuple[tuple[str, ...], Points] | None:
        """Return the ids of all vehicles near the controlled vehicles, and the positions of these; None on failure.

        Args:
            controlled: the vehicles at the centres of the search; absent vehicles are ignored.
            squared: the squared distance below which a vehicle is near, in m².
        """

    def observe(
        self, columns: Columns, row: int, others: int, distance: float, from_left: float, lateral_speed: float, /
    ) -> bytes | None:
        """Return the default observation of `Kinematics`, as float32."""

    def within_reach(
        self, columns: Columns, earlier: Columns, row: int, step_s: float, hardest: float,
        earlier_rows: list[int] | None, /,
    ) -> list[int] | None:  # fmt: skip
        """Return the rows of the actors that the oracle ``overlap`` examines, the nearest first.

        Args:
            columns: The columns of a scene.
            earlier: The columns of the previous scene.
            row: The row of the actor that the others may touch.
            step_s: The time between the two scenes, in s.
            hardest: upper bound of the deceleration, in m/s².
            earlier_rows: The row of each actor in the previous scene, or -1; None if both scenes have the same actors.
        """

    def may_be_near(
        self, parts: list[Part], gap: float, horizon: float, known_gap: float, known_time: float,
        known_braking: float, only_best: bool, /,
    ) -> tuple[bytes, bytes] | None:  # fmt: skip
        """Return the actors that may take part in the closest approach; the result may contain further actors.

        In each scene with such actors, the agent comes first.

        Args:
            parts: The frames of an episode, in order.
            gap: Pairs with a larger gap do not count, in m.
            horizon: Pairs that would touch later do not count, in s.
            known_gap: Pairs with a larger gap may be skipped, in m.
            known_time: Pairs that would touch later may be skipped, in s, if they also need less deceleration than
                `known_braking`.
            known_braking: Deceleration for `known_time`, in m/s².
            only_best: Whether a pair may be skipped if another pair is closer, would touch earlier and needs more
                deceleration.

        Returns:
            The columns in this order. As float64: x, y, heading, speed, half the length, half the width. As int64: the
            number of the scene, and the index of the agent among the returned actors.
        """

    def tracks(
        self, parts: list[Part], every: int, within: float, ahead: float, behind: float, unknown: float, /
    ) -> tuple[tuple[bytes, bytes], tuple[bytes, bytes]] | None:
        """Return the path of an agent, and the actors near it.

        Args:
            parts: The frames of an episode, in order.
            every: A number n: every n-th scene is used.
            within: The maximum distance between front bumpers, without the lengths of both actors, in m.
            ahead: If it is not 0, actors off the agent's path within this distance ahead are skipped; in m.
            behind: The corresponding distance behind the agent, in m.
            unknown: The length by which the agent's path is continued straight at its end, in m.

        Returns:
            Columns as float64 and as int64, for the agent and for the other actors. The float64 columns are x, y,
            heading, half the length and half the width. The int64 column for the agent is the number of each scene. The
            int64 columns for the other actors are the index of the scene and the number of the actor.
        """

    def least_change(self, earlier: Columns, later: Columns, /) -> float | None:
        """Return the least change of speed of any actor between two scenes (m/s); 0 in an empty scene."""

    def changes_of(self, earlier: memoryview, now: memoryview, /) -> bytes:
        """Return where two arrays of 64-bit words differ, one bit per word, and then the changed words."""


@cache
def _load_module() -> Core | None:
    try:
        core: Core = importlib.import_module(_MODULE)
    except ImportError:  # not built, or for another Python
        return None
    return core


def why_not(libsumo: str) -> str:
    """Return why the core is not used with a version of libsumo; empty if the core is used."""
    core = _load_module()
    if core is None:
        return "it is not built"
    if core.INTERFACE != _INTERFACE:
        return f"it is of another version of crashhunt ({core.INTERFACE} instead of {_INTERFACE})"
    if libsumo not in _CHECKED_VERSIONS:
        return f"it was checked with libsumo {', '.join(_CHECKED_VERSIONS)}, and this is {libsumo}"
    return ""


def core_for(libsumo: str, library: str) -> Core | None:
    """Return the core, ready for use; None if it cannot be used."""
    core = _load_module()
    if core is None or why_not(libsumo):
        return None
    try:
        core.bind(library)
    except OSError:  # libsumo lacks a function, or the system resolves names in another way
        return None
    return core
