"""Runs of crashes of forks from the start, after the last trial.

The results of the branches and robustness probes of all trials are summed up. A fork shows only a possible crash. A run
from the start confirms the crash, because the bundle of the run can be replayed.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.hunts._reports import BranchReport, ProbeReport, RareReport
from crashhunt.hunts._verification import ForkCrash, VerificationRuns
from crashhunt.results import BRANCHES, PROBES, sums_of_branches, sums_of_probes
from crashhunt.statistics import crashed_copies, rare_watch
from crashhunt.trial import Branches, Stress, in_turn

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.hunts._next_trials import Trials
    from crashhunt.trial import Branch, Disturbance, ForcedCopy, TrialResult


_MAX_VERIFIED_BRANCHES = 10  # trials; each takes two processes of its own


def verify_branches(copies: VerificationRuns) -> BranchReport | None:
    """Sum up the branches of all trials, and run the likeliest crashed branches from the start in new processes.

    Returns:
        The report; None for a hunt without branches.
    """
    ledger = copies.again.ledger
    sums = sums_of_branches(ledger, ledger.facts())
    if sums is None:
        return None
    why_unanswered = ""
    found: list[tuple[int, Branch]] = []  # the likeliest of each trial only: a hunt may have a million trials
    for plain in ledger.plain_results():
        if not (data := plain.get("branches")):
            continue
        one = Branches.from_json(data)
        why_unanswered = why_unanswered or one.why_unanswered
        if one.crashes:
            found.append((plain["spec"]["number"], max(one.crashes, key=_log_likelihood)))
    kept = copies.kept.get(layout.BRANCHES, {})
    specs = [
        _specification(result, branch)
        for number, branch in sorted(found, key=lambda pair: (pair[0] not in kept, -_log_likelihood(pair[1])))[
            :_MAX_VERIFIED_BRANCHES
        ]
        if (result := ledger.result(number)) is not None
    ]
    crashes, not_finished = copies.crashes(specs, layout.BRANCHES, "branches")
    return BranchReport(
        sums=sums,
        why_unanswered=why_unanswered,
        run_again=0 if copies.is_stopped else len(specs),
        not_finished=not_finished,
        crashes=crashes,
    )


def likeliest(result: TrialResult) -> ForkCrash | None:
    """Return a whole trial with the disturbances of the likeliest crashed branch; None if no branch crashed."""
    if result.branches is None or not result.branches.crashes:
        return None
    return _specification(result, max(result.branches.crashes, key=_log_likelihood))


def _specification(result: TrialResult, branch: Branch) -> ForkCrash:
    spec = replace(result.spec, disturbances=branch.disturbances, origin="branch")
    return ForkCrash(spec, branch.outcome, branch.step)


def _log_likelihood(branch: Branch) -> float:
    return -math.inf if branch.log_likelihood is None else branch.log_likelihood


# What probes have found in a hunt, and the mildest of it run from the start: only that is a crash.

_MAX_VERIFIED_PROBES = 3  # trials; each takes two processes of its own


def verify_probes(copies: VerificationRuns) -> ProbeReport | None:
    """Sum up the probes of all trials, and run the mildest crashed probes from the start in new processes.

    Returns:
        The report; None for a hunt without probes.
    """
    ledger = copies.again.ledger
    sums = sums_of_probes(ledger, ledger.facts())
    if sums is None:
        return None
    margins: list[float] = []
    why_unasked = ""
    found: list[tuple[float, int]] = []
    for plain in ledger.plain_results():
        if not (data := plain.get("stress")):
            continue
        stress = Stress.from_json(data)
        if stress.margin is not None:
            margins.append(stress.margin)
        else:
            why_unasked = why_unasked or stress.why_unasked
        if stress.disturbance is not None:
            found.append((stress.least, plain["spec"]["number"]))
    kept = copies.kept.get(layout.PROBES, {})
    results = [
        result
        for _, number in sorted(found, key=lambda pair: (pair[1] not in kept, pair[0]))[:_MAX_VERIFIED_PROBES]
        if (result := ledger.result(number)) is not None
    ]
    specs = [one for result in results if (one := mildest(result)) is not None]
    crashes, not_finished = copies.crashes(specs, layout.PROBES, "probes")
    asked = {result.spec.number: result.stress for result in results}
    return ProbeReport(
        sums=sums,
        margins=tuple(margins),
        why_unasked=why_unasked,
        run_again=0 if copies.is_stopped else len(specs),
        not_finished=not_finished,
        crashes=crashes,
        by=tuple(_as_it_took_place(asked[bundle.result.spec.number], bundle.result) for bundle in crashes),
    )


def _as_it_took_place(stress: Stress | None, result: TrialResult) -> Disturbance:
    """Return the disturbance of a probe with the values that it actually had in the run from the start."""
    assert stress is not None
    planned = stress.disturbance
    assert planned is not None
    key = planned.step, planned.agent, planned.what
    return next((one for one in result.disturbances if (one.step, one.agent, one.what) == key), planned)


def mildest(result: TrialResult) -> ForkCrash | None:
    """Return a trial from the start with the mildest disturbance that made a probe crash; None if no probe crashed."""
    stress = result.stress
    if stress is None or stress.disturbance is None:
        return None
    planned = in_turn([*result.spec.disturbances, stress.disturbance])
    return ForkCrash(replace(result.spec, disturbances=planned, origin="probe"), stress.outcome, stress.step)


# A crash that a copy of a trial has found, and that comes again from the start, ends a hunt as any other does.


class ForkCrashes:
    """Runs crashes of forks from the start, if such a crash may end the hunt.

    Only crashes with the disturbance kinds of the hunt may end the hunt. Probes also try all other kinds, and with the
    strongest plausible disturbance nearly every trial crashes. A crash of a probe measures the robustness of the trial,
    but the hunt does not search for crashes of probes. If the hunt counts crash types or crashes at fault, only trials
    end the hunt.
    """

    def __init__(self, copies: VerificationRuns, trials: Trials) -> None:
        self._copies, self._trials = copies, trials
        self._progress = copies.again.progress
        run, disturber = copies.again.setup.settings.run, copies.disturber
        self._ends = not run.keep_going and not run.only_at_fault and disturber is not None and bool(disturber.models)
        self._deterministic = run.deterministic
        self._waiting: list[TrialResult] = []

    def resume(self) -> None:
        """Add trials of earlier runs of the hunt, which may have been killed before they examined these trials."""
        ledger = self._copies.again.ledger
        if not self._ends or self._progress.is_done:
            return
        numbers = [
            plain["spec"]["number"]
            for plain in ledger.plain_results()
            if ((branches := plain.get("branches")) and branches["crashes"])
            or ((stress := plain.get("stress")) and stress["disturbance"])
        ]
        self._waiting = [result for number in numbers if (result := ledger.result(number)) is not None]
        self.look()

    def add(self, result: TrialResult) -> None:
        """Add a finished trial that did not crash."""
        if self._ends and self._crashes_of_copies(result):
            self._waiting.append(result)

    def look(self, tell: Callable[[], None] = lambda: None) -> bool:
        """Run the crashes of the added trials' forks from the start; return whether one of them ends the hunt.

        ``tell`` is called before the first run.
        """
        waiting = sorted(self._waiting, key=lambda result: result.spec.number)
        self._waiting = [result for result in waiting if self._comes_later(result.spec.number)]
        ends = False
        for result in waiting[: len(waiting) - len(self._waiting)]:
            number, least = result.spec.number, self._progress.last_wanted
            if least is not None and (number > least or not self._deterministic):
                continue
            tell()
            for folder, found in self._crashes_of_copies(result):
                bundle = self._copies.crash(found, folder)
                if bundle is not None:
                    self._progress.copied[number] = bundle
                    ends = True
                    break
        return ends

    def _comes_later(self, number: int) -> bool:
        """Return whether a trial with a lower number has not begun, for example after the hunt was killed."""
        upcoming = self._trials.upcoming
        return self._deterministic and upcoming is not None and upcoming < number

    def _crashes_of_copies(self, result: TrialResult) -> list[tuple[str, ForkCrash]]:
        """Return the crash of a fork with the disturbance kinds of the hunt: the likeliest branch, or a probe."""
        every = ((layout.BRANCHES, likeliest(result)), (layout.PROBES, mildest(result)))
        return [(folder, one) for folder, one in every if one is not None and self._is_of_the_hunt(one)]

    def _is_of_the_hunt(self, found: ForkCrash) -> bool:
        disturber = self._copies.disturber
        kinds = {model.what for model in disturber.models.values()} if disturber is not None else set()
        return all(one.what in kinds or (disturber and one in disturber.fixed) for one in found.spec.disturbances)


# The end of a hunt: what copies of its trials have found is run from the start.


def verify_fork_results(copies: VerificationRuns) -> tuple[ProbeReport | None, BranchReport | None]:
    """Run crashes of forks from the start, and record how many are confirmed."""
    probes, branches = verify_probes(copies), verify_branches(copies)
    found = {PROBES: probes, BRANCHES: branches}
    confirmed = {
        name: (one.run_again - one.not_finished, len(one.crashes)) for name, one in found.items() if one is not None
    }
    if confirmed:
        copies.again.ledger.note(confirmed=confirmed)
    return probes, branches


# Rare mode: the weightiest crashes of forks are run from the start.


def verify_rare(copies: VerificationRuns, *, differences: int = 0) -> RareReport | None:
    """Estimate the crash rate, and run the fork crashes with the greatest weights from the start, in new processes.

    ``differences`` is the number of audited trials that were not bit-identical.

    Returns:
        The report; None if the hunt is not in rare mode.
    """
    again = copies.again
    rule = rare_watch(again.setup.settings, again.ledger, copies.disturber)
    if rule is None:
        return None
    rule.read()
    found = [
        _crash_of_copy(result, max(crashed_copies(result), key=lambda copy: copy.weight)) for result in rule.weightiest
    ]
    crashes, not_finished = copies.crashes(found, layout.BRANCHES, "rare crashes")
    verified = 0 if copies.is_stopped else len(found)
    estimate = rule.estimate()
    why = f"{differences} trials of the audit were not the same again" if differences else ""
    if len(crashes) < verified - not_finished:
        why = f"{verified - not_finished - len(crashes)} of {verified} crashes did not come again from the start"
    if why:
        estimate = replace(
            estimate, estimate=None, estimated=None, estimated_disturbed=None, why_not=why, why_not_disturbed=why,
            more_roots=None,
        )  # fmt: skip
    return RareReport(estimate=estimate, run_again=verified, not_finished=not_finished, crashes=crashes)


def _crash_of_copy(result: TrialResult, copy: ForcedCopy) -> ForkCrash:
    spec = replace(result.spec, disturbances=copy.disturbances, forcing=None, origin="rare")
    return ForkCrash(spec, copy.crash, copy.step)
