"""A process of its own for every trial: slower than a pool, and nothing that ran before can matter."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from crashhunt.errors import BundleError, CrashhuntError
from crashhunt.executors._parts import require_origin, seal
from crashhunt.executors._protocol import WorkerSettings, scratch_of
from crashhunt.executors._remains import died, hung, where_it_is
from crashhunt.executors._worker import BLACK_BOX, Worker, worker_environment
from crashhunt.recording import Recording, read_black_box
from crashhunt.trial import TrialResult, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from crashhunt.trial import Escape

__all__ = ["FreshProcessExecutor", "fresh_environment"]

_LOOK_EVERY_S = 0.01
_LAST_WORDS_S = 0.2
_START_UP_S = 60.0
_ESCAPE_S = 60.0


@dataclass(slots=True)
class _Running:
    spec: TrialSpec
    process: subprocess.Popen[bytes]
    answer: Path
    began: float
    killed: bool = False


class FreshProcessExecutor:
    """Runs every trial in a fresh process, and with it the code that the settings name.

    Args:
        settings: of the hunt.
        parallel: how many processes at a time.
        recycle_after: not used; a process is never used twice.
    """

    def __init__(self, settings: WorkerSettings, *, parallel: int = 1, recycle_after: int = 1) -> None:
        self._settings = settings
        self._parallel = parallel
        self._waiting: deque[TrialSpec] = deque()
        self._running: dict[int, _Running] = {}

    def submit(self, spec: TrialSpec) -> None:
        """Queue a trial."""
        self._waiting.append(spec)
        self._start()

    def completed(self, timeout_s: float) -> Iterator[TrialResult]:
        """Yield the trials that have ended, waiting so long for a first one."""
        deadline = time.monotonic() + timeout_s
        while True:
            found = [result for number in list(self._running) if (result := self._look(number)) is not None]
            self._start()
            yield from found
            if found or time.monotonic() >= deadline:
                return
            time.sleep(_LOOK_EVERY_S)

    def cancel(self, *, above: int = -1) -> None:
        """Give up all trials whose number is greater than ``above``, at once."""
        self._waiting = deque(spec for spec in self._waiting if spec.number <= above)
        for number in [number for number in self._running if number > above]:
            _kill(self._running.pop(number).process)

    def close(self) -> None:
        """Kill every process."""
        self.cancel()

    def _start(self) -> None:
        while self._waiting and len(self._running) < self._parallel:
            spec = self._waiting.popleft()
            answer = self._settings.scratch / f"answer-{spec.number:06d}.json"
            answer.unlink(missing_ok=True)
            job = {"settings": self._settings.to_json(), "spec": spec.to_json(), "answer": str(answer)}
            with (self._settings.scratch / f"start-{spec.number:06d}.log").open("wb") as log:
                process = subprocess.Popen(
                    [sys.executable, "-P", "-m", "crashhunt.executors._fresh"],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=log,
                    env=fresh_environment(self._settings),
                    start_new_session=True,
                )
            assert process.stdin is not None
            with suppress(BrokenPipeError):
                process.stdin.write(json.dumps(job).encode())
                process.stdin.close()
            self._running[spec.number] = _Running(spec, process, answer, time.monotonic())

    def _look(self, number: int) -> TrialResult | None:
        running = self._running[number]
        exit_code, now = running.process.poll(), time.monotonic()
        if exit_code is not None:
            del self._running[number]
            return self._result(running, exit_code)
        header = where_it_is(self._settings.scratch, number)
        limit = self._settings.timeout_s + _LAST_WORDS_S
        if running.answer.exists():  # what is left to do is to find its escape, in trials that have limits of their own
            limit = _ESCAPE_S + 2 * limit
        if now - header.started > limit if header else now - running.began > limit + _START_UP_S:
            running.killed = True
            _kill(running.process)
        return None

    def _result(self, running: _Running, exit_code: int) -> TrialResult:
        scratch, spec = self._settings.scratch, running.spec
        if running.killed and not running.answer.exists():
            return hung(spec, scratch, self._settings.timeout_s)
        try:
            answer = json.loads(running.answer.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            if exit_code > 0 and where_it_is(scratch, spec.number) is None:
                log = scratch / f"start-{spec.number:06d}.log"
                lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
                raise CrashhuntError(
                    f"the process of trial {spec.number} could not start: {lines[-1] if lines else exit_code}",
                    fix="read the whole message there",
                    where=str(log),
                ) from None
            return died(spec, scratch, exit_code)
        if "error" in answer:
            raise CrashhuntError(**answer["error"])
        return TrialResult.from_json(answer["result"])


def fresh_environment(settings: WorkerSettings) -> dict[str, str]:
    """Return the environment of a fresh process, in which crashhunt itself comes from the snapshot too."""
    paths = os.pathsep.join(filter(None, (*settings.code, os.environ.get("PYTHONPATH"))))
    return {**os.environ, **worker_environment(), **({"PYTHONPATH": paths} if paths else {})}


def _kill(process: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def main() -> None:
    """Run the one trial that standard input describes."""
    job = json.load(sys.stdin)
    try:
        settings = WorkerSettings.from_json(job["settings"])
        require_origin("crashhunt", settings.code)
        seal(settings)
        worker = Worker(settings)
        result = worker.run(TrialSpec.from_json(job["spec"]))
    except CrashhuntError as error:
        _answer(job["answer"], error.to_json())
        return
    _answer(job["answer"], {"result": result.to_json()})  # which counts, whatever becomes of what follows
    escape = _escape(worker, settings, result) if settings.find_escapes else None
    if escape is not None:
        _answer(job["answer"], {"result": replace(result, escape=escape).to_json()})


def _answer(path: str, answer: dict[str, Any]) -> None:
    temporary = f"{path}.part"
    with open(temporary, "w", encoding="utf-8") as file:
        json.dump(answer, file)
    os.replace(temporary, path)  # noqa: PTH105 - one rename


def _escape(worker: Worker, settings: WorkerSettings, result: TrialResult) -> Escape | None:
    """Until when braking would have avoided a crash, by trials in this process, whose simulator is warm."""
    from crashhunt.escape import find_escape

    if result.collision is None:
        return None
    braking = worker.full_braking(result.collision.agent)
    if braking is None:
        return None
    numbers = itertools.count(result.spec.number + 1)  # folders of their own

    def recording(number: int) -> Recording:
        return Recording(read_black_box(scratch_of(settings.scratch, number) / BLACK_BOX))

    def run(spec: TrialSpec) -> tuple[TrialResult, Recording]:
        number = next(numbers)
        done = worker.run(replace(spec, number=number))
        return done, recording(number)

    try:
        return find_escape(result, recording(result.spec.number), braking, run)
    except BundleError:
        return None


if __name__ == "__main__":
    main()
