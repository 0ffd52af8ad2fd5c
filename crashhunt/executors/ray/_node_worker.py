"""The work of a node for a hunt: it runs a pool of processes, and returns the results of trials."""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
import zlib
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError
from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.executors._pool import PoolExecutor
from crashhunt.executors.ray._code_archive import NodeFolder, settings_in
from crashhunt.executors.ray._messages import Header, News, NodeJob, NodeTrial, Submitted
from crashhunt.recording import read_header
from crashhunt.trial import TrialSpec

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from crashhunt.base.json_types import ErrorData
    from crashhunt.recording import BlackBoxHeader
    from crashhunt.trial import TrialResult


_WHERE_EVERY_S = 0.5  # as often as people can read
_GATHER_S = 0.05  # in which what ends goes back together, while there is enough to do
_HEADER_BYTES = 64  # bytes of a black box that say what is in the rest, most of which is room for more
_TEXT_FILES = (layout.RUN_LOG, layout.ERROR_LOG, layout.STACK)


class Work:
    """The trials of one hunt on this node."""

    def __init__(self, job: NodeJob) -> None:
        self._job = job
        self._place: NodeFolder | None = None
        self._pool: PoolExecutor | None = None
        self._lock = threading.Lock()
        self._tickets: dict[int, int] = {}
        self._given_up: list[tuple[int, int]] = []  # greatest number that is not, and first ticket that is not
        self._renamed: list[tuple[str, str]] = []
        self._looked = 0.0
        self._map_sent = False
        self._broken: CrashhuntError | None = None
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"  # of the code of a hunt, which is there for this hunt only

    def begin(self, packed: bytes) -> str:
        """Prepare the pool with the archive of the code; return the value that `Site.begin` returns."""
        self._place = self._place or NodeFolder()
        if not self._place.unpack(packed, self._job["digest"]):
            return "the parcel was damaged on its way"
        settings = WorkerSettings.from_json(self._job["settings"])
        here = settings_in(settings, self._job["folders"], self._place.code, self._place.scratch)
        # What people and the ledger are told names the files of the machine where the hunt was begun.
        pairs = {str(self._place.code / place): folder for folder, place in self._job["folders"].items()}
        pairs[str(self._place.scratch)] = str(settings.scratch)
        self._renamed = sorted(pairs.items(), key=lambda pair: -len(pair[0]))
        if self._job["home"]:  # an agent may open its files by names that count from there
            os.chdir(self._place.code / self._job["home"])
        self._pool = PoolExecutor(here, parallel=self._job["slots"])
        return "ready"

    def submit(self, trials: Sequence[Submitted]) -> None:
        """Queue trials, except those that were cancelled before they arrived."""
        assert self._pool is not None
        try:
            for ticket, spec in trials:
                with self._lock:
                    if not any(spec["number"] > above and ticket < before for above, before in self._given_up):
                        self._tickets[spec["number"]] = ticket
                        self._pool.submit(TrialSpec.from_json(spec))
        except Exception as error:  # nobody looks at what comes of this call; the next `take` tells
            self._broken = CrashhuntError(f"a trial cannot be begun: {type(error).__name__}: {error}")

    def cancel(self, above: int, before: int) -> None:
        """Cancel trials whose number is greater than ``above``, and whose ticket is less than ``before``.

        The tickets distinguish trials that were submitted later from trials that arrive late.
        """
        assert self._pool is not None
        with self._lock:
            self._given_up.append((above, before))
            self._tickets = {number: ticket for number, ticket in self._tickets.items() if number <= above}
            self._pool.cancel(above=above)

    def take(self, wait_s: float, trials: Sequence[Submitted]) -> News:
        """Queue trials, and return the events; wait at most ``wait_s`` for a trial to end."""
        assert self._pool is not None
        self.submit(trials)
        ended: list[NodeTrial] = []
        error: ErrorData | None = None
        try:
            if self._broken is not None:
                raise self._broken
            for result in self._completed(wait_s):
                with self._lock:
                    ticket = self._tickets.pop(result.spec.number, None)
                if ticket is not None:
                    ended.append(self._queue_trials(ticket, result))
        except CrashhuntError as problem:
            error = {"error": self._with_hunt_paths(problem.to_json()["error"])}
        where: dict[int, Header] | None = None
        if time.monotonic() - self._looked > _WHERE_EVERY_S:
            self._looked = time.monotonic()
            where = {number: _values(header) for number, header in self._pool.where().items()}
        notes = [self._with_hunt_paths(note) for note in self._pool.notes()]
        return News(
            ended=ended,
            where=where,
            notes=notes,
            error=error,
            map=self._map() if any(done.files for done in ended) else b"",
        )

    def _completed(self, wait_s: float) -> Iterator[TrialResult]:
        """Yield ended trials, and trials that end soon afterwards, because each call from another machine costs time.

        Kept trials are returned at once, and so are all results if workers may soon be idle.
        """
        assert self._pool is not None
        deadline, urgent = 0.0, False
        while True:
            for result in self._pool.completed(wait_s):
                deadline, urgent = deadline or time.monotonic() + _GATHER_S, urgent or result.kept
                yield result
            wait_s = deadline - time.monotonic()
            if urgent or wait_s <= 0 or 2 * len(self._tickets) < 3 * self._job["slots"]:
                return

    def close(self) -> None:
        """End all processes, and delete all files."""
        if self._pool is not None:
            self._pool.close()
        if self._place is not None:
            self._place.remove()

    def _queue_trials(self, ticket: int, result: TrialResult) -> NodeTrial:
        data = result.to_json()
        if data.get("failure"):
            data["failure"] = self._with_hunt_paths(data["failure"])
        line = json.dumps({"ticket": ticket, "result": data}).encode() + b"\n"
        files = {}
        if result.kept:
            assert self._place is not None
            folder = scratch_of(self._place.scratch, result.spec.number)
            for path in folder.iterdir():
                if path.is_file() and not path.is_symlink():
                    files[path.name] = zlib.compress(self._content(path), 1)
            shutil.rmtree(folder, ignore_errors=True)  # whatever else an agent has put there
        return NodeTrial(ticket=ticket, number=result.spec.number, line=line, files=files)

    def _content(self, path: Path) -> bytes:
        with path.open("rb") as file:
            box = read_header(path) if path.name == layout.BLACK_BOX else None
            content = file.read(max(_HEADER_BYTES, box.committed) if box is not None else -1)
        if path.name in _TEXT_FILES:
            for here, there in self._renamed:
                content = content.replace(os.fsencode(here), os.fsencode(there))
        return content

    def _with_hunt_paths(self, said: Any) -> Any:
        """Return a result with the file names of the hunt's machine."""
        if isinstance(said, dict):
            return {key: self._with_hunt_paths(value) for key, value in said.items()}
        if isinstance(said, list):
            return [self._with_hunt_paths(value) for value in said]
        if isinstance(said, str):
            for here, there in self._renamed:
                said = said.replace(here, there)
        return said

    def _map(self) -> bytes:
        """Return the map that all trials of this node share; empty after the first call."""
        if self._map_sent or self._place is None:
            return b""
        with suppress(OSError):
            content = (self._place.scratch / layout.MAP).read_bytes()
            self._map_sent = True
            return zlib.compress(content, 1)
        return b""


def _values(header: BlackBoxHeader) -> Header:
    return header.pid, header.trial, header.started, header.committed, header.step, int(header.phase), header.agent


def unpacked(files: dict[str, bytes], folder: Path) -> None:
    """Write the files of a kept trial into a new folder.

    Raises:
        OSError: the disk is full.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / Path(name).name).write_bytes(zlib.decompress(content))
