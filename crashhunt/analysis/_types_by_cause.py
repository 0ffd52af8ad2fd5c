"""Division of crash types by cause: some crashes of each type are judged, the others get the nearest cause."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from crashhunt.analysis._avoidability import judge
from crashhunt.analysis._omissions import find_omission
from crashhunt.base.errors import CrashhuntError
from crashhunt.crashes import (
    Cause,
    CauseGroup,
    Division,
    Judgement,
    cause_of,
    changing,
    features_of,
    judgement_of,
    with_judgement,
)
from crashhunt.replays import ReplayOptions, prepare
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.crashes import Bundle, Group

REPRESENTATIVES = 8
"""How many crashes of each type are judged; six bugs in one type have been seen."""

_REFERENCE_RUNS, _WHY_RUNS = 16, 24


def find_cause(
    bundle: Bundle,
    options: ReplayOptions | None = None,
    *,
    parallel: int = 1,
    stopped: Callable[[], bool] = lambda: False,
) -> tuple[Cause, Bundle]:
    """Return the cause of a crash, and its bundle with the results of runs; runs are made only for missing results.

    The runs with a reference driver are made first. Only if they find no omission, one factor at a time is removed, as
    `judge` does.

    Raises:
        CrashhuntError: no trial can be run.
    """
    result = bundle.result
    if result.outcome.is_software_fault or result.outcome is Outcome.HANG or bundle.is_near_miss:
        return cause_of(bundle, None), bundle
    found = judgement_of(bundle)
    if found is None or found.is_interrupted:  # an interrupted search says nothing about the cause
        found = Judgement()
    if found.reference is None and result.outcome in (Outcome.COLLISION, Outcome.OFF_ROAD):
        rerun = prepare(bundle, options or ReplayOptions())
        reference = find_omission(rerun, most=_REFERENCE_RUNS, parallel=parallel, stopped=stopped, tell=lambda: None)
        found = replace(found, reference=reference)
    if found.why is None and (found.reference is None or found.reference.omission is None):
        new = judge(bundle, options, runs=1, why=_WHY_RUNS, drivers=False, parallel=parallel, stopped=stopped)
        found = replace(found, why=new.why)
    return cause_of(bundle, found), with_judgement(bundle, found)


def divide_by_cause(
    group: Group,
    options: ReplayOptions | None = None,
    *,
    most: int = REPRESENTATIVES,
    parallel: int = 1,
    write: bool = True,
    stopped: Callable[[], bool] = lambda: False,
) -> tuple[CauseGroup, ...]:
    """Return the crashes of one type divided by cause, the most frequent cause first.

    At most ``most`` crashes are judged. With ``write``, the results are written into the bundles, so that the next call
    needs no run. After a stop, all further crashes get the cause of the nearest judged crash.
    """
    bundles, division = group.bundles, Division(most)
    for number, bundle in enumerate(bundles):
        division.add(number, bundle.result.steps, features_of(bundle))
    while not stopped() and (place := division.choose()) is not None:
        try:
            cause, judged = find_cause(bundles[place], options, parallel=parallel, stopped=stopped)
        except CrashhuntError:  # the other crashes are divided nevertheless
            division.settle(place, None)
            continue
        if stopped():
            break  # what was interrupted says nothing
        division.settle(place, cause)
        if write and judged is not bundles[place]:
            judgement = judgement_of(judged)
            with changing(judged) as stored:
                (judged if judgement is None else with_judgement(stored, judgement)).write()
    members: dict[Cause, list[int]] = {}
    for place, cause in division.causes().items():
        members.setdefault(cause, []).append(place)
    found = [
        CauseGroup(
            cause=cause,
            members=tuple(bundles[place] for place in places),
            judged=tuple(bundles[place] for place in places if place in division.judged),
        )
        for cause, places in members.items()
    ]
    return tuple(sorted(found, key=lambda one: (-len(one.members), one.cause)))
