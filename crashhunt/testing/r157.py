"""Answers cases of UN R157 with the reference drivers: ``python -m crashhunt.testing.r157 KIND CASES.csv OUT.csv``.

KIND is ``cut_in``, ``cut_out`` or ``car_following``. OUT.csv has the columns of CASES.csv and the answers of each
driver: 0 for no collision and 1 for a collision. In a cut-in, 2 is a collision with the rear of the other vehicle, and
1 is a collision with its side. The requirement ``reg157`` applies to cut-ins only.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TextIO

from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.base.files import output_file
from crashhunt.base.foreign_code import describe_value
from crashhunt.base.text import listed, one_line, one_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    Columns = Mapping[str, NDArray[np.float64]]

_CASES_AT_ONCE = 1_000  # bounds the memory, whatever the length of the file
_DECIMALS = 6
_INTERRUPTED = 130


@dataclass(frozen=True, slots=True)
class _Kind:
    """The columns of a kind of cases with their least and greatest values, and the models that answer it."""

    columns: Mapping[str, tuple[float, float]]
    models: tuple[str, ...]
    answers: tuple[str, ...]


_DRIVERS = ("cc_human", "fsm", "rss")
_KINDS = {
    "cut_in": _Kind(
        {"ego_kmh": (0.0, 300.0), "other_kmh": (0.0, 300.0), "gap_m": (0.0, 1000.0), "lateral_mps": (0.0, 10.0)},
        (*_DRIVERS, "reg157"),
        ("{}",),
    ),
    "cut_out": _Kind(
        {"ego_kmh": (0.0, 300.0), "front_m": (0.0, 1000.0), "lateral_mps": (-10.0, 10.0)},
        _DRIVERS,
        ("{}", "front_{}", "gap_{}"),
    ),
    "car_following": _Kind({"ego_kmh": (0.0, 300.0), "decel_g": (0.0, 2.0)}, _DRIVERS, ("{}", "gap_{}", "dv_{}")),
}


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(message, fix="give KIND CASES.csv OUT.csv, as in: cut_in cases.csv answers.csv")


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    try:
        return _answer(words)
    except CrashhuntError as error:
        sys.stderr.write(f"{one_line(f'r157: {error}')}\n")
        return error.exit_code
    except KeyboardInterrupt:
        sys.stderr.write("r157: interrupted; nothing has been written\n")
        return _INTERRUPTED


def _answer(words: Sequence[str] | None) -> int:
    parser = _Parser(
        prog="python -m crashhunt.testing.r157",
        description="Answer cases of UN R157 with the reference drivers cc_human, fsm, rss and reg157.",
        allow_abbrev=False,
    )
    parser.add_argument("kind", metavar="KIND", help=listed(_KINDS))
    parser.add_argument("cases", metavar="CASES.csv", type=Path, help="one case a row; columns depend on KIND")
    parser.add_argument("out", metavar="OUT.csv", type=Path, help="the cases with the answers; replaced if it exists")
    parser.add_argument(
        "--simulator",
        default="kinematic",
        metavar="NAME",
        help="that moves the own vehicle: kinematic (default: equations of motion) or sumo",
    )
    given = parser.parse_args(words)
    if given.kind not in _KINDS:
        raise UsageError(f"the kind {describe_value(given.kind)} is unknown", fix=one_of(given.kind, _KINDS))
    solve = _solver_of(given.simulator, given.kind)
    kind = _KINDS[given.kind]
    with (
        _opened(given.cases) as source,
        output_file(given.out) as made,
        open(made, "w", encoding="utf-8", newline="") as file,
    ):
        _write_answers(_Table(given.cases, source, kind), kind, solve, file)
    return 0


def _solver_of(simulator: str, kind: str) -> Callable[[Columns, str], Mapping[str, NDArray[np.float64]]]:
    from crashhunt.testing._kinematic_cases import LENGTH_M, STEP_S, solve

    if simulator == "kinematic":
        return partial(solve, kind)
    if simulator == "sumo":
        from crashhunt.sumo import Fleet

        return partial(solve, kind, make=partial(Fleet, length_m=LENGTH_M, step_s=STEP_S))
    raise UsageError(
        f"the simulator {describe_value(simulator)} is unknown", fix=one_of(simulator, ("kinematic", "sumo"))
    )


def _opened(path: Path) -> TextIO:
    try:
        return open(path, encoding="utf-8-sig", newline="")
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise UsageError(f"cannot be read: {reason}", fix="give a CSV file", where=str(path)) from error


class _Table:
    """A CSV file of cases.

    Raises:
        UsageError: the file is empty, or a column is missing.
    """

    def __init__(self, path: Path, file: TextIO, kind: _Kind) -> None:
        self._path, self._kind = path, kind
        self._rows = csv.reader(file, strict=True)
        self._line = 0
        head = self._next()
        if head is None:
            self._refuse("the file is empty", f"begin with the header {','.join(kind.columns)}")
        self.header = [name.strip() for name in head]
        missing = [name for name in kind.columns if name not in self.header]
        if missing:
            self._refuse(
                f"the column {missing[0]} is missing (found: {listed(map(describe_value, self.header))})",
                f"add the column; this kind needs {', '.join(kind.columns)}",
            )
        twice = [name for name in self.header if self.header.count(name) > 1]
        if twice:
            self._refuse(f"the column {describe_value(twice[0])} occurs twice", "remove one of the two")

    def chunks(self) -> Iterator[tuple[list[list[str]], Columns]]:
        """Yield some rows at a time, with the values of their columns.

        Raises:
            UsageError: a row is not valid, or there are no rows.
        """
        import numpy as np

        places = {name: self.header.index(name) for name in self._kind.columns}
        cases = iter(self._cases, None)
        found = False
        while rows := list(islice(cases, _CASES_AT_ONCE)):
            found = True
            texts = [row for _, row in rows]
            yield (
                texts,
                {
                    name: np.array([self._value(name, row[place], line) for line, row in rows])
                    for name, place in places.items()
                },
            )
        if not found:
            self._refuse("the file has a header and no cases", "add one case a row")

    def _cases(self) -> tuple[int, list[str]] | None:
        while (row := self._next()) is not None:
            if not row:
                continue  # an empty line
            if len(row) != len(self.header):
                self._refuse(
                    f"line {self._line} has {len(row)} cells (allowed: {len(self.header)}, as the header)",
                    "correct the line",
                )
            return self._line, row
        return None

    def _next(self) -> list[str] | None:
        try:
            row = next(self._rows, None)
        except (csv.Error, UnicodeError, OSError) as error:
            self._refuse(f"line {self._rows.line_num + 1} is not CSV in UTF-8: {error}", "correct the file")
        self._line = self._rows.line_num
        return row

    def _value(self, name: str, text: str, line: int) -> float:
        least, most = self._kind.columns[name]
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            self._refuse(
                f"{name} in line {line} is {describe_value(text)} (allowed: {least:g} to {most:g})", "correct the value"
            )
        return value

    def _refuse(self, message: str, fix: str) -> NoReturn:
        raise UsageError(message, fix=fix, where=str(self._path))


def _write_answers(
    table: _Table,
    kind: _Kind,
    solve: Callable[[Columns, str], Mapping[str, NDArray[np.float64]]],
    file: TextIO,
) -> None:
    names = [form.format(model) for model in kind.models for form in kind.answers]
    kept = [place for place, name in enumerate(table.header) if name not in names]
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow([*(table.header[place] for place in kept), *names])
    for rows, columns in table.chunks():
        answers: dict[str, list[str]] = {}
        for model in kind.models:
            for name, values in solve(columns, model).items():
                answers[name] = [_text(name, value) for value in values.tolist()]
        for place, row in enumerate(rows):
            writer.writerow([*(row[each] for each in kept), *(answers[name][place] for name in names)])


def _text(name: str, value: float) -> str:
    """Return an answer as an integer, and a distance or speed with six decimals."""
    return repr(round(value, _DECIMALS)) if name.startswith(("gap_", "dv_")) else str(int(value))


if __name__ == "__main__":
    sys.exit(main())
