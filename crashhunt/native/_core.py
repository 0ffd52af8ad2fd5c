"""Whether the compiled core can be used, and what it offers."""

from __future__ import annotations

import importlib
from functools import cache
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Core", "Vehicles", "core_for", "why_not"]

# Not part of this package: a snapshot of the code has no compiled part, and uses the one that is installed, if any.
_MODULE = "_crashhunt_core"
_INTERFACE = 3
"""Raised whenever a function of the core changes; a core of another one is not used. scripts/build_core.py reads it."""
_CHECKED = ("1.28.0",)
"""The versions of libsumo of whose functions the core knows how they are called."""

Points = list[tuple[float, float]]


class Vehicles(Protocol):
    """Some vehicles of the running simulation."""

    def read(self) -> tuple[Points, list[float], list[float]] | None:
        """Return points (m), headings (rad) and speeds (m/s); None where libsumo refuses, as its getters will."""


class Core(Protocol):
    """The compiled module. A function that cannot do what the Python beside its use does returns None."""

    INTERFACE: int

    def bind(self, library: str) -> None:
        """Find libsumo's functions in its library, which is loaded.

        Raises:
            OSError: one is not there.
        """

    def Vehicles(self, ids: tuple[str, ...]) -> Vehicles:  # noqa: N802 - a class
        """Return vehicles by their ids."""

    def is_coming_or_going(self) -> bool | None:
        """Whether a vehicle has entered or left in the last step."""

    def in_sight(self, controlled: object, squared: float, /) -> tuple[tuple[str, ...], Points] | None:
        """Return the ids of all vehicles near some, and where these are; None where libsumo refuses.

        Args:
            controlled: `Vehicles`; those that are not there are left out.
            squared: the distance below which somebody is near, squared, in m².
        """

    def observe(
        self, points: Sequence[object], headings: Sequence[float], speeds: Sequence[float], lengths: list[float],
        row: int, others: int, distance: float, from_left: float, lateral_speed: float, /,
    ) -> bytes | None:  # fmt: skip
        """Return the usual observation of `Kinematics`, as float32."""

    def within_reach(
        self, points: Sequence[object], headings: Sequence[float], speeds: Sequence[float],
        earlier_points: Sequence[object], earlier_headings: Sequence[float], earlier_speeds: Sequence[float],
        lengths: list[float], widths: list[float], reaches: list[float], row: int, further: float, limit: float, /,
    ) -> list[int] | None:  # fmt: skip
        """Return the rows that the oracle ``overlap`` looks at, nearest first."""

    def may_be_near(
        self, columns: object, actors: int, row: int, lengths: list[float], widths: list[float], gap: float,
        horizon: float, /,
    ) -> bytes | None:  # fmt: skip
        """Return who has a part in the closest approach, and perhaps some who have not: int64, scene * actors + row.

        In each scene that has anybody, the agent comes first.

        Args:
            columns: of a `Frame`.
            actors: how many.
            row: the agent.
            lengths: of each, in m.
            widths: likewise.
            gap: what is further apart does not count, in m.
            horizon: what touches later does not count, in s.
        """

    def least_change(self, earlier: Sequence[float], later: Sequence[float], /) -> float | None:
        """Return the least difference between two lists of numbers; 0 for empty ones."""

    def write_step(
        self, buffer: object, offset: int, tag: int, step: int, time_s: float, rewards: tuple[float, ...],
        points: Sequence[object], headings: Sequence[float], speeds: Sequence[float], /,
    ) -> int | None:  # fmt: skip
        """Write the record of a step; return where it ends."""


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
