"""Pairs of running hunts, which are read while they grow, and the report of a gate on them.

A gate compares two versions, BASE and HEAD, in pairs of trials with the same number, seed, traffic and disturbances.
The pairs have an order that does not depend on results, namely hunt after hunt, and in each hunt by number. Therefore
`PairWatch` may decide after any pair, and the number of workers has no influence.
"""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

from crashhunt.base import layout
from crashhunt.base.codec import plain
from crashhunt.base.errors import HuntDirectoryError
from crashhunt.base.json_types import finite
from crashhunt.ledger import Ledger, has_begun
from crashhunt.plans import read_settings
from crashhunt.statistics._comparison import why_unpaired
from crashhunt.statistics._counted_pairs import Pair, PairSequence, SideCounts
from crashhunt.statistics._counted_trials import TrialFacts, facts_of_plain
from crashhunt.statistics._hunt_rate import crash_types
from crashhunt.statistics._paired_test import PairTest
from crashhunt.statistics._rate_of_running_hunt import counting_rule
from crashhunt.training import HeldOutTraffics, held_out_traffics
from crashhunt.trial import KILLED

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from crashhunt.base.codec import JsonObject
    from crashhunt.statistics._anytime_interval import Interval
    from crashhunt.statistics._gate_verdict import PairVerdict, PairWatch
    from crashhunt.statistics._rate_report import CrashRate

_FAILED_STATES = ("no_valid_trial", "error")
_KILLED_SIGN = f'"kind": "{KILLED}"'
_NEW_SQL = "number >= ? AND (ended_at >= ? OR outcome != 'invalid' OR instr(result, ?) = 0)"


@dataclass(frozen=True, slots=True)
class GateCase:
    """The result of running one case of the corpus with the code of the version HEAD."""

    name: str  # name of the case's folder
    expected: str  # the expected status: ``still`` or ``fixed``
    got: str  # the status with HEAD: ``still``, ``fixed``, ``changed`` or ``cannot_run``
    now: str  # description of the present result

    @property
    def has_come_back(self) -> bool:
        """Whether the case has to stay fixed, but crashes again."""
        return self.expected == "fixed" and self.got in ("still", "changed")


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioCounts:
    """The numbers of trial pairs in one hunt that both BASE and HEAD run."""

    name: str  # name of the hunt: its id and run in the suite, or the name of the scenario
    pairs: int  # number of pairs on which the verdict is based
    only_base: int  # number of the pairs in which only BASE crashes or does not start
    only_head: int  # number of pairs in which only HEAD crashes or does not start
    both: int  # number of pairs in which both fail
    invalid: int = 0  # number of pairs whose trials are invalid for both versions; they do not count
    # the trials of BASE and of HEAD that are invalid in one version only
    sides: tuple[SideCounts, SideCounts] = (SideCounts(), SideCounts())
    # for each crash type, the number of crashes of BASE and of HEAD in the pairs
    types: Mapping[str, tuple[int, int]] = field(default_factory=dict)

    def to_json(self) -> JsonObject:
        """Return the counts as JSON-compatible data."""
        return {
            "name": self.name, "pairs": self.pairs, "only_base": self.only_base, "only_head": self.only_head,
            "both": self.both, **_uncounted(self.invalid, self.sides),
        }  # fmt: skip


def _uncounted(invalid: int, sides: tuple[SideCounts, SideCounts]) -> JsonObject:
    """Return the pairs that are invalid as JSON-compatible data."""
    counts = {
        name: {"base": getattr(sides[0], name), "head": getattr(sides[1], name)}
        for name in ("not_started", "killed", "unknown")
    }
    return {"invalid": invalid, **counts}


@dataclass(frozen=True, slots=True, kw_only=True)
class GateReport:
    """The report of a gate."""

    # verdict on HEAD, compared with BASE: ``better``, ``worse``, ``no_difference`` or ``undecided``
    verdict: PairVerdict
    base: str  # the version BASE: a commit or an agent
    head: str  # the version HEAD: a commit or an agent
    pairs: int = 0  # number of pairs on which the verdict is based
    only_base: int = 0  # number of the pairs in which only BASE crashes or does not start
    only_head: int = 0  # number of pairs in which only HEAD crashes or does not start
    both: int = 0  # number of pairs in which both versions fail
    evidence: float = 1.0  # e-value against the hypothesis that both versions crash equally often
    # interval of the difference in failures per trial, HEAD minus BASE, from which the verdict follows; None without a
    # pair
    difference: Interval | None = None
    margin: float = 0.0  # the greatest difference that counts as no difference; 0 to disable this verdict
    confidence: float = 95.0  # confidence in percent, of the verdict and of the interval
    seed: int | None = None  # seed of the hunts
    scenarios: tuple[ScenarioCounts, ...] = ()  # the counts of pairs for each hunt
    # crash rates of BASE and of HEAD, if each has only one hunt, and it has begun
    rates: tuple[CrashRate, CrashRate] | None = None
    corpus: tuple[GateCase, ...] | None = None  # the cases that were run; None if there is no corpus
    # reason why the verdict differs from the verdict of the pairs, or why there is no verdict; empty if neither applies
    why: str = ""
    is_interrupted: bool = False  # whether the gate was interrupted before its end
    dir: str = ""  # directory of the hunts; empty if they are not kept
    trained_on: int = 0  # number of pairs that do not count, because an agent was trained on their traffic
    cautions: tuple[str, ...] = ()  # facts because of which the verdict may not be about the two versions
    # numbers of crashes of both versions, if only preventable crashes count: ``yes``, ``no`` and ``unknown`` for
    # collisions, and ``no_collision``; None if all crashes count
    preventable: Mapping[str, int] | None = None

    @property
    def sides(self) -> tuple[SideCounts, SideCounts]:
        """The trials of BASE and of HEAD that are invalid in one version only."""
        base, head = zip(*(one.sides for one in self.scenarios), strict=True) if self.scenarios else ((), ())
        return sum(base, SideCounts()), sum(head, SideCounts())

    @property
    def invalid(self) -> int:
        """The number of pairs whose trials are invalid for both versions."""
        return sum(one.invalid for one in self.scenarios)

    @property
    def types(self) -> dict[str, tuple[int, int]]:
        """For each crash type, the number of crashes of BASE and of HEAD in the pairs."""
        names = dict.fromkeys(name for one in self.scenarios for name in one.types)
        found = {
            name: tuple(sum(one.types.get(name, (0, 0))[side] for one in self.scenarios) for side in (0, 1))
            for name in names
        }
        return cast("dict[str, tuple[int, int]]", found)

    def new_types(self, side: int) -> dict[str, int]:
        """Return the crash types of BASE (0) or HEAD (1) that the other version does not have, with their counts."""
        return {name: counts[side] for name, counts in self.types.items() if not counts[1 - side]}

    @property
    def back(self) -> tuple[GateCase, ...]:
        """The cases that had to stay fixed, but crash with HEAD."""
        return tuple(case for case in self.corpus or () if case.has_come_back)

    def to_json(self) -> JsonObject:
        """Return the report in the form that ``gate --json`` prints; numbers that are not finite are null."""
        corpus = None
        if self.corpus is not None:
            corpus = {
                "ok": not self.back,
                "cases": len(self.corpus),
                "failed": [case.name for case in self.back],
                "cannot_run": [case.name for case in self.corpus if case.got == "cannot_run"],
            }
        base, head = self.rates or (None, None)
        return {
            "verdict": self.verdict,
            "pairs": self.pairs,
            "base": None if base is None else plain(base.to_json()),
            "head": None if head is None else plain(head.to_json()),
            "difference": None if self.difference is None else self.difference._asdict(),
            "corpus": corpus,
            "compared": {"base": self.base, "head": self.head},
            "only_base": self.only_base,
            "only_head": self.only_head,
            "both": self.both,
            "evidence": finite(self.evidence),
            "margin": self.margin,
            "confidence": self.confidence,
            "seed": self.seed,
            "scenarios": [one.to_json() for one in self.scenarios],
            **_uncounted(self.invalid, self.sides),
            "crash_types": [
                {"type": name, "base": base, "head": head} for name, (base, head) in sorted(self.types.items())
            ],
            "why": self.why,
            "interrupted": self.is_interrupted,
            "dir": self.dir or None,
            "trained_on": self.trained_on,
            "cautions": list(self.cautions),
            **({"preventable": dict(self.preventable)} if self.preventable is not None else {}),
        }


class PairedHunts:
    """Reads the pairs of trials from BASE's hunt and HEAD's hunt in one scenario, while other processes run both hunts.

    Args:
        name: name of the hunt.
        base: directory of BASE's hunt.
        head: directory of HEAD's hunt.
        pairs: maximum number of trials of each hunt.
        counts: function that returns whether a crash counts, from the directory of its hunt and the number of its
            trial; by default, every crash counts.
    """

    def __init__(
        self, name: str, base: Path, head: Path, pairs: int, *, counts: Callable[[Path, int], bool] | None = None
    ) -> None:
        self._counts = counts
        self.name, self.folders, self.most = name, (base, head), pairs
        self.trained_on = 0  # number of pairs that do not count, because an agent was trained on their traffic
        self._held_out: HeldOutTraffics | None = None
        self._sequence: PairSequence | None = None
        self._crash_on: tuple[str, ...] = ()
        self._test = PairTest()
        self._crashed: tuple[list[int], list[int]] = ([], [])
        self._began = self._killed_after = time.time()  # as ledgers have it

    def take(self, watch: PairWatch, *, may_end: bool = True, has_ended: bool = False) -> None:
        """Pass the pairs that are complete to a watch, until a pair decides.

        Unless it ``may_end``, only the verdict *worse* is allowed yet. Before the hunts have ended, trials that were
        killed in an earlier run of the gate do not count, because the hunts run them again.

        Raises:
            HuntDirectoryError: the two hunts do not have the same traffic, or a ledger is damaged.
        """
        if has_ended:
            self._killed_after = 0.0
        sequence = self._sequence = self._sequence or self._pair_sequence()
        if sequence is None:
            return
        for pair in self._read(sequence):
            if watch.verdict != "undecided" or sequence.position > self.most:
                return
            if self._held_out is None:
                # A hunt creates its ledger before its snapshot, which has the training records of its agents. The
                # snapshot exists before the first trial, so read the records only after both trials of a pair.
                self._held_out = held_out_traffics(read_settings(self.folders[0] / layout.HUNT), self.folders)
            if self._held_out.is_empty:
                self.trained_on = self.most
                return
            if not all(self._held_out.has(int(one.tags[0])) for one, _ in pair):
                self.trained_on += 1
                continue
            base, head = self.folders
            pair = tuple((self._counted(base, one), self._counted(head, two)) for one, two in pair)
            self._test.add(pair)
            watch.test.add(pair)
            for both in pair:
                for one, crashed in zip(both, self._crashed, strict=True):
                    if one.crashed:
                        crashed.append(one.number)
            if not self.why_not:
                watch.decide(may_end=may_end)

    def _counted(self, folder: Path, trial: TrialFacts) -> TrialFacts:
        if self._counts is None or not trial.crashed or self._counts(folder, trial.number):
            return trial
        return trial._replace(crashed=False)

    @property
    def counts(self) -> ScenarioCounts:
        """Return the counts of the pairs until now, without crash types."""
        test, sequence = self._test, self._sequence
        base, head = (test.side(side) for side in (0, 1))
        return ScenarioCounts(
            name=self.name,
            pairs=test.pairs,
            only_base=test.only_first,
            only_head=test.only_second,
            both=test.both,
            invalid=0 if sequence is None else sequence.invalid,
            sides=(base, head),
        )

    def crash_types(self) -> dict[str, tuple[int, int]]:
        """Return the number of crashes of BASE and of HEAD in the pairs for each crash type; bundles are read."""
        counts: dict[str, list[int]] = {}
        for side, (folder, numbers) in enumerate(zip(self.folders, self._crashed, strict=True)):
            known = crash_types(folder) if numbers else {}
            for number in numbers:
                if number in known:
                    counts.setdefault(known[number], [0, 0])[side] += 1
        return {name: (base, head) for name, (base, head) in counts.items()}

    @property
    def is_complete(self) -> bool:
        """Whether all pairs have been counted, or none can count."""
        if self._held_out is not None and self._held_out.is_empty:
            return True
        return self._sequence is not None and self._sequence.position >= self.most

    @property
    def why_not(self) -> str:
        """The reason why the pairs until now allow no verdict; empty if they allow one."""
        return "" if self._sequence is None else self._sequence.why_not

    @property
    def is_hopeless(self) -> bool:
        """Whether too many pairs certainly have an invalid trial, so that further pairs change nothing.

        Without any valid pair, the result is False, because the hunt itself then ends and reports the reason.
        """
        return self._sequence is not None and self._sequence.valid > 0 and self._sequence.is_hopeless

    @property
    def cannot_continue(self) -> bool:
        """Whether a hunt failed, and no trial of this hunt waits for its partner."""
        failure = self.failure()
        if failure is None:
            return False
        side, state, _ = failure
        waits = self._sequence is not None and self._sequence.waiting(("base", "head").index(side))
        return state == "error" or not waits

    def failure(self) -> tuple[str, str, str] | None:
        """Return which hunt failed (``base`` or ``head``), its state, and the reason; None if both can run.

        Failures of an earlier run of the gate do not count, because this run may succeed.
        """
        for side, folder in zip(("base", "head"), self.folders, strict=True):
            if has_begun(folder / layout.LEDGER):
                with closing(Ledger(folder / layout.LEDGER)) as ledger:
                    entered = [event for event in ledger.events() if event[1] != "remark"]
                when, state, why = entered[-1] if entered else (0.0, "", "")
                if state in _FAILED_STATES and when >= self._began:
                    return side, state, why or "no trial is valid"
        return None

    def _pair_sequence(self) -> PairSequence | None:
        """Return the sequence of the pairs after both hunts have begun, and check that they have the same traffic."""
        if not all((folder / layout.HUNT).exists() and has_begun(folder / layout.LEDGER) for folder in self.folders):
            return None
        base, head = (read_settings(folder / layout.HUNT) for folder in self.folders)
        if why := why_unpaired(base, head):
            raise HuntDirectoryError(f"the hunts of BASE and HEAD cannot be compared: {why}", where=self.name)
        self._crash_on = tuple(map(str, base.crash_on))
        return PairSequence((counting_rule(base, {}), counting_rule(head, {})), _is_same)

    def _read(self, sequence: PairSequence) -> Iterator[Pair]:
        for side, folder in enumerate(self.folders):
            with closing(Ledger(folder / layout.LEDGER)) as ledger:
                for data in ledger.plain_results_where(_NEW_SQL, sequence.position, self._killed_after, _KILLED_SIGN):
                    tags = (str(data["spec"]["seed"]),)
                    yield from sequence.add(side, facts_of_plain(data, self._crash_on, tags))


def _is_same(base: TrialFacts, head: TrialFacts) -> bool:
    return base.tags == head.tags
