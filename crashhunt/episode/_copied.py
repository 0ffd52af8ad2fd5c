"""Copies of an episode that goes on: those of its process."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Self, TypeVar

from crashhunt.base.asleep import Asleep
from crashhunt.base.forks import Copy, Held

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.base.plain import Plain

__all__ = ["Copied"]

C = TypeVar("C")


class Copied:
    """The part of an `Episode` that copies are made by."""

    def __init__(self) -> None:
        super().__init__()
        self._held = Held()
        self._on_copied: list[Callable[[], None]] = []

    def _goes_on(self) -> bool:
        raise NotImplementedError

    def _look_away(self) -> None:
        raise NotImplementedError

    def fork(self, work: Callable[[Self], Plain], *, observed: bool = True) -> Copy:
        """Copy this process with the episode in it, between two steps; the copy goes on exactly as this one does.

        Args:
            work: what is done in the copy, which then is over; it may fork again. What it returns is its answer.
            observed: whether its observers go on being told. What they record goes elsewhere.

        Raises:
            CannotForkError: the agents, or whoever has begun before them, have something that has no copy.
        """
        return self._copied(Copy, work, observed=observed)

    def leave_asleep(self, work: Callable[..., Plain]) -> Asleep:
        """Leave a copy asleep here; whenever it is asked, a copy of that one goes on from here, told of to nobody.

        Args:
            work: what is done with that copy, and with what is asked.

        Raises:
            CannotForkError: as of `fork`.
        """
        return self._copied(Asleep, work, observed=False)

    def _copied(
        self, make: Callable[[Callable[..., Plain], Held], C], work: Callable[..., Plain], *, observed: bool
    ) -> C:
        if not self._goes_on():
            raise RuntimeError("an episode has copies only while it goes on")

        def go_on(*asked: Plain) -> Plain:
            for tell in self._on_copied if observed else ():
                tell()
            if not observed:
                self._look_away()
            return work(self, *asked)

        copy = make(go_on, self._held)
        self._held = replace(self._held, shared=None)  # looking takes as long as all else, so once has to do
        return copy
