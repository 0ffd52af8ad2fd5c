"""The last step from which braking avoids a crash, found by further trials in the slot of the trial that crashed."""

from __future__ import annotations

import itertools
import os
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

from crashhunt.base import layout
from crashhunt.base.errors import BundleError
from crashhunt.base.signals import describe_death
from crashhunt.episode import scratch_of
from crashhunt.executors._postmortem import read_map
from crashhunt.executors._trial_attempts import MAX_ATTEMPTS, LostTrialError
from crashhunt.recording import Recording, read_black_box
from crashhunt.simulators import FullBraking
from crashhunt.trial import Escape, TrialResult, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Iterable

    from crashhunt.crashes import Borders
    from crashhunt.episode import WorkerSettings
    from crashhunt.executors._postmortem import EndedTrial

_FIRST_EXTRA_NUMBER = 1 << 40  # beyond the numbers of a hunt's trials: each trial has a folder by its number


class RunsTrials(Protocol):
    """The supervisor of a slot."""

    @property
    def retires(self) -> bool:
        """Whether the zygote may run no further trial."""

    def run(self, spec: TrialSpec) -> EndedTrial:
        """Run a trial, and return its result."""


def with_escape(supervisor: RunsTrials, settings: WorkerSettings, ended: EndedTrial) -> TrialResult:
    """Return the result of a trial with a collision, with the last step at which braking avoids the collision."""
    result = ended.result
    from crashhunt.crashes import find_escape

    braking = None
    if ended.braking is not None:
        how, deceleration = ended.braking["how"], ended.braking["deceleration"]
        braking = FullBraking(None, str(how), float(deceleration) if isinstance(deceleration, int | float) else None)
    numbers = itertools.count(_FIRST_EXTRA_NUMBER + (os.getpid() << 16))
    kills = 0

    def recording(number: int) -> Recording:
        return Recording(read_black_box(scratch_of(settings.scratch, number) / layout.BLACK_BOX))

    def run(spec: TrialSpec) -> tuple[TrialResult, Recording]:
        nonlocal kills
        kills = 0
        while True:
            number = next(numbers)
            try:
                done = supervisor.run(replace(spec, number=number)).result
                return done, recording(number)
            except LostTrialError:
                kills += 1
                if kills == MAX_ATTEMPTS or supervisor.retires:  # without a zygote, no attempt can succeed
                    raise
            finally:
                shutil.rmtree(scratch_of(settings.scratch, number), ignore_errors=True)

    def borders() -> Iterable[Borders]:
        from crashhunt.recording import lane_borders  # MCAP takes long to import, and few crashes need it

        return lane_borders(read_map(settings.scratch, scratch_of(settings.scratch, result.spec.number)))

    try:
        return replace(result, escape=find_escape(result, recording(result.spec.number), braking, run, borders))
    except BundleError as error:
        return replace(result, escape=Escape(why_not=error.message))
    except LostTrialError as error:
        why = f"the process that searched {describe_death(error.exit_code)}{f', {kills} times' if kills > 1 else ''}"
        return replace(result, why_no_escape=why)
