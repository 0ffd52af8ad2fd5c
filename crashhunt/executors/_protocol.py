"""The executor protocol: where trials run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from crashhunt.plans import SizesItself

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from crashhunt.episode import WorkerSettings
    from crashhunt.recording import BlackBoxHeader
    from crashhunt.trial import TrialResult, TrialSpec

__all__ = ["Executor", "ExecutorFactory", "HasNodes", "NodeFigures", "SizesItself"]


class Executor(Protocol):
    """Runs trials somewhere else.

    Contract: every submitted trial comes back from `completed` exactly once, unless it is cancelled first. A worker
    that dies or hangs costs exactly its own trial. Trials begin in the order in which they were submitted. A trial
    whose process was killed from outside is run again, alone; after three kills at different steps it is invalid.

    What a trial has written is wanted only where its result says ``kept``: then, before the result comes back, the
    folder ``scratch_of(settings.scratch, number)`` of this machine has its black box and output, and it or
    ``settings.scratch`` the map, where the simulator has one. Whoever runs trials on another machine brings nothing
    else back.
    """

    @property
    def capacity(self) -> int:
        """How many trials run at a time, now. The hunt hands over more than that, so that no worker waits for it.

        It may change, and is 1 at least: where nobody runs any for a while, the hunt waits for what it has handed over.
        """

    def submit(self, spec: TrialSpec) -> None:
        """Queue a trial. No number may come twice, as a worker may still have the folder of the first."""

    def completed(self, timeout_s: float) -> Iterator[TrialResult]:
        """Yield the trials that have ended since the last call, waiting so long for a first one.

        Raises:
            CrashhuntError: no trial can be run, for a reason that has nothing to do with it.
        """

    def cancel(self, *, above: int = -1) -> None:
        """Give up all trials whose number is greater than ``above``, running or not, at once."""

    def where(self) -> Mapping[int, BlackBoxHeader]:
        """Return how far running trials are, by number, for people who watch; empty where nobody knows."""

    def notes(self) -> list[str]:
        """Return what people should be told of how trials were run, and has not been returned before."""

    def close(self) -> None:
        """Stop every process, whatever it is doing. May be called twice."""


@dataclass(frozen=True, slots=True)
class NodeFigures:
    """A machine on which trials run, for people who watch.

    Args:
        name: of it.
        parallel: how many trials run there at a time.
        trials: how many have ended there in this run of the hunt.
        rate_per_s: trials a second since it takes part.
    """

    name: str
    parallel: int
    trials: int
    rate_per_s: float


class HasNodes(Protocol):
    """The faculty of an executor that runs trials on several machines."""

    def nodes(self) -> Sequence[NodeFigures]:
        """Return those that take part now; none while all are waited for."""


class ExecutorFactory(Protocol):
    """What ``--executor NAME`` stands for: makes an executor of a hunt.

    With ``--executor NAME:ARG``, it is called with ``argument=ARG`` as well; one that takes none may leave that out.
    It raises a `CrashhuntError` with the fix where no trial could run, before it has started anything. See also
    `SizesItself`.
    """

    def __call__(self, settings: WorkerSettings, *, parallel: int, recycle_after: int) -> Executor:
        """Make one.

        Args:
            settings: of the hunt.
            parallel: how many trials at a time.
            recycle_after: trials after which a worker is replaced by a fresh one; 0 for never.
        """
