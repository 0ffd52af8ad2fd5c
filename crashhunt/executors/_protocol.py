"""The executor protocol: where trials run."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NotRequired, Protocol, TypeAlias, TypedDict, final

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.exceptions import blamed
from crashhunt.base.json_types import ErrorData, ErrorWords
from crashhunt.plans import ChoosesParallelism, executor_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from crashhunt.base.codec import JsonObject
    from crashhunt.episode import WorkerSettings
    from crashhunt.recording import BlackBoxHeader
    from crashhunt.trial import TrialResult, TrialSpec


__all__ = [
    "Answer",
    "ChoosesParallelism",
    "Done",
    "Executor",
    "ExecutorFactory",
    "ForkServerJob",
    "FreshJob",
    "FromForkServer",
    "FromZygote",
    "HasNodes",
    "KillTrial",
    "Lost",
    "NodeFigures",
    "Notes",
    "ToForkServer",
    "has_fork_server",
    "make_executor",
    "run_trials",
    "snapshot_environment",
    "worker_environment",
]


class Executor(Protocol):
    """Runs trials in other processes or on other machines.

    Contract: every submitted trial comes back from `completed` exactly once, unless it is cancelled first. A worker
    that dies or hangs costs exactly its own trial. Trials begin in the order in which they were submitted. A trial
    whose process was killed from outside is run again, alone; after three kills at different steps it is invalid.

    The files of a trial are needed only if its result has ``kept``. Then, before the result is returned, the folder
    ``scratch_of(settings.scratch, number)`` of this machine must have its black box and output. That folder or
    ``settings.scratch`` must have the map, if the simulator has a map. An executor on another machine returns no other
    files.
    """

    @property
    def capacity(self) -> int:
        """The number of trials that run at a time. The hunt submits more trials, so that no worker waits.

        It may change, and is at least 1: if no machine is available for a while, the hunt waits for submitted trials.
        """

    def submit(self, spec: TrialSpec) -> None:
        """Queue a trial. Submit each number once, because a worker may still use the folder of that number."""

    def completed(self, timeout_s: float) -> Iterator[TrialResult]:
        """Yield the trials that have ended since the last call; wait at most this long for the first one.

        Raises:
            CrashhuntError: no trial can be run, for a reason outside of the trials.
        """

    def cancel(self, *, above: int = -1) -> None:
        """Cancel all trials whose number is greater than ``above``, running or not, at once."""

    def where(self) -> Mapping[int, BlackBoxHeader]:
        """Return the progress of running trials, by number, for the status screen; empty if it is unknown."""

    def notes(self) -> list[str]:
        """Return new notices for the user on how trials were run."""

    def close(self) -> None:
        """Stop every process at once. A second call does nothing."""


@dataclass(frozen=True, slots=True)
class NodeFigures:
    """A machine on which trials run, for the status screen.

    Args:
        name: name of it.
        parallel: number of trials that run on the node at a time.
        trials: number of trials that have ended on the node in this run of the hunt.
        rate_per_s: trials a second since it takes part.
    """

    name: str
    parallel: int
    trials: int
    rate_per_s: float


class HasNodes(Protocol):
    """An executor that runs trials on several machines."""

    def nodes(self) -> Sequence[NodeFigures]:
        """Return the machines that run trials now; empty while the hunt waits for all machines."""


class ExecutorFactory(Protocol):
    """The factory of ``--executor NAME``: makes the executor of a hunt.

    With ``--executor NAME:ARG``, it is called with ``argument=ARG`` as well; a factory without this argument need not
    accept it. If no trial can run, it raises a `CrashhuntError` with the fix before it has started anything. See also
    `ChoosesParallelism`.
    """

    def __call__(self, settings: WorkerSettings, *, parallel: int, recycle_after: int) -> Executor:
        """Make an executor.

        Args:
            settings: settings of the hunt.
            parallel: number of trials at a time.
            recycle_after: trials after which a worker is replaced by a fresh one; 0 for never.
        """


# The shapes of what a hunt and its processes tell each other, as JSON.
#
# A replay talks to the crashhunt of a snapshot, so what earlier versions did not say need not be there.


@final
class Done(TypedDict):
    """The result of a trial; ``retires`` means that the supervisor runs no other trial."""

    result: JsonObject
    notices: NotRequired[list[str]]
    retires: NotRequired[bool]


@final
class Lost(TypedDict):
    """A trial that was killed from outside: the exit code, and the failed import if it still imported."""

    lost: int
    importing: NotRequired[str]


Answer: TypeAlias = Done | Lost | ErrorData
"""What a supervisor says at the end of a trial."""


class FreshJob(TypedDict):
    """The job of a fresh process, and the file for its result."""

    settings: JsonObject
    spec: JsonObject
    answer: str


class ForkServerJob(TypedDict):
    """The job of a fork server; ``late`` is true if every trial imports its agents itself.

    ``sys_path`` is empty if crashhunt itself comes from the snapshot, as its environment says.
    """

    settings: JsonObject
    sys_path: list[str]
    late: bool


class ToForkServer(TypedDict, total=False):
    """A request of the pool to its fork server: to start or to kill the supervisor of a slot."""

    slot: int
    kill: int


class FromForkServer(TypedDict, total=False):
    """A message of a fork server: it is ready, cannot fork, or has failed; or a supervisor has ended.

    ``importing`` is what has failed if its template never reports again, in words; empty if that has imported all.
    """

    importing: str
    ready: int
    unfit: bool
    error: ErrorWords
    slot: int
    pid: int
    exit_code: int


class KillTrial(TypedDict):
    """A supervisor asks its zygote to kill the process of the trial that runs."""

    kill: bool


class FromZygote(TypedDict, total=False):
    """A message of a zygote: it is ready, or why not; or how the process of a trial ended.

    ``unfit`` means that files of the simulator have changed, so that no other trial may start from this zygote.
    """

    ready: int
    error: ErrorWords
    pid: int
    ended: int
    unfit: bool
    notices: list[str]


# Notices for the user on how trials were run: each notice once.


class Notes:
    """The notes of an executor, and those that its workers leave in the scratch folder.

    Args:
        scratch: the folder.
    """

    def __init__(self, scratch: Path) -> None:
        self._file = scratch / layout.NOTICES
        self._all: dict[str, None] = {}  # in order
        self._told = 0

    def add(self, note: str) -> None:
        """Add a notice, unless it was added before."""
        self._all[note] = None

    def fresh(self) -> list[str]:
        """Return the notices that were not returned before."""
        with suppress(OSError):
            text = self._file.read_text(encoding="utf-8", errors="replace")
            self._all |= dict.fromkeys(text.splitlines())
        fresh = list(self._all)[self._told :]
        self._told += len(fresh)
        return fresh


# The executor that a hunt asks for.


def make_executor(word: str, settings: WorkerSettings, *, parallel: int, recycle_after: int) -> Executor:
    """Make the executor that ``--executor`` names.

    Raises:
        PluginError: the executor does not exist, or its factory raises an exception.
        CrashhuntError: no trial can run; the message has the reason.
    """
    factory = executor_of(word)
    try:
        made: Executor = factory(settings, parallel=parallel, recycle_after=recycle_after)
    except CrashhuntError:
        raise
    except Exception as error:  # code of the user
        raise blamed(f"the executor {word!r} cannot be created", error) from error
    return made


# Trials of one caller, from the first to the last.

_STOP_CHECK_INTERVAL_S = 0.5


def run_trials(
    executor: Executor,
    specs: Sequence[TrialSpec],
    *,
    stopped: Callable[[], bool] = lambda: False,
    needed: Callable[[int], bool] = lambda _: True,
    check_every_s: float = _STOP_CHECK_INTERVAL_S,
) -> Iterator[tuple[int, TrialResult]]:
    """Yield the place among the specifications and the result of each trial, as the trials end.

    Trials that have not ended when the caller stops asking are cancelled.

    Args:
        executor: runs the trials, and no others meanwhile.
        specs: specs of the trials, in ascending order of their numbers.
        stopped: called before each wait for results, so at least once; True ends the loop, and it may raise.
        needed: whether the trial at a place is still needed, asked after each result. Where a trial is not, the trials
            after it are not either.
        check_every_s: the longest time between two calls of ``stopped``, in s of wall time.

    Raises:
        CrashhuntError: no trial can be run, for a reason outside of the trials.
    """
    places = {spec.number: place for place, spec in enumerate(specs)}
    try:
        for spec in specs:
            executor.submit(spec)
        while places and not stopped():
            for result in list(executor.completed(check_every_s)):
                place = places.pop(result.spec.number, None)
                if place is None:
                    continue  # cancelled, here or by an earlier caller
                yield place, result
                needless = [number for number, other in places.items() if not needed(other)]
                if needless:
                    executor.cancel(above=min(needless) - 1)
                    places = {number: other for number, other in places.items() if number < min(needless)}
    finally:
        if places:
            executor.cancel()


# The environment variables of every process that runs trials: fixed hashes, one thread a library, whose code.

_MAX_COMPILED_SNAPSHOTS = 16  # of which compiled code is kept; some 3 MB each


def worker_environment() -> dict[str, str]:
    """Return the environment variables that make a worker's results depend on its trial alone.

    Hashes of strings are fixed, and libraries use a single thread. With a worker on every core, more threads would
    compete for the cores. Parallel sums are also not bit-identical from run to run.
    """
    names = (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
    )
    return {"PYTHONHASHSEED": "0", **dict.fromkeys(names, "1")}


def snapshot_environment(settings: WorkerSettings) -> dict[str, str]:
    """Return the environment of a process in which crashhunt itself comes from the snapshot too.

    Compiled code does not lie in the snapshot, where it would pass for the code. It lies with the caches of this user,
    by the digest of the snapshot.
    """
    if not settings.code:
        return {**os.environ, **worker_environment()}
    paths = os.pathsep.join(filter(None, (*settings.code, os.environ.get("PYTHONPATH"))))
    ours = {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
    if settings.sealed is None and (compiled := _compiled(settings)) is not None:
        ours |= {"PYTHONPYCACHEPREFIX": str(compiled), "PYTHONDONTWRITEBYTECODE": ""}
    return {**os.environ, **worker_environment(), **ours}


def has_fork_server(settings: WorkerSettings) -> bool:
    """Whether the crashhunt of the settings has a fork server and supervisors: later than 0.1.0, or this one."""
    package = [Path(folder) / layout.PACKAGE.name for folder in settings.code]
    return all((found / "executors" / "_fork_server.py").is_file() for found in package if found.is_dir())


def _compiled(settings: WorkerSettings) -> Path | None:
    """The folder for the compiled code of a snapshot; None if there is no place for it."""
    parts = Path(settings.code[0]).parts
    if layout.SNAPSHOTS not in parts:
        return None
    digest = parts[len(parts) - 1 - parts[::-1].index(layout.SNAPSHOTS) + 1 :][:1]
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "crashhunt" / "compiled"
    try:
        cache.mkdir(parents=True, exist_ok=True, mode=0o700)
        found = cache / (digest[0] if digest else "")
        found.mkdir(exist_ok=True)
        os.utime(found)
        others = sorted(cache.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
    except (OSError, RuntimeError, IndexError):  # a user without a home
        return None
    for old in others[_MAX_COMPILED_SNAPSHOTS:]:
        with suppress(OSError):
            shutil.rmtree(old)
    return found
