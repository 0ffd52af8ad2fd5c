"""The search for the last step from which a manoeuvre avoids a collision: which runs it asks for, and in what order."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from crashhunt.crashes import Attempt, Judgement

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from crashhunt.crashes import Ending

__all__ = ["CannotError", "Search", "Tried"]

_FOR_BRAKING = 0.6  # of the runs; the rest is for changing lanes
_STANDS = 0.1  # m/s²
_TOO_FEW = "no runs were left for changing lanes"


class CannotError(Exception):
    """A manoeuvre cannot be done at all."""


@dataclass(frozen=True, slots=True)
class Tried:
    """One run.

    Args:
        step: after which the agent was overruled.
        ending: what became of the collision.
        deceleration: the greatest, in m/s².
    """

    step: int
    ending: Ending
    deceleration: float = 0.0


class _Enough(Exception):  # noqa: N818 - no error
    """All runs have been used up, or no more would say anything."""


@dataclass(slots=True)
class _Tries:
    """A manoeuvre, and what has come of it so far."""

    manoeuvre: str
    most: int
    endings: dict[int, Ending] = field(default_factory=dict)
    decelerations: list[float] = field(default_factory=list)

    @property
    def last(self) -> int | None:
        """The last step from which it helped."""
        return max((step for step, ending in self.endings.items() if ending == "avoided"), default=None)


class Search:
    """Bisects, and then runs what is left after the last step that helped: helping need not end for good.

    Args:
        end: the step of the crash.
        start: where to begin.
        run: runs a manoeuvre after each of some steps, and yields what comes of it; raises `CannotError`.
        runs: the most runs.
        parallel: how many to ask for at a time.
    """

    def __init__(
        self, end: int, start: int, run: Callable[[str, list[int]], Iterator[Tried]], *, runs: int, parallel: int = 1
    ) -> None:
        self.why_not = ""
        self._end, self._start, self._run = end, start, run
        self._left, self._runs, self._parallel = runs, runs, max(1, parallel)
        self._tries: list[_Tries] = []

    def all(self) -> None:
        """Try braking, and then whether changing lanes helps any longer."""
        if self._end < 1:
            self.why_not = "it crashed in its first step"
            return
        start = min(max(0, self._start), self._end - 1)
        last = self._try("brake", int(self._runs * _FOR_BRAKING) or 1, start, 0)
        first = 0 if last is None else last + 1
        if last == self._end - 1:
            return  # nothing can help any longer
        for side, share in (("left", 2), ("right", 1)):
            if self.why_not:
                return
            if self._left > 0:
                self._try(side, self._left // share or 1, self._end - 1, first)
            elif all(tries.last is None for tries in self._tries):  # else it would read as if nothing could help
                self.why_not = _TOO_FEW

    def judgement(self) -> Judgement:
        """Return what has been found so far."""
        attempts = [
            Attempt(
                tried.manoeuvre,
                self._end,
                dict(tried.endings),
                max((value for value in tried.decelerations if value > _STANDS), default=None),
            )
            for tried in self._tries
            if tried.endings
        ]
        return Judgement(tuple(attempts), self.why_not)

    def _try(self, manoeuvre: str, most: int, start: int, first: int) -> int | None:
        """Search for the last step from which a manoeuvre helps; return it, None where none was found."""
        tries = _Tries(manoeuvre, most)
        self._tries.append(tries)
        try:
            self._find(tries, start, first)
            self._look_after(tries, first)
        except _Enough:
            pass
        except CannotError as error:
            if manoeuvre == "brake":
                self.why_not = str(error)
        return tries.last

    def _find(self, tries: _Tries, start: int, first: int) -> None:
        """Bisect between a step that helps and one that does not."""
        self._ask(tries, {start, self._end - 1} if self._parallel > 1 else {start})
        stride = 1
        while True:
            helps = tries.last
            above = -1 if helps is None else helps
            late = min((step for step in tries.endings if step > above), default=self._end)
            if helps is None:
                if late <= first:
                    return
                steps = {max(first, late - stride * 2**more) for more in range(self._parallel)}
                stride *= 2**self._parallel
            elif late - helps <= 1:
                return
            else:
                parts = min(self._parallel, late - helps - 1) + 1
                steps = {helps + (late - helps) * part // parts for part in range(1, parts)}
            self._ask(tries, steps)

    def _look_after(self, tries: _Tries, first: int) -> None:
        """Run what is left after the last step that helped, the latest first."""
        while True:
            above = first - 1 if tries.last is None else tries.last
            left = [step for step in range(self._end - 1, above, -1) if step not in tries.endings]
            if not left:
                return
            self._ask(tries, left[: self._parallel])

    def _ask(self, tries: _Tries, steps: Iterable[int]) -> None:
        """Run the manoeuvre after each of some steps.

        Raises:
            _Enough: there are no runs left.
        """
        new = sorted(step for step in steps if step not in tries.endings)
        new = new[: max(0, min(self._left, tries.most - len(tries.endings)))]
        if not new:
            raise _Enough
        for tried in self._run(tries.manoeuvre, new):
            self._left -= 1
            tries.endings[tried.step] = tried.ending
            tries.decelerations.append(tried.deceleration)
            if tried.ending == "diverged":
                self.why_not = f"the trial was not the same up to step {tried.step} when it was run again"
                raise _Enough
