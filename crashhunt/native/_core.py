"""Whether the compiled core can be used, and what it offers."""

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
_INTERFACE = 8
"""Raised whenever a function of the core changes; a core of another one is not used. scripts/build_core.py reads it."""
_CHECKED = ("1.28.0",)
"""The versions of libsumo of whose functions the core knows how they are called."""

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
    """x and y (m), as new lists, as the others are."""
    headings: list[float]
    """In rad."""
    speeds: list[float]
    """In m/s."""

    def speed(self, row: int, /) -> float:
        """Return the speed of an actor, in m/s."""


class Vehicles(Protocol):
    """Some vehicles of the running simulation, and the sizes of all who are with them in a scene."""

    def read(self) -> Columns | None:
        """Return their positions; None where libsumo refuses, as its getters will."""

    def look(self, controlled: Vehicles, squared: float, /) -> Columns | tuple[str, ...] | None:
        """Return their positions; None where a vehicle has entered, left or collided, or a person is present.

        Args:
            controlled: the vehicles in the centre of this group.
            squared: a distance, squared, in m². If it is not 0 and other vehicles are nearer, their ids are returned.
        """


class UsualSteps(Protocol):
    """Steps of an episode with one agent and without any event, each in one call.

    A step does the same as `Episode.step` does with a recorder, SUMO and crashhunt's own oracles, in the same order.
    After the first event it takes no more steps.
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
            overlaps: whether the oracle ``overlap`` may find a contact.
            hardest: upper bound of braking, in m/s².
            always: every step.
            last: and all steps from this one on.
            now_and_then: and one of so many steps.
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
            who: the vehicles of its scene, their ids, the row of the agent, the controlled vehicles.
            observation: the next observation of the agent.
            columns: of the scene.
            time_s: of the scene.
            lanes: of all vehicles in it, one per line, or an empty text.
            where: the agent's edge, the number of its lane, the name of that, how far from the left this is (m).
            follower: the vehicle behind the agent.
            step: its number.
        """

    def borrow(self, tape: object, offset: int, reserved: int, tags: tuple[int, int, int, int], /) -> None:
        """Record into a buffer, with the tags of observation, action, step and lanes."""

    def give_back(self) -> tuple[int, int, list[int]]:
        """Record no more; return where the records end, which step is complete, where the numbers of each begin."""

    def pause(self) -> None:
        """Take no steps and report nothing until `resume`, while other code takes a step."""

    def stop(self) -> None:
        """Take no further steps; complete steps are still reported."""

    def told(
        self,
    ) -> tuple[int, object, float, str, tuple[_Vehicles, float, str], tuple[_Vehicles, float, str]] | None:
        """Return step, observation, reward, follower; of this scene and the one before vehicles, time (s), lanes."""

    def columns(self, back: bool, /) -> Columns | None:
        """Return the numbers of the scene, or of the one before."""

    def reads(self, vehicles: _Vehicles, /) -> tuple[object, ...] | None:
        """Return what is read here and nowhere else, to be compared with libsumo's getters."""


_Vehicles = Vehicles  # the core has something of the same name
_UsualSteps = UsualSteps


class Core(Protocol):
    """The compiled module. A function returns None where only the equivalent Python code can do the work."""

    INTERFACE: int

    def bind(self, library: str) -> None:
        """Find libsumo's functions in its library, which is loaded.

        Raises:
            OSError: one is not there.
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
        """Return the usual steps of an episode.

        Args:
            agent: who acts.
            libsumo: the module, whose ``simulationStep`` is called.
            array: what makes an observation, its shape and type.
            others: how many are in it.
            step_s: how long a step is, in s.
            lateral: whether vehicles may be elsewhere than in the middle of a lane.
            takes_speed: whether actions are a speed and a change of lane.
            sight: of which vehicles the surroundings are looked at, every how many steps, how far (m, squared).
            start_m: how far the agent had driven at the start, in m.
        """

    def columns(
        self, vehicles: _Vehicles, points: Sequence[object], headings: Sequence[float], speeds: Sequence[float], /
    ) -> Columns | None:
        """Return the numbers of a scene in which others than vehicles are; None where they are no lists of numbers."""

    def is_coming_or_going(self) -> bool | None:
        """Whether a vehicle has entered or left in the last step."""

    def in_sight(self, controlled: _Vehicles, squared: float, /) -> tuple[tuple[str, ...], Points] | None:
        """Return the ids of all vehicles near some, and where these are; None where libsumo refuses.

        Args:
            controlled: the centres; absent vehicles are ignored.
            squared: the distance below which a vehicle is near, squared, in m².
        """

    def observe(
        self, columns: Columns, row: int, others: int, distance: float, from_left: float, lateral_speed: float, /
    ) -> bytes | None:
        """Return the usual observation of `Kinematics`, as float32."""

    def within_reach(
        self, columns: Columns, earlier: Columns, row: int, step_s: float, hardest: float, /
    ) -> list[int] | None:
        """Return the rows that the oracle ``overlap`` looks at, nearest first.

        Args:
            columns: of a scene.
            earlier: of the same actors, in the scene before.
            row: the actor that they may touch.
            step_s: the time between the two, in s.
            hardest: upper bound of braking, in m/s².
        """

    def may_be_near(
        self, parts: list[Part], gap: float, horizon: float, gap_so_far: float, time_so_far: float,
        braking_so_far: float, only_best: bool, /,
    ) -> tuple[bytes, bytes] | None:  # fmt: skip
        """Return who has a part in the closest approach, and perhaps some who have not.

        In each scene that has anybody, the agent comes first.

        Args:
            parts: of an episode, in order.
            gap: what is further apart does not count, in m.
            horizon: what touches later does not count, in s.
            gap_so_far: pairs further apart may be skipped, in m.
            time_so_far: pairs that touch later may be skipped, in s,
            braking_so_far: if that takes less braking than this as well, in m/s².
            only_best: whether a pair may be skipped that is further apart, touches later and needs less braking
                than another pair.

        Returns:
            Columns one after another, float64 and int64: x, y, heading, speed, half the length, half the width; the
            number of the scene, and where the agent is among those found.
        """

    def tracks(
        self, parts: list[Part], every: int, within: float, ahead: float, behind: float, unknown: float, /
    ) -> tuple[tuple[bytes, bytes], tuple[bytes, bytes]] | None:
        """Return where an agent was, and who was near it.

        Args:
            parts: of an episode, in order.
            every: of how many scenes one is looked at.
            within: how near, between fronts and without the lengths of both, in m.
            ahead: if it is not 0, actors off the agent's way up to this distance are skipped, in m,
            behind: the same backwards, in m.
            unknown: how far straight on its way is taken to go at its end, in m.

        Returns:
            Twice columns one after another, float64 and int64, for the agent and for the others: x, y, heading, half
            the length, half the width; of the agent the number of each scene, of the others which of these scenes, and
            whose number.
        """

    def least_change(self, earlier: Columns, later: Columns, /) -> float | None:
        """Return the least change of speed (m/s) between two scenes; 0 in an empty scene."""

    def write_step(
        self, buffer: object, offset: int, tag: int, step: int, time_s: float, rewards: tuple[float, ...],
        columns: Columns, phase: int, /,
    ) -> int | None:  # fmt: skip
        """Write the record of a step, and where the process is; return where the record ends."""

    def write_array(
        self, buffer: object, offset: int, tag: int, agent: int, array: object, step: int, phase: int, /
    ) -> int | None:
        """Write the record of an array, and where the process is; return where the record ends."""


@cache
def _installed() -> Core | None:
    try:
        core: Core = importlib.import_module(_MODULE)
    except ImportError:  # not built, or for another Python
        return None
    return core


def why_not(libsumo: str) -> str:
    """Return why the core is not used with a version of libsumo; empty where it is."""
    core = _installed()
    if core is None:
        return "it is not built"
    if core.INTERFACE != _INTERFACE:
        return f"it is of another version of crashhunt ({core.INTERFACE} instead of {_INTERFACE})"
    if libsumo not in _CHECKED:
        return f"it was checked with libsumo {', '.join(_CHECKED)}, and this is {libsumo}"
    return ""


def core_for(libsumo: str, library: str) -> Core | None:
    """Return the core, ready for use; None where it cannot be used.

    Args:
        libsumo: its version.
        library: the path of its library, which is loaded.
    """
    core = _installed()
    if core is None or why_not(libsumo):
        return None
    try:
        core.bind(library)
    except OSError:  # such as on a system that looks names up otherwise
        return None
    return core
