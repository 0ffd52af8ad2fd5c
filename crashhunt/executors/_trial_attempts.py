"""The attempts to run a trial: if its process was killed from outside, it is run again, alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.signals import is_sent_from_outside, signal_name
from crashhunt.episode import scratch_of
from crashhunt.recording import (
    BlackBoxHeader,
    Phase,
    read_header,
)

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.trial import TrialResult, TrialSpec


MAX_ATTEMPTS = 3  # of a trial whose process is killed from outside


class LostTrialError(Exception):
    """The process of a trial was killed from outside, or by an agent that attacked its zygote.

    Args:
        exit_code: exit code of the process; negative for a signal.
    """

    def __init__(self, exit_code: int) -> None:
        super().__init__(exit_code)
        self.exit_code = exit_code


@dataclass(slots=True)
class TrialAttempt:
    """A trial to run, and the record of how its processes have ended.

    Certain signals may come from outside: from an administrator, from a batch system, or from the kernel if memory runs
    out. After such a signal, the trial is run again, alone. If it ends in the same way at the same step, the trial
    itself is the cause. If it ends at another step each time, the trial is not the cause. An end before the first step
    is no evidence, because the process that forks trials may have been killed.
    """

    spec: TrialSpec  # the trial to run
    # the signal and the step at which each process of the trial ended
    ends: list[tuple[int, int]] = field(default_factory=list)
    result: TrialResult | None = None  # result of the trial, while further trials search for its last avoidable step

    @property
    def alone(self) -> bool:
        """Whether no other trial may run at the same time."""
        return bool(self.ends)

    @property
    def is_killed_from_outside(self) -> bool:
        """Whether every allowed attempt was killed at another step, so that the outcome of the trial is unknown."""
        return len(self.ends) >= MAX_ATTEMPTS and len(set(self.ends)) == len(self.ends)

    def again(self, scratch: Path, exit_code: int) -> str:
        """Return the reason why the trial must run again, as text; empty if its outcome is known."""
        if not is_sent_from_outside(exit_code):
            return ""
        header = where_it_is(scratch, self.spec.number)
        end = exit_code, header.step if header is not None else -1
        has_begun = header is not None and header.phase != Phase.SETUP
        seen = end in self.ends and has_begun
        self.ends.append(end)
        if seen or len(self.ends) >= MAX_ATTEMPTS:
            return ""
        return f"trial {self.spec.number} was ended by {signal_name(exit_code)} from outside, and is run again"


def where_it_is(scratch: Path, number: int) -> BlackBoxHeader | None:
    """Return the progress of a running trial; None if it has not begun."""
    header = read_header(scratch_of(scratch, number) / layout.BLACK_BOX)
    return header if header is not None and header.trial == number else None
