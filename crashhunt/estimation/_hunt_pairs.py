"""Pairs of running hunts, which are read while they grow, and the report of a gate on them.

A gate compares two versions, BASE and HEAD, in pairs of trials with the same number, seed, traffic and disturbances.
The pairs have an order that does not depend on results, namely hunt after hunt, and in each hunt by number. Therefore
`PairWatch` may decide after any pair, and the number of workers has no influence.
"""

from __future__ import annotations

import math
import time
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import HuntDirectoryError
from crashhunt.base.json_types import finite_values
from crashhunt.estimation._comparison import why_unpaired
from crashhunt.hunts import counting_rule
from crashhunt.ledger import Ledger, has_begun
from crashhunt.plans import read_settings
from crashhunt.rates import PairSequence, PairTest, facts_of_plain
from crashhunt.training import HeldOutTraffics, held_out_traffics

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from crashhunt.base.codec import JsonObject
    from crashhunt.rates import CrashRate, Interval, Pair, PairVerdict, PairWatch, TrialFacts

__all__ = ["GateCase", "GateReport", "PairedHunts", "ScenarioCounts"]

_FAILED_STATES = ("no_valid_trial", "error")


@dataclass(frozen=True, slots=True)
class GateCase:
    """The result of running one case of the corpus with the code of the version HEAD.

    Args:
        name: name of the case's folder.
        expected: the expected status: ``still`` or ``fixed``.
        got: the status with HEAD: ``still``, ``fixed``, ``changed`` or ``cannot_run``.
        now: description of the present result.
    """

    name: str
    expected: str
    got: str
    now: str

    @property
    def has_come_back(self) -> bool:
        """Whether the case has to stay fixed, but crashes again."""
        return self.expected == "fixed" and self.got in ("still", "changed")


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioCounts:
    """The numbers of trial pairs in one hunt that both BASE and HEAD run.

    Args:
        name: name of the hunt: its id and run in the suite, or the name of the scenario.
        pairs: number of pairs on which the verdict is based.
        only_base: number of the pairs in which only BASE crashes.
        only_head: number of pairs in which only HEAD crashes.
        both: number of pairs in which both crash.
        invalid: number of pairs with an invalid trial, which are excluded for both versions.
    """

    name: str
    pairs: int
    only_base: int
    only_head: int
    both: int
    invalid: int = 0

    def to_json(self) -> JsonObject:
        """Return the counts as JSON-compatible data."""
        return {
            "name": self.name, "pairs": self.pairs, "only_base": self.only_base, "only_head": self.only_head,
            "both": self.both, "invalid": self.invalid,
        }  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class GateReport:
    """The report of a gate.

    Args:
        verdict: verdict on HEAD, compared with BASE: ``better``, ``worse``, ``no_difference`` or ``undecided``.
        base: the version BASE: a commit or an agent.
        head: the version HEAD: a commit or an agent.
        pairs: number of pairs on which the verdict is based.
        only_base: number of the pairs in which only BASE crashes.
        only_head: number of pairs in which only HEAD crashes.
        both: number of pairs in which both versions crash.
        evidence: e-value against the hypothesis that both versions crash equally often.
        difference: interval of the difference in crashes per trial, HEAD minus BASE; None without a pair.
        margin: the greatest difference that counts as no difference; 0 to disable this verdict.
        confidence: confidence in percent, of the verdict and of the interval.
        seed: seed of the hunts.
        scenarios: the counts of pairs for each hunt.
        rates: crash rates of BASE and of HEAD, if each has only one hunt, and it has begun.
        corpus: the cases that were run; None if there is no corpus.
        why: reason why the verdict differs from the verdict of the pairs, or why there is no verdict; empty if neither
            applies.
        is_interrupted: whether the gate was interrupted before its end.
        dir: directory of the hunts; empty if they are not kept.
        trained_on: number of pairs that do not count, because an agent was trained on their traffic.
    """

    verdict: PairVerdict
    base: str
    head: str
    pairs: int = 0
    only_base: int = 0
    only_head: int = 0
    both: int = 0
    evidence: float = 1.0
    difference: Interval | None = None
    margin: float = 0.0
    confidence: float = 95.0
    seed: int | None = None
    scenarios: tuple[ScenarioCounts, ...] = ()
    rates: tuple[CrashRate, CrashRate] | None = None
    corpus: tuple[GateCase, ...] | None = None
    why: str = ""
    is_interrupted: bool = False
    dir: str = ""
    trained_on: int = 0

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
            "base": None if base is None else finite_values(base.to_json()),
            "head": None if head is None else finite_values(head.to_json()),
            "difference": None if self.difference is None else self.difference._asdict(),
            "corpus": corpus,
            "compared": {"base": self.base, "head": self.head},
            "only_base": self.only_base,
            "only_head": self.only_head,
            "both": self.both,
            "evidence": self.evidence if math.isfinite(self.evidence) else None,
            "margin": self.margin,
            "confidence": self.confidence,
            "seed": self.seed,
            "scenarios": [one.to_json() for one in self.scenarios],
            "why": self.why,
            "interrupted": self.is_interrupted,
            "dir": self.dir or None,
            "trained_on": self.trained_on,
        }


class PairedHunts:
    """Reads the pairs of trials from BASE's hunt and HEAD's hunt in one scenario, while other processes run both hunts.

    Args:
        name: name of the hunt.
        base: directory of BASE's hunt.
        head: directory of HEAD's hunt.
        pairs: maximum number of trials of each hunt.

    Attributes:
        trained_on: number of pairs that do not count, because an agent was trained on their traffic.
    """

    def __init__(self, name: str, base: Path, head: Path, pairs: int) -> None:
        self.name, self.folders, self.most = name, (base, head), pairs
        self.trained_on = 0
        self._held_out: HeldOutTraffics | None = None
        self._sequence: PairSequence | None = None
        self._crash_on: tuple[str, ...] = ()
        self._test = PairTest()
        self._began = time.time()  # as ledgers have it

    def take(self, watch: PairWatch, *, may_end: bool = True) -> None:
        """Pass the pairs that are complete to a watch, until a pair decides.

        Args:
            watch: watch of all pairs of the gate.
            may_end: whether the verdicts *better* and *no difference* are allowed yet; *worse* is always allowed.

        Raises:
            HuntDirectoryError: the two hunts do not have the same traffic, or a ledger is damaged.
        """
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
            self._test.add(pair)
            watch.test.add(pair)
            if not self.why_not:
                watch.decide(may_end=may_end)

    @property
    def counts(self) -> ScenarioCounts:
        """Return the counts of the pairs until now."""
        test, sequence = self._test, self._sequence
        return ScenarioCounts(
            name=self.name,
            pairs=test.pairs,
            only_base=test.only_first,
            only_head=test.only_second,
            both=test.both,
            invalid=0 if sequence is None else sequence.invalid,
        )

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
                for data in ledger.plain_results_where("number >= ?", sequence.position):
                    tags = (str(data["spec"]["seed"]),)
                    yield from sequence.add(side, facts_of_plain(data, self._crash_on, tags))


def _is_same(base: TrialFacts, head: TrialFacts) -> bool:
    return base.tags == head.tags
