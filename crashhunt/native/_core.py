"""The interface of the compiled core, and the check whether the installed core can be used."""

from __future__ import annotations

import importlib
from functools import cache
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

__all__ = [
    "ANSWERED",
    "ASK",
    "DONE",
    "REFUSED",
    "SIMULATED",
    "Columns",
    "Core",
    "Part",
    "UsualSteps",
    "Vehicles",
    "core_for",
    "why_not",
]

# Not part of this package: a snapshot of the code has no compiled part, and uses the one that is installed, if any.
_MODULE = "_crashhunt_core"
_INTERFACE = 9
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
Part = tuple[object, int, list[float], list[float], list[int]]
"""Successive scenes: the columns of a `Frame`, the row of the agent or -1, of each actor length, width and a number."""


class Columns(Protocol):
    """The numbers of one scene, as they are recorded."""

    points: Points
    """x and y (m), as a new list, like the other attributes."""
    headings: list[float]
    """In rad."""
    speeds: list[float]
    """In m/s."""

    def speed(self, row: int, /) -> float:
        """Return the speed of an actor, in m/s."""


class Vehicles(Protocol):
    """Some vehicles of the running simulation, and the sizes of all actors of the same scene."""

    def read(self) -> Columns | None:
        """Return the state of the vehicles; None if libsumo fails, as its getters then do."""

    def look(self, controlled: Vehicles, squared: float, /) -> Columns | tuple[str, ...] | None:
        """Return the state of the vehicles; None if a vehicle has entered, left or collided, or a person is present.

        Args:
            controlled: The vehicles around which this group was selected.
            squared: A squared distance, in m²; 0 for none. If the vehicles within this distance are not those of this
                group, the method returns their ids.
        """


class UsualSteps(Protocol):
    """Runs steps of an episode with one agent and without any event, each in one call.

    A step does the same as `Episode.step` with a recorder, SUMO and crashhunt's own oracles, in the same order. After
    the first event, this object runs no more steps.
    """

    answer: object
    """The last answer of the agent; reading it removes it."""
    step: int
    """The number of the step that is complete."""
    simulating: bool
    """Whether the last call reached the simulator; otherwise it stopped at the agent."""

    def take(self, agents: Mapping[str, object], /) -> int:
        """Take a step; return its result, such as `DONE`. Exceptions of agent and simulator pass through."""

    def note(self, action: object, /) -> bool:
        """Record an action after `ANSWERED`; return whether that was possible."""

    def go_on(self, quiet: bool, /) -> int:
        """Simulate after `ANSWERED`, and read the scene if there was no event; return the result."""

    def heed(self, limits: dict[str, float], limit: float, stood: dict[str, int], standstill: int, /) -> None:
        """Set the limits of events: hard braking (m/s², 0 for each vehicle's own), standing (steps)."""

    def listen(
        self,
        enter: Callable[[tuple[str, ...]], tuple[_Vehicles, tuple[str, ...], int, dict[str, object]] | None],
        record_roster: Callable[[], object],
        /,
    ) -> None:
        """Set the callbacks for a change of the visible vehicles.

        Args:
            enter: receives their ids, and returns the vehicles as `resume` takes them, or None for an incomplete scene.
            record_roster: called when they are recorded; it borrows a buffer again.
        """

    def judge(self, overlaps: bool, hardest: float, always: bool, last: int, now_and_then: int, /) -> None:
        """Set the conditions under which oracles evaluate a step.

        Args:
            overlaps: Whether the oracle ``overlap`` may find a contact.
            hardest: Upper bound of braking, in m/s².
            always: Whether oracles evaluate every step.
            last: Oracles evaluate all steps from this step on.
            now_and_then: Oracles evaluate every n-th step, with this n.
        """

    def resume(
        self,
        who: tuple[_Vehicles, tuple[str, ...], int, dict[str, object]],
        observation: object,
        columns: Columns,
        time_s: float,
        lanes: str,
        where: tuple[str, int, str, float],
        follower: str,
        step: int,
        /,
    ) -> None:
        """Resume after a complete step.

        Args:
            who: The vehicles of the scene, their ids, the row of the agent, the controlled vehicles.
            observation: The next observation of the agent.
            columns: The numbers of the scene.
            time_s: The time of the scene, in s.
            lanes: The lanes of all vehicles in the scene, one per line, or an empty text.
            where: The agent's edge, the number and the name of its lane, and the lane's distance from the leftmost (m).
            follower: The vehicle behind the agent.
            step: The number of the step.
        """

    def borrow(self, tape: object, offset: int, reserved: int, tags: tuple[int, int, int, int], /) -> None:
        """Record into a buffer, with the tags of observation, action, step and lanes."""

    def give_back(self) -> tuple[int, int, list[int]]:
        """Stop recording; return the end of the records, the last complete step, and the offsets of all steps."""

    def pause(self) -> None:
        """Take no steps and report nothing until `resume`, while other code takes a step."""

    def stop(self) -> None:
        """Take no further steps; complete steps are still reported."""

    def told(
        self,
    ) -> tuple[int, object, float, str, tuple[_Vehicles, float, str], tuple[_Vehicles, float, str]] | None:
        """Return the state after the last complete step; None if there is none.

        Returns:
            The step, the observation, the reward, the follower, and for this scene and the previous scene: the
            vehicles, the time in s, the lanes.
        """

    def columns(self, back: bool, /) -> Columns | None:
        """Return the numbers of the last scene, or of the previous scene if ``back`` is true."""

    def reads(self, vehicles: _Vehicles, /) -> tuple[object, ...] | None:
        """Return the values that only this object reads, for a comparison with libsumo's getters."""


_Vehicles = Vehicles  # `Core` has methods with the names of these classes
_UsualSteps = UsualSteps


class Core(Protocol):
    """The compiled module. A function returns None if only the equivalent Python code can do the work."""

    INTERFACE: int

    def bind(self, library: str) -> None:
        """Find libsumo's functions in its loaded library.

        Raises:
            OSError: The library lacks a function.
        """

    def Vehicles(  # noqa: N802 - a class
        self, ids: tuple[str, ...], lengths: list[float], widths: list[float], reaches: list[float], /
    ) -> _Vehicles:
        """Return vehicles by their ids, with the sizes of all actors of a scene, as `Roster` has them."""

    def UsualSteps(  # noqa: N802 - a class
        self,
        agent: str,
        libsumo: object,
        array: tuple[object, object, object],
        others: int,
        step_s: float,
        lateral: bool,
        takes_speed: bool,
        sight: tuple[_Vehicles, int, float],
        start_m: float,
        /,
    ) -> _UsualSteps:
        """Return the object that runs the uneventful steps of an episode.

        Args:
            agent: The agent that acts.
            libsumo: The module whose ``simulationStep`` is called.
            array: The class, the shape and the type of an observation.
            others: Number of other actors in an observation.
            step_s: Step length, in s.
            lateral: Whether vehicles may leave the centre line of a lane.
            takes_speed: Whether actions are a speed and a change of lane.
            sight: The vehicles around which to look, the steps between two looks, and the squared range (m²).
            start_m: The distance that the agent had driven at the start, in m.
        """

    def columns(
        self, vehicles: _Vehicles, points: Sequence[object], headings: Sequence[float], speeds: Sequence[float], /
    ) -> Columns | None:
        """Return the numbers of a scene with persons; None if the arguments are not lists of numbers."""

    def is_coming_or_going(self) -> bool | None:
        """Whether a vehicle has entered or left in the last step."""

    def in_sight(self, controlled: _Vehicles, squared: float, /) -> tuple[tuple[str, ...], Points] | None:
        """Return the ids of all vehicles near the controlled vehicles, and the positions of these; None on failure.

        Args:
            controlled: the centres; absent vehicles are ignored.
            squared: the distance below which a vehicle is near, squared, in m².
        """

    def observe(
        self, columns: Columns, row: int, others: int, distance: float, from_left: float, lateral_speed: float, /
    ) -> bytes | None:
        """Return the usual observation of `Kinematics`, as float32."""

    def within_reach(
        self, columns: Columns, earlier: Columns, row: int, step_s: float, hardest: float,
        earlier_rows: list[int] | None, /,
    ) -> list[int] | None:  # fmt: skip
        """Return the rows that the oracle ``overlap`` looks at, nearest first.

        Args:
            columns: The numbers of a scene.
            earlier: The numbers of the previous scene.
            row: The row of the actor that they may touch.
            step_s: The time between the two scenes, in s.
            hardest: upper bound of braking, in m/s².
            earlier_rows: The row of each actor in the previous scene, or -1; None if both scenes have the same actors.
        """

    def may_be_near(
        self, parts: list[Part], gap: float, horizon: float, known_gap: float, known_time: float,
        known_braking: float, only_best: bool, /,
    ) -> tuple[bytes, bytes] | None:  # fmt: skip
        """Return the actors that may take part in the closest approach; the result may contain further actors.

        In each scene with such actors, the agent comes first.

        Args:
            parts: The parts of an episode, in order.
            gap: Pairs further apart do not count, in m.
            horizon: Pairs that touch later do not count, in s.
            known_gap: Pairs further apart may be skipped, in m.
            known_time: Pairs that touch later may be skipped, in s, if they also need less than `known_braking`.
            known_braking: See `known_time`, in m/s².
            only_best: Whether a pair may be skipped that is further apart, touches later and needs less braking
                than another pair.

        Returns:
            Columns one after another. As float64: x, y, heading, speed, half the length, half the width. As int64: the
            number of the scene, and the position of the agent among the returned actors.
        """

    def tracks(
        self, parts: list[Part], every: int, within: float, ahead: float, behind: float, unknown: float, /
    ) -> tuple[tuple[bytes, bytes], tuple[bytes, bytes]] | None:
        """Return the path of an agent, and the actors near it.

        Args:
            parts: The parts of an episode, in order.
            every: Every n-th scene is used, with this n.
            within: The range, between fronts and without the lengths of both actors, in m.
            ahead: If it is not 0, actors off the agent's path within this distance ahead are skipped, in m.
            behind: The same behind the agent, in m.
            unknown: How far the agent's path is continued straight at its end, in m.

        Returns:
            Columns as float64 and as int64, for the agent and for the other actors. As float64: x, y, heading, half the
            length, half the width. As int64 for the agent: the number of each scene. As int64 for the other actors:
            the index of the scene, and the number of the actor.
        """

    def least_change(self, earlier: Columns, later: Columns, /) -> float | None:
        """Return the least change of speed (m/s) between two scenes; 0 in an empty scene."""

    def write_step(
        self, buffer: object, offset: int, tag: int, step: int, time_s: float, rewards: tuple[float, ...],
        columns: Columns, phase: int, /,
    ) -> int | None:  # fmt: skip
        """Write the record of a step and the phase of the process; return the end of the record."""

    def write_array(
        self, buffer: object, offset: int, tag: int, agent: int, array: object, step: int, phase: int, /
    ) -> int | None:
        """Write the record of an array and the phase of the process; return the end of the record."""


@cache
def _load_module() -> Core | None:
    try:
        core: Core = importlib.import_module(_MODULE)
    except ImportError:  # not built, or for another Python
        return None
    return core


def why_not(libsumo: str) -> str:
    """Return why the core is not used with a version of libsumo; empty if it is used."""
    core = _load_module()
    if core is None:
        return "it is not built"
    if core.INTERFACE != _INTERFACE:
        return f"it is of another version of crashhunt ({core.INTERFACE} instead of {_INTERFACE})"
    if libsumo not in _CHECKED_VERSIONS:
        return f"it was checked with libsumo {', '.join(_CHECKED_VERSIONS)}, and this is {libsumo}"
    return ""


def core_for(libsumo: str, library: str) -> Core | None:
    """Return the core, ready for use; None if it cannot be used.

    Args:
        libsumo: The version of libsumo.
        library: The path of libsumo's loaded library.
    """
    core = _load_module()
    if core is None or why_not(libsumo):
        return None
    try:
        core.bind(library)
    except OSError:  # libsumo lacks a function, or the system resolves names in another way
        return None
    return core
