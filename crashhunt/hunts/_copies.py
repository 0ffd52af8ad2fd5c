"""What has come of the copies of a hunt's trials so far, as its ledger sums it up."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypedDict

if TYPE_CHECKING:
    from crashhunt.hunts._data import Facts
    from crashhunt.hunts._ledger import Ledger
    from crashhunt.plans import HuntSettings

__all__ = ["BRANCHES", "PROBES", "BranchSums", "ProbeSums", "copies_to_come", "sums_of_branches", "sums_of_probes"]

PROBES, BRANCHES = "probes", "branches"


class ProbeSums(TypedDict):
    """What ``status --json`` says of the probes of a hunt.

    Args:
        trials: of how many trials copies were asked all that was to be asked.
        not_fully_asked: of how many further trials a question has no answer.
        least: the least stress margin of the former; None where there is none.
        trial: the number of the trial that has it.
        probes: how many copies were asked.
        steps: how many steps they took.
        left_out: how many questions were left out, because copies had taken enough steps.
        crashed_trials: how many trials a probe made crash that did not crash by themselves.
        run_again: how many of the mildest were run from the start; None until the hunt has come to that.
        confirmed: how many of these crashed there as well.
    """

    trials: int
    not_fully_asked: int
    least: float | None
    trial: int | None
    probes: int
    steps: int
    left_out: int
    crashed_trials: int
    run_again: int | None
    confirmed: int | None


class BranchSums(TypedDict):
    """What ``status --json`` says of the branches of a hunt, as `ProbeSums`.

    Args:
        trials: of how many trials there might have been some.
        moments: from how many copies went on.
        branches: how many there were.
        steps: how many steps they took.
        left_out: how many were left out, because branches had taken enough steps.
        crashed: how many crashed.
        crashed_trials: of how many trials.
        not_fully_asked: of how many of the trials a branch has no answer.
        run_again: how many of the likeliest were run from the start; None until the hunt has come to that.
        confirmed: how many of these crashed there as well.
    """

    trials: int
    moments: int
    branches: int
    steps: int
    left_out: int
    crashed: int
    crashed_trials: int
    not_fully_asked: int
    run_again: int | None
    confirmed: int | None


def copies_to_come(settings: HuntSettings) -> list[str] | None:
    """Return which copies a hunt has of its trials; None where it has none."""
    return [name for name, wanted in ((PROBES, settings.probe), (BRANCHES, settings.branch)) if wanted] or None


def sums_of_probes(ledger: Ledger, facts: Facts) -> ProbeSums | None:
    """Return what came of the probes of a hunt so far; None where it has none."""
    if PROBES not in (facts.get("copies") or ()):
        return None
    (row,) = ledger.summed(
        # Of a query with one min(), SQLite takes what stands bare from the row that has it.
        "count(margin), min(margin), number, total(probes), total(steps), total(left_out), total(crashed), "
        "count(probes)",
        "SELECT number, {stress.margin} AS margin, {stress.probes} AS probes, {stress.steps} AS steps, "
        "{stress.left_out} AS left_out, {stress.disturbance} IS NOT NULL AS crashed",
    )
    trials, least, trial, probes, steps, left_out, crashed, asked = row
    again, confirmed = _confirmed(facts, PROBES)
    return {
        "trials": trials, "not_fully_asked": asked - trials, "least": least, "trial": trial if trials else None,
        "probes": int(probes), "steps": int(steps), "left_out": int(left_out), "crashed_trials": int(crashed),
        "run_again": again, "confirmed": confirmed,
    }  # fmt: skip


def sums_of_branches(ledger: Ledger, facts: Facts) -> BranchSums | None:
    """Return what came of the branches of a hunt so far; None where it has none."""
    if BRANCHES not in (facts.get("copies") or ()):
        return None
    (row,) = ledger.summed(
        "count(asked), total(moments), total(asked), total(steps), total(left_out), total(crashed), "
        "total(crashed > 0), total(unanswered > 0)",
        "SELECT {branches.moments} AS moments, {branches.asked} AS asked, {branches.steps} AS steps, "
        "{branches.left_out} AS left_out, {branches.unanswered} AS unanswered, "
        "json_array_length(data, '$.branches.crashes') AS crashed",
    )
    trials, moments, branches, steps, left_out, crashed, crashed_trials, not_fully_asked = map(int, row)
    again, confirmed = _confirmed(facts, BRANCHES)
    return {
        "trials": trials, "moments": moments, "branches": branches, "steps": steps, "left_out": left_out,
        "crashed": crashed, "crashed_trials": crashed_trials, "not_fully_asked": not_fully_asked,
        "run_again": again, "confirmed": confirmed,
    }  # fmt: skip


def _confirmed(facts: Facts, name: str) -> tuple[int | None, int | None]:
    """How many were run from the start, and how many of them crashed there as well."""
    found = None if facts.get("state") == "running" else (facts.get("confirmed") or {}).get(name)  # of an earlier run
    return (found[0], found[1]) if found else (None, None)
