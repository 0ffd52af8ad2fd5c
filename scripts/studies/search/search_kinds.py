"""How many kinds of crashes samplers find within a number of trials: ``scripts/studies/run search --kinds TRIALS``.

Kinds are those that ``crashhunt crashes`` tells apart, of the recordings; samplers are told no more than results.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from peers import PEERS
from problems import REAL
from search_pool import trials_on
from stored_hunts import write_hunts

from crashhunt.crashes import signature_of, write_bundle
from crashhunt.hunts import spec_of
from crashhunt.plans import Request, plan, sampler_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from search_pool import Trials

    from crashhunt.plans import HuntSettings
    from crashhunt.trial import TrialResult

_LAG = 4


class _Kinds:
    """Trials on a simulator, and the kinds of their crashes."""

    def __init__(self, trials: Trials, folder: Path) -> None:
        self._trials, self._folder = trials, folder

    def hunt(self, settings: HuntSettings, trials: int) -> list[str]:
        """Return the kind of each crash, in the order of trials."""
        sampler = sampler_of(settings)
        results: dict[int, TrialResult] = {}
        found: dict[int, str] = {}
        asked = told = 0
        while len(results) < trials:
            if asked < trials and told >= asked - _LAG + 1:
                self._trials.submit(spec_of(asked, settings, sampler))
                asked += 1
                continue
            for result, recorded in self._trials.completed():
                results[result.spec.number] = result
                if result.outcome in settings.crash_on:
                    found[result.spec.number] = self._kind(result, recorded)
            while told in results and told <= asked - _LAG:
                if sampler.learns:
                    sampler.tell(results[told])
                told += 1
        return [found[number] for number in sorted(found)]

    def _kind(self, result: TrialResult, recorded: Path) -> str:
        lanes = self._trials.lanes(recorded)
        with tempfile.TemporaryDirectory(dir=self._folder) as place:
            return str(signature_of(write_bundle(Path(place), result, recorded, hunt_seed=0, snapshot="", lanes=lanes)))


def kinds_of(
    name: str, samplers: Sequence[str], seeds: Sequence[int], trials: int, parallel: int
) -> Iterator[tuple[str, int, list[str]]]:
    """Yield, for each hunt on a problem, its sampler, its seed and the kinds of its crashes."""
    problem = REAL[name]
    with trials_on(problem, parallel) as running, tempfile.TemporaryDirectory(prefix="crashhunt-kinds-") as folder:
        for seed in seeds:
            for sampler in samplers:
                asked = Request(trials=1, seed=seed, sampler=PEERS.get(sampler, sampler), **problem.request)
                yield sampler, seed, _Kinds(running, Path(folder)).hunt(plan(asked)[1], trials)


def write_kinds(
    path: Path, names: Sequence[str], samplers: Sequence[str], seeds: Sequence[int], trials: int, parallel: int
) -> None:
    """Hunt, and add to a file of JSON: problem to sampler to seed to the kinds of crashes, in order, as indices."""
    found = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    for name in names:
        row = found.setdefault(name, {"trials": trials, "kinds": []})
        known = row["kinds"]
        left = [seed for seed in seeds if any(str(seed) not in row.get(sampler, {}) for sampler in samplers)]
        for sampler, seed, kinds in kinds_of(name, samplers, left, trials, parallel) if left else ():
            known += dict.fromkeys(kind for kind in kinds if kind not in known)
            row.setdefault(sampler, {})[str(seed)] = [known.index(kind) for kind in kinds]
            write_hunts(path, found)


def kinds_table(path: Path) -> str:
    """Return it as Markdown: the mean numbers of kinds and of crashes in a hunt."""
    lines = ["| problem | trials | hunts | sampler | kinds | crashes |", "| --- | ---: | ---: | --- | ---: | ---: |"]
    for name, row in json.loads(path.read_text(encoding="utf-8")).items():
        for sampler, hunts in row.items():
            if sampler not in ("trials", "kinds"):
                many, kinds = len(hunts), sum(len({*of}) for of in hunts.values())
                crashes = sum(len(of) for of in hunts.values())
                lines.append(
                    f"| {name} | {row['trials']} | {many} | {sampler} | {kinds / many:.1f} | {crashes / many:.1f} |"
                )
    return "\n".join(lines)
