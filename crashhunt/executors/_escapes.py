"""Until when braking would have avoided a crash, found out by further trials in the same slot."""

from __future__ import annotations

import itertools
import os
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BundleError
from crashhunt.base.signals import describe_death
from crashhunt.episode import scratch_of
from crashhunt.executors._supervisor import LostTrialError
from crashhunt.recording import Recording, read_black_box
from crashhunt.simulators import FullBraking

if TYPE_CHECKING:
    from crashhunt.episode import WorkerSettings
    from crashhunt.executors._supervisor import Ended, Supervisor
    from crashhunt.trial import TrialResult, TrialSpec

__all__ = ["with_escape"]

_ATTEMPTS = 3  # of a trial whose process is killed from outside
_FIRST_NUMBER = 1 << 40  # beyond the numbers of a hunt's trials: each trial has a folder by its number


def with_escape(supervisor: Supervisor, settings: WorkerSettings, ended: Ended) -> TrialResult:
    """Return the result of a trial with its last escape, where the settings ask for that and it can be told.

    Args:
        supervisor: which has run the trial.
        settings: of the hunt.
        ended: the trial.
    """
    result = ended.result
    if not settings.find_escapes or result.collision is None or ended.braking is None or supervisor.retires:
        return result
    from crashhunt.crashes import find_escape

    how, deceleration = ended.braking["how"], ended.braking["deceleration"]
    braking = FullBraking(None, str(how), float(deceleration) if isinstance(deceleration, int | float) else None)
    numbers = itertools.count(_FIRST_NUMBER + (os.getpid() << 16))

    def recording(number: int) -> Recording:
        return Recording(read_black_box(scratch_of(settings.scratch, number) / layout.BLACK_BOX))

    def run(spec: TrialSpec) -> tuple[TrialResult, Recording]:
        for left in reversed(range(_ATTEMPTS)):
            number = next(numbers)
            try:
                done = supervisor.run(replace(spec, number=number)).result
                return done, recording(number)
            except LostTrialError:
                if not left:
                    raise
            finally:
                shutil.rmtree(scratch_of(settings.scratch, number), ignore_errors=True)
        raise AssertionError

    try:
        return replace(result, escape=find_escape(result, recording(result.spec.number), braking, run))
    except BundleError:
        return result
    except LostTrialError as error:
        why = f"the process that searched {describe_death(error.exit_code)}, {_ATTEMPTS} times"
        return replace(result, why_no_escape=why)
