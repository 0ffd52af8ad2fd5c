"""Rare mode on the Markov model of the tests, for many roots at once, as arrays.

A study needs 100,000 roots for each case. One at a time, each step of each copy takes some microseconds of Python. Here
one operation takes a step of all of them. The onsets are those of `crashhunt.disturbances.FirstOnsets`, and a test
compares them number by number. Learning, values and intervals are those of crashhunt.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from crashhunt.disturbances import COPIES_PER_ROOT, FIRST_STEP, cell_of
from crashhunt.trial import Disturbance, Forced, ForcedCopy, Forcing, Outcome, TrialResult, TrialSpec

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "tests" / "statistics"))

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    Draw = Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.float64]]
    """Returns the uniform numbers of some rows, each with the number of an onset in this row."""

from markov import AGENT, ENTERS, HARD, LEAVES, WINDOW, models  # type: ignore[import-not-found]

_SENSOR: Final = "late_action"
_NEVER: Final = 1 << 30


@dataclass(frozen=True, slots=True)
class _Place:
    """A model, with the cells that find a vehicle where one is ahead.

    Args:
        name: its name.
        chance: per step.
        order: within a step.
        cells: number of the cell and share of the draws, in the order in which `FirstOnsets` proposes.
        share: share of the draws that are effective.
    """

    name: str
    chance: float
    order: int
    cells: tuple[tuple[int, float], ...]
    share: float


class Arrays:
    """The model, and what its cells are.

    Args:
        model: a `markov.Model`.

    Attributes:
        keys: the keys of all cells.
    """

    def __init__(self, model: Any) -> None:
        self.model = model
        self.keys: list[str] = []
        self.places: list[_Place] = []
        known = models()
        for order, name in enumerate(name for name in known if name in model.chances):
            cells = []
            for drawn, share in known[name].possibilities():
                if drawn.who in ("ahead", "itself"):
                    key = cell_of(name, drawn.how_strong)
                    if key not in self.keys:
                        self.keys.append(key)
                    cells.append((self.keys.index(key), share))
            share = 0.0
            for _, one in cells:
                share += one
            self.places.append(_Place(name, model.chances[name], order, tuple(cells), share))
        self.order = np.zeros(len(self.keys), int)
        for place in self.places:
            self.order[[cell for cell, _ in place.cells]] = place.order

    def cells_of(self, name: str) -> list[int]:
        """Return the numbers of the cells of a model."""
        return [number for number, key in enumerate(self.keys) if key.partition("=")[0] == name]


class _Onsets:
    """`FirstOnsets` of many roots or copies.

    Args:
        arrays: the model.
        spacing: by row.
        ratios: by row and cell.
        first: the first step in which an onset is forced, by row.
        after_order: in that step, only onsets of later places are forced, by row.
        draw: returns uniform numbers.
    """

    def __init__(
        self, arrays: Arrays, spacing: NDArray[np.float64], ratios: NDArray[np.float64], first: NDArray[np.int64],
        after_order: NDArray[np.int64], draw: Draw,
    ) -> None:  # fmt: skip
        count = len(spacing)
        self.arrays, self.spacing, self.ratios, self.first, self.after_order = (
            arrays,
            spacing,
            ratios,
            first,
            after_order,
        )
        self.survival, self.masses = np.ones(count), np.zeros((count, len(arrays.keys)))
        self._draw, self._proposed, self._number = draw, np.zeros(count), np.zeros(count, int)
        everyone = np.arange(count)
        self._point = draw(everyone, self._number) * spacing

    def after(self, step: int, rows: NDArray[np.int64], there: NDArray[np.bool_]) -> list[tuple[Any, ...]]:
        """Return the onsets after a step, each as row, cell, step and number.

        Args:
            step: the step that is complete.
            rows: the rows that are not over.
            there: whether a vehicle is ahead, by row of all.
        """
        found: list[tuple[Any, ...]] = []
        ahead = rows[there[rows]]
        for is_sensor in (False, True):
            begins = step + 1 + is_sensor
            if begins > self.arrays.model.steps:
                continue
            for place in self.arrays.places:
                if (place.name == _SENSOR) is is_sensor:
                    some = rows if is_sensor else ahead
                    first = self.first[some]
                    due = (first < begins) | ((first == begins) & (place.order > self.after_order[some]))
                    found += [(*one, begins) for one in self._propose(place, some[due])]
        return found

    def _propose(self, place: _Place, rows: NDArray[np.int64]) -> list[tuple[Any, ...]]:
        found = []
        here = self.survival[rows] * place.chance
        proposed = np.zeros(len(rows))
        for cell, share in place.cells:
            mass = here * share
            self.masses[rows, cell] += mass
            proposed += mass * self.ratios[rows, cell]
            while (hit := self._point[rows] < self._proposed[rows] + proposed).any():
                some = rows[hit]
                found.append((some, np.full(len(some), cell), self._number[some]))
                self._number[some] += 1
                number = self._number[some]
                self._point[some] = (number + self._draw(some, number)) * self.spacing[some]
        self._proposed[rows] += proposed
        self.survival[rows] *= 1.0 - place.chance * place.share
        return found


@dataclass(slots=True)
class _Copies:
    """Running trials, by row.

    Args:
        root: number of the root, whose draws it has.
        branched: the step after which it left.
        there: whether a vehicle is ahead.
        left: steps left of the window.
        disturbed: whether an onset was effective.
        late: whether the agent acts late from step 1 on.
        onset: the first onset: its step.
        cell: its cell.
        second: the forced second onset: its step; never, if there is none.
        second_cell: its cell.
        later: the step after which onsets are drawn; never, if none are.
        later_order: in that step, those of later places are drawn.
    """

    root: NDArray[np.int64]
    branched: NDArray[np.int64]
    there: NDArray[np.bool_]
    left: NDArray[np.int64]
    disturbed: NDArray[np.bool_]
    late: NDArray[np.bool_]
    onset: NDArray[np.int64]
    cell: NDArray[np.int64]
    second: NDArray[np.int64]
    second_cell: NDArray[np.int64]
    later: NDArray[np.int64]
    later_order: NDArray[np.int64]

    def run(
        self, arrays: Arrays, draws: NDArray[np.float64], rng: np.random.Generator, onsets: _Onsets | None = None,
        rows: NDArray[np.int64] | None = None,
    ) -> tuple[NDArray[np.bool_], NDArray[np.int64], list[tuple[Any, ...]]]:  # fmt: skip
        """Run all to their ends.

        Args:
            arrays: the model.
            draws: the random numbers by root and step.
            rng: draws later onsets.
            onsets: proposes onsets in some rows.
            rows: these rows.

        Returns:
            Whether each crashed, its last step, and the onsets with the state that each begins in.
        """
        model, count = arrays.model, len(self.root)
        crashed, ended = np.zeros(count, bool), np.full(count, model.steps)
        proposes = np.zeros(count, bool)
        place_of = np.zeros(count, int)
        if rows is not None:
            proposes[rows] = True
            place_of[rows] = np.arange(len(rows))
        found = []
        for step in range(1, model.steps + 1):
            active = (self.branched < step) & ~crashed
            if onsets is not None and rows is not None:
                some = place_of[active & proposes]
                for row, cell, number, begins in onsets.after(step - 1, some, self.there[rows]):
                    mine = rows[row]
                    state = self.there[mine], self.left[mine], self.disturbed[mine]
                    found.append((mine, cell, number, np.full(len(mine), begins), np.full(len(mine), step - 1), *state))
            hit = self._disturb(arrays, rng, step, np.flatnonzero(active), draws)
            crashed[hit] = True
            ended[hit] = step
            rest = np.flatnonzero(active & ~crashed)
            roots = self.root[rest]
            failed = rest[draws[roots, step - 1, 1] < model.hidden]
            crashed[failed] = True
            ended[failed] = step
            moves = draws[roots, step - 1, 2]
            self.there[rest] ^= moves < np.where(self.there[rest], LEAVES, ENTERS)
            self.left[rest] = np.maximum(0, self.left[rest] - 1)
        return crashed, ended, found

    def _disturb(
        self, arrays: Arrays, rng: np.random.Generator, step: int, rows: NDArray[np.int64], draws: NDArray[np.float64]
    ) -> NDArray[np.int64]:
        """Begin the onsets of a step, and return the rows that crash by them."""
        crashed = np.zeros(len(rows), bool)
        planned = (
            np.where(self.onset[rows] == step, self.cell[rows], -1),
            np.where(self.second[rows] == step, self.second_cell[rows], -1),
        )
        for place in arrays.places:
            mine = [cell for cell, _ in place.cells]
            draws_later = (step > self.later[rows]) | (
                (step == self.later[rows]) & (place.order > self.later_order[rows])
            )
            begins = draws_later & (rng.random(len(rows)) < place.chance * place.share)
            for cells in planned:
                begins |= np.isin(cells, mine)
            begins &= ~crashed
            if place.name == _SENSOR:
                begins |= (step == 1) & self.late[rows]
                self.left[rows[begins]] = WINDOW
            else:
                begins &= self.there[rows]
            some = rows[begins]
            self.disturbed[some] = True
            if place.name == "brake":
                crashed[begins] = self.left[some] > 0
                self.left[some] = WINDOW
            elif place.name == "stop":
                (hard,) = (cell for cell in set(mine) if arrays.keys[cell] == cell_of("stop", HARD))
                share = sum(share for cell, share in place.cells if cell == hard) / place.share
                is_hard = np.where(draws_later[begins], rng.random(len(some)) < share, False)
                for cells in planned:
                    is_hard |= cells[begins] == hard
                crashed[begins] = is_hard & (draws[self.root[some], step - 1, 0] < arrays.model.fails)
        return rows[crashed]


def _copies(root: NDArray[np.int64], **given: Any) -> _Copies:
    """Return copies without onsets, of a state before the first step, with some of it given."""
    count = len(root)
    whole = {name: np.zeros(count, int) for name in ("branched", "left", "cell", "second_cell", "later_order")}
    none = {name: np.full(count, _NEVER) for name in ("onset", "second", "later")}
    flags = {name: np.zeros(count, bool) for name in ("there", "disturbed", "late")}
    return _Copies(root=root, **{**whole, **none, **flags, **given})


def run_roots(
    arrays: Arrays, forcings: Sequence[Forcing], seeds: NDArray[np.int64], rng: np.random.Generator, *,
    draws: NDArray[np.float64] | None = None, draw: Draw | None = None, draw_seconds: Draw | None = None,
) -> list[TrialResult]:  # fmt: skip
    """Return the results of roots, as `markov.run_root` gives them.

    Args:
        arrays: the model.
        forcings: forcing of each root.
        seeds: seed of each root, which says which copy is a pilot.
        rng: draws all that is not given.
        draws: the random numbers by root and step.
        draw: returns the uniform numbers of the onsets of roots.
        draw_seconds: the same for copies of roots; its rows are 1,000 times the root, and the number of the copy.
    """
    model, count = arrays.model, len(forcings)
    if draws is None:
        draws = rng.random((count, model.steps, 3))

    def draw_any(rows: NDArray[np.int64], _: NDArray[np.int64]) -> NDArray[np.float64]:
        return rng.random(len(rows))

    spacing = np.array([one.spacing for one in forcings])
    ratios = np.array([[one.ratios.get(key, 1.0) for key in arrays.keys] for one in forcings])
    everyone = np.arange(count)
    late = np.zeros(count, bool)
    if _SENSOR in model.chances:
        late = rng.random(count) < model.chances[_SENSOR]
    roots = _copies(everyone, late=late.copy())
    onsets = _Onsets(
        arrays, spacing, ratios, np.full(count, FIRST_STEP), np.full(count, -1), draw or draw_any
    )  # fmt: skip
    crashed, ended, found = roots.run(arrays, draws, rng, onsets, everyone)
    firsts = _joined(found)
    order = np.argsort(firsts[0], kind="stable")
    root, cell, number, begins, branched, there, left, disturbed = (column[order] for column in firsts)
    second_spacing = np.array([one.second_spacing for one in forcings])
    has_seconds = np.array([[key in one.second for key in arrays.keys] for one in forcings])
    follows = (number == seeds[root] % COPIES_PER_ROOT) | has_seconds[root, cell]
    follows &= second_spacing[root] > 0
    made = _copies(
        root, branched=branched, there=there.copy(), left=left.copy(), disturbed=disturbed.copy(),
        late=late[root] & (branched == 0), onset=begins, cell=cell,
        later=np.where(follows, _NEVER, begins), later_order=arrays.order[cell],
    )  # fmt: skip
    rows = np.flatnonzero(follows)
    numbered = root[rows] * 1000 + number[rows]

    def draw_of_copies(some: NDArray[np.int64], which: NDArray[np.int64]) -> NDArray[np.float64]:
        assert draw_seconds is not None
        return draw_seconds(numbered[some], which)

    following = _Onsets(
        arrays, second_spacing[root[rows]], np.ones((len(rows), len(arrays.keys))), begins[rows],
        arrays.order[cell[rows]], draw_of_copies if draw_seconds is not None else draw_any,
    )  # fmt: skip
    copy_crashed, copy_ended, again = made.run(arrays, draws, rng, following, rows)
    within = np.ones(len(root))
    within[rows] = following.survival
    seconds = _joined(again)
    order = np.argsort(seconds[0], kind="stable")
    first, cell_2, _, begins_2, branched_2, there, left, disturbed = (column[order] for column in seconds)
    other = _copies(
        root[first], branched=branched_2, there=there.copy(), left=left.copy(), disturbed=disturbed.copy(),
        late=late[root[first]] & (branched_2 == 0), onset=begins[first], cell=cell[first],
        second=begins_2, second_cell=cell_2, later=begins_2, later_order=arrays.order[cell_2],
    )  # fmt: skip
    crashed_2, ended_2, _ = other.run(arrays, draws, rng)

    # As crashhunt's own objects: the rest of the study is crashhunt itself.
    weight = spacing[root] / ratios[root, cell]
    keys = arrays.keys
    groups: list[list[ForcedCopy]] = [[] for _ in range(count)]
    after: list[list[int]] = [[] for _ in range(len(root))]
    for row, one in enumerate(first.tolist()):
        after[one].append(row)
    columns = zip(
        root.tolist(), cell.tolist(), begins.tolist(), weight.tolist(), branched.tolist(), copy_crashed.tolist(),
        copy_ended.tolist(), made.disturbed.tolist(), within.tolist(), after, strict=True,
    )  # fmt: skip
    later = list(
        zip(
            cell_2.tolist(), begins_2.tolist(), branched_2.tolist(), crashed_2.tolist(), ended_2.tolist(),
            other.disturbed.tolist(), strict=True,
        )
    )  # fmt: skip
    steps = np.bincount(root, copy_ended - branched, count) + np.bincount(root[first], ended_2 - branched_2, count)
    for of, kind, begin, weighs, left_at, has_crashed, end, is_disturbed, share, mine in columns:
        group = groups[of]
        group.append(
            ForcedCopy(
                keys[kind], begin, weighs * share, left_at, "collision" if has_crashed else "", end, is_disturbed,
                within=share,
            )
        )  # fmt: skip
        for row in mine:
            kind_2, begin_2, left_2, has_crashed_2, end_2, is_disturbed_2 = later[row]
            share_2 = float(second_spacing[of])
            group.append(
                ForcedCopy(
                    keys[kind], begin_2, weighs * share_2, left_2, "collision" if has_crashed_2 else "", end_2,
                    is_disturbed_2, within=share_2, second=keys[kind_2],
                )
            )  # fmt: skip
    results = []
    survival, masses = onsets.survival.tolist(), onsets.masses.tolist()
    for number_of, forcing in enumerate(forcings):
        known = {key: mass for key, mass in zip(keys, masses[number_of], strict=True) if mass}
        planned = (Disturbance(1, "itself", _SENSOR, 0.5, 1.0, AGENT),) if late[number_of] else ()
        spec = TrialSpec(
            0, int(seeds[number_of]), {}, {}, model.steps, disturbances=planned, forcing=forcing
        )  # fmt: skip
        results.append(
            TrialResult(
                spec,
                Outcome.COLLISION if crashed[number_of] else Outcome.SURVIVED,
                steps=int(ended[number_of]),
                disturbances=planned if roots.disturbed[number_of] else (),
                forced=Forced(survival[number_of], known, tuple(groups[number_of]), int(steps[number_of])),
            )
        )
    return results


def _joined(found: list[tuple[Any, ...]]) -> list[NDArray[Any]]:
    """Return the columns of onsets as arrays."""
    if not found:
        kinds = (int, int, int, int, int, bool, int, bool)
        return [np.zeros(0, kind) for kind in kinds]
    return [np.concatenate(column) for column in zip(*found, strict=True)]
