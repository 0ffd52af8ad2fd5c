"""Warm workers for many hunts on one real problem: ``scripts/studies/run search``."""

from __future__ import annotations

import itertools
import tempfile
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.executors import PoolExecutor, read_map
from crashhunt.plans import Request, plan, with_settings

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from problems import Real

    from crashhunt.trial import TrialResult, TrialSpec
    from crashhunt.world import Lane


class Trials:
    """Trials of several hunts, which give them the same numbers, on workers that know a trial by its number.

    Args:
        pool: of workers.
        scratch: where they write.
    """

    def __init__(self, pool: PoolExecutor, scratch: Path) -> None:
        self._pool, self._scratch = pool, scratch
        self._numbers = itertools.count()
        self._under_way: dict[int, TrialSpec] = {}

    def submit(self, spec: TrialSpec) -> None:
        """Begin one."""
        number = next(self._numbers)
        self._under_way[number] = spec
        self._pool.submit(replace(spec, number=number))

    def completed(self) -> Iterator[tuple[TrialResult, Path]]:
        """Yield what has ended within a second, with the folder of its recording, if that was kept."""
        for result in self._pool.completed(1.0):
            number = result.spec.number
            yield replace(result, spec=self._under_way.pop(number)), scratch_of(self._scratch, number)

    def lanes(self, trial: Path) -> Sequence[Lane]:
        """Return the map of a trial that was kept."""
        return read_map(self._scratch, trial)


@contextmanager
def trials_on(problem: Real, parallel: int, probe_s: float = 0.0) -> Iterator[Trials]:
    """Start workers for a problem, and end them."""
    with tempfile.TemporaryDirectory(prefix="crashhunt-search-") as folder:
        scenario, settings = plan(Request(trials=1, seed=1, **problem.request))
        if problem.warmup_s is not None:
            scenario = replace(scenario, warmup_s=problem.warmup_s)
        working = WorkerSettings(
            scenario=with_settings(scenario, settings), oracles=settings.oracles, crash_on=settings.crash_on,
            scratch=Path(folder), probe_s=probe_s,
        )  # fmt: skip
        pool = PoolExecutor(working, parallel=parallel)
        try:
            yield Trials(pool, Path(folder))
        finally:
            pool.close()
