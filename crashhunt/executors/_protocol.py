"""The executor protocol: where trials run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.trial import TrialResult, TrialSpec

__all__ = ["Executor"]


class Executor(Protocol):
    """Runs trials somewhere else.

    Contract: every submitted trial comes back from `completed` exactly once, unless it is cancelled first. A worker
    that dies or hangs costs exactly its own trial. Trials begin in the order in which they were submitted. A trial
    whose process was killed from outside is run again, alone. `notes` says such things, to be told to people; an
    executor may go without.
    """

    def submit(self, spec: TrialSpec) -> None:
        """Queue a trial."""

    def completed(self, timeout_s: float) -> Iterator[TrialResult]:
        """Yield the trials that have ended since the last call, waiting so long for a first one."""

    def cancel(self, *, above: int = -1) -> None:
        """Give up all trials whose number is greater than ``above``, running or not, at once."""

    def close(self) -> None:
        """Stop every process, whatever it is doing. May be called twice."""
