"""The executor protocol: the interface of objects that run trials."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, NotRequired, Protocol, TypeAlias, TypedDict, final

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.exceptions import blamed
from crashhunt.base.json_types import ErrorData, ErrorWords
from crashhunt.base.older_versions import removed_fix_in
from crashhunt.base.text import NOTICE_TOPIC
from crashhunt.plans import ChoosesParallelism as ChoosesParallelism, executor_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from crashhunt.base.codec import JsonObject
    from crashhunt.episode import WorkerSettings
    from crashhunt.recording import BlackBoxHeader
    from crashhunt.trial import TrialResult, TrialSpec


class Executor(Protocol):
    """Runs trials in other processes or on other machines.

    Contract: `completed` yields every submitted trial exactly once, unless the trial is cancelled first. A worker that
    dies or hangs costs exactly its own trial. Trials begin in the order in which they were submitted. A trial whose
    process was killed from outside is run again, alone. After three kills at different steps, the trial is invalid.

    The files of a trial are needed only if its result has ``kept``. In this case, the folder
    ``scratch_of(settings.scratch, number)`` of this machine must contain its black box and output before the result is
    returned. The folder of the trial or ``settings.scratch`` must contain the map, if the simulator has a map. An
    executor on another machine returns no other files.
    """

    @property
    def capacity(self) -> int:
        """The number of trials that run at a time. The hunt submits more trials, so that no worker waits.

        The capacity may change, and is at least 1. If no machine is available for a while, the hunt waits for submitted
        trials.
        """

    def submit(self, spec: TrialSpec) -> None:
        """Queue a trial. Submit each number once, because a worker may still use the folder of that number."""

    def completed(self, timeout_s: float) -> Iterator[TrialResult]:
        """Yield the trials that have ended since the last call; wait at most ``timeout_s`` for the first one.

        Raises:
            CrashhuntError: no trial can be run, for a reason outside of the trials.
        """

    def cancel(self, *, above: int = -1) -> None:
        """Cancel at once all trials whose number is greater than ``above``, even if they are running."""

    def where(self) -> Mapping[int, BlackBoxHeader]:
        """Return the progress of running trials, by number, for the status screen; empty if it is unknown."""

    def notes(self) -> list[str]:
        """Return new notices for the user on how trials were run."""

    def close(self) -> None:
        """Stop all processes at once. A second call does nothing."""


@dataclass(frozen=True, slots=True)
class NodeFigures:
    """A machine on which trials run, with its figures for the status screen."""

    name: str  # name of the machine
    parallel: int  # number of trials that run on the machine at a time
    trials: int  # number of trials that have ended on the machine in this run of the hunt
    rate_per_s: float  # trials per second since the machine joined the hunt


class HasNodes(Protocol):
    """An executor that runs trials on several machines."""

    def nodes(self) -> Sequence[NodeFigures]:
        """Return the machines that currently run trials; empty while the hunt waits for all machines."""


# The shapes of what a hunt and its processes tell each other, as JSON.
#
# A replay talks to the crashhunt of a snapshot, so what earlier versions did not say need not be there.


@final
class Done(TypedDict):
    """The message with the result of a trial; ``retires`` means that the supervisor can run no further trial.

    ``searches`` means that another message with the result and its last avoidable step follows.
    """

    result: JsonObject
    notices: NotRequired[list[str]]
    retires: NotRequired[bool]
    searches: NotRequired[bool]


@final
class Lost(TypedDict):
    """The message that a trial was killed from outside, with the exit code."""

    lost: int


Answer: TypeAlias = Done | Lost | ErrorData
"""What a supervisor says at the end of a trial."""


class ForkServerJob(TypedDict):
    """The job of a fork server; ``late`` is true if every trial imports its agents itself.

    ``sys_path`` is empty if crashhunt itself comes from the snapshot, because the environment variables then contain
    it.
    """

    settings: JsonObject
    sys_path: list[str]
    late: bool


class ToForkServer(TypedDict, total=False):
    """A request of the pool to its fork server: start or kill the supervisor of a slot."""

    slot: int
    kill: int


class FromForkServer(TypedDict, total=False):
    """A message of a fork server: it is ready, cannot fork, or has failed, or a supervisor has ended.

    ``importing`` describes the import in progress, which has failed if the template never reports again; empty after
    all imports.
    """

    importing: str
    ready: int
    unfit: bool
    error: ErrorWords
    slot: int
    pid: int
    exit_code: int


class KillTrial(TypedDict):
    """A request of a supervisor to its zygote: kill the process of the running trial."""

    kill: bool


class FromZygote(TypedDict, total=False):
    """A message of a zygote: it is ready, it failed to get ready, or the process of a trial has ended.

    ``unfit`` means that files of the simulator have changed, so that no other trial may start from this zygote.
    """

    ready: int
    error: ErrorWords
    pid: int
    ended: int
    unfit: bool
    notices: list[str]


class Job(TypedDict):
    """The job that the process of a trial receives.

    ``folder`` is the folder of the trial, and ``reserved`` the size of its black box in bytes. ``wants_map``
    requests the map in any case. ``tries_copy`` requests a test whether the trial can be forked.
    """

    spec: JsonObject
    folder: str
    reserved: int
    wants_map: bool
    tries_copy: bool


CHECKSUM_BYTES = 16  # in front of a report


class Report(TypedDict):
    """The report that the process of a trial writes at its end.

    ``result`` does not contain the specification, which the supervisor knows. ``notices`` are texts for the user.
    """

    result: Mapping[str, object]
    notices: list[str]
    map: NotRequired[str]
    entered: NotRequired[list[str]]
    responses: NotRequired[list[JsonObject]]
    braking: NotRequired[Mapping[str, object] | None]
    lights: NotRequired[Mapping[str, object]]


class FaultReport(TypedDict):
    """The report that the process of a trial writes if crashhunt itself failed in this process."""

    fault: ErrorData


def encode_report(report: Report | FaultReport, *, dumps: Callable[[object], str] = json.dumps) -> bytes:
    """Return a report as bytes, after its checksum."""
    text = dumps(report).encode()
    return checksum_of(text) + text


def checksum_of(text: bytes) -> bytes:
    """Return the checksum in front of a report."""
    return hashlib.blake2b(text, digest_size=CHECKSUM_BYTES).digest()


# Notices for the user on how trials were run: each notice once.


class Notes:
    """The notices of an executor for the user, including notices that its workers leave in the scratch folder."""

    def __init__(self, scratch: Path) -> None:
        self._file = scratch / layout.NOTICES
        self._all: dict[str, str] = {}  # by topic, in order
        self._told = 0

    def add(self, note: str) -> None:
        """Add a notice, unless it was added before, or another one of its topic."""
        topic, _, text = note.rpartition(NOTICE_TOPIC)
        self._all.setdefault(topic or text, text)

    def fresh(self) -> list[str]:
        """Return the notices that were not returned before."""
        with suppress(OSError):
            text = self._file.read_text(encoding="utf-8", errors="replace")
            for note in text.splitlines():
                self.add(note)
        fresh = list(self._all.values())[self._told :]
        self._told += len(fresh)
        return fresh


# The executor that a hunt asks for.


def make_executor(word: str, settings: WorkerSettings, *, parallel: int) -> Executor:
    """Create the executor that ``--executor`` names.

    Raises:
        PluginError: the executor does not exist, or its factory raises an exception.
        CrashhuntError: no trial can run; the message contains the reason.
    """
    factory = executor_of(word)
    try:
        made: Executor = factory(settings, parallel=parallel)
    except CrashhuntError:
        raise
    except Exception as error:  # code of the user
        fix = removed_fix_in(str(error)) if isinstance(error, TypeError) else ""
        raise blamed(f"the executor {word!r} cannot be created", error, fix=fix or "correct the code") from error
    return made
