"""The trials that the plots of a hunt show.

Invariant: the sample contains every crash, up to `MAX_CRASHES`, and an evenly spaced share of the other trials. The
share of the other trials is halved whenever the sample has more than `MAX_POINTS` trials.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from crashhunt.base.errors import HuntDirectoryError
from crashhunt.report import GOLDEN_RATIO, is_drawn, trial_point
from crashhunt.results import TrialRow

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from crashhunt.base.codec import JsonObject
    from crashhunt.ledger import Ledger


MAX_POINTS = 4_000
"""Trials without a crash in a plot, at most; more cannot be distinguished."""
MAX_CRASHES = 5_000
"""Crashes in a plot, at most. Of more, an even share is shown, and the page says so."""
Point: TypeAlias = "dict[str, object]"
"""A trial in a plot."""

_CHUNK_TRIALS = 65_536  # numbers at a time, so that the memory does not grow with the hunt


class Sample:
    """Trials for plots: all crashes, and an evenly spaced share of the other trials."""

    def __init__(self, crash_on: Collection[str]) -> None:
        self._crash_on = frozenset(map(str, crash_on))
        self.generation = 0  # counts how often points were taken out
        self.points: list[Point] = []
        self.share = 1.0
        self.crash_share = 1.0
        self.problems: list[str] = []
        self._crashes = 0

    def begin(self, ledger: Ledger, last: int, crashes: int) -> None:
        """Read the sample from the existing trials of a hunt."""
        while (last + 1) * self.share > MAX_POINTS:
            self.share /= 2
        while crashes * self.crash_share > MAX_CRASHES:
            self.crash_share /= 2
        numbers = {number for number in ledger.numbers_of(self._crash_on) if is_drawn(number, self.crash_share)}
        for first in range(0, last + 1, _CHUNK_TRIALS):
            block = np.arange(first, min(first + _CHUNK_TRIALS, last + 1))
            numbers.update(block[block * GOLDEN_RATIO % 1.0 < self.share].tolist())
        self._take(ledger, sorted(numbers))

    def add(self, ledger: Ledger, trials: Iterable[tuple[int, str]]) -> None:
        """Read those of the new trials, given by number and outcome, that belong to the sample."""
        self._take(
            ledger,
            [
                number
                for number, outcome in trials
                if is_drawn(number, self.crash_share if outcome in self._crash_on else self.share)
            ],
        )

    def _take(self, ledger: Ledger, numbers: Iterable[int]) -> None:
        for number in numbers:
            try:
                data = ledger.plain_trial(number)
            except HuntDirectoryError as error:
                self.problems = [*self.problems[:9], str(error)]
                continue
            if data is not None:
                self.points.append(_point(data, self._crash_on))
                self._crashes += bool(self.points[-1]["crash"])
        self._thin()

    def _thin(self) -> None:
        before = self.share, self.crash_share
        others = len(self.points) - self._crashes
        while others > MAX_POINTS:
            self.share /= 2
            others = sum(not point["crash"] and is_drawn(_number(point), self.share) for point in self.points)
        crashes = self._crashes
        while crashes > MAX_CRASHES:
            self.crash_share /= 2
            crashes = sum(bool(point["crash"]) and is_drawn(_number(point), self.crash_share) for point in self.points)
        if (self.share, self.crash_share) == before:
            return
        self.points = [
            point
            for point in self.points
            if is_drawn(_number(point), self.crash_share if point["crash"] else self.share)
        ]
        self._crashes = crashes
        self.generation += 1

    def since(self, cursor: str) -> tuple[list[Point], str, bool]:
        """Return the points added after a cursor, the next cursor, and whether they replace all earlier points.

        For a cursor that no earlier call returned, all points are returned.
        """
        now = f"{self.generation}.{len(self.points)}"
        generation, _, count = cursor.partition(".")
        if generation == str(self.generation) and count.isascii() and count.isdecimal() and len(count) < 10:
            return self.points[int(count) :], now, False
        return self.points, now, True


def _number(point: Point) -> int:
    number = point["number"]
    assert isinstance(number, int)
    return number


def _point(data: JsonObject, crash_on: Collection[str]) -> Point:
    row = TrialRow(data)
    return {
        **trial_point(row),
        "crash": str(row.outcome) in crash_on,
        "steps": data["steps"],
        "disturbances": len(data.get("disturbances", ())),
    }
