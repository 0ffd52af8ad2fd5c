"""What runs in a worker process: one simulator, kept warm, and one trial after another."""

from __future__ import annotations

import ctypes
import faulthandler
import gc
import io
import json
import logging
import os
import shutil
import signal
import sys
import time
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crashhunt.episode import run_episode
from crashhunt.executors._parts import Braking, Parts
from crashhunt.executors._protocol import WorkerSettings, scratch_of
from crashhunt.recording import BlackBox
from crashhunt.scene import Lane
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.agents import Agent
    from crashhunt.simulators import FullBraking, Simulator
    from crashhunt.trial import Overruled, TrialResult, TrialSpec

__all__ = [
    "BLACK_BOX",
    "MAP",
    "OUTPUT",
    "STACK",
    "Worker",
    "read_map",
    "read_tail",
    "worker_environment",
]

BLACK_BOX, OUTPUT, STACK, MAP = "blackbox.bin", "run.log", "stack.txt", "map.json"
_PR_SET_PDEATHSIG = 1
_TAIL = 4000  # bytes


def worker_environment() -> dict[str, str]:
    """Return the environment variables that make a worker's results depend on its trial alone.

    Hashes of strings are fixed, and every library that would start a thread a core keeps to one: with a worker on
    every core, more would only get in each other's way, and sums in parallel are not reproducible to the bit.
    """
    names = (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
    )
    return {"PYTHONHASHSEED": "0", **dict.fromkeys(names, "1")}


class Worker:
    """Runs the trials of one hunt in this process, and takes the process over: its output, its signals.

    Args:
        settings: of the hunt.
    """

    def __init__(self, settings: WorkerSettings) -> None:
        self._settings = settings
        self._simulator: Simulator | None = None
        self._box: BlackBox | None = None
        self._folder: Path | None = None
        self._lanes: Sequence[Lane] | None = None  # of the map that all workers share
        self._fresh = 0
        self._home = Path.cwd()
        _die_with_parent()
        # Ctrl-C reaches the whole terminal; the hunt decides what becomes of its workers. A request to end must work
        # even while the simulator does not return to Python.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        # Line by line, so that what a dying process printed last is in the file.
        sys.stdout = io.TextIOWrapper(os.fdopen(1, "wb", 0, closefd=False), "utf-8", "replace", write_through=True)
        sys.stderr = io.TextIOWrapper(os.fdopen(2, "wb", 0, closefd=False), "utf-8", "replace", write_through=True)
        logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(levelname)s %(name)s: %(message)s")
        self._parts = Parts(settings)
        gc.freeze()  # what is loaded by now is never garbage

    def run(self, spec: TrialSpec) -> TrialResult:
        """Run a trial. Its scratch folder stays where the result says ``kept``.

        Raises:
            OSError: the disk is full.
        """
        os.chdir(self._home)  # from wherever the last agent has gone
        box, folder = self._prepare(spec)
        began = time.monotonic()
        simulator = self._simulator
        if simulator is None:
            simulator = self._simulator = self._parts.simulator()
        made = time.monotonic()
        # Writes down where every thread is, without needing the interpreter; then it is the hunt's turn to act.
        faulthandler.dump_traceback_later(self._settings.timeout_s, file=self._stack)
        result = run_episode(
            spec,
            simulator=simulator,
            make_agent=self._parts.agent if spec.overruled is None else partial(self._overruled, spec.overruled),
            box=box,
            oracles=self._parts.oracles,
            crash_on=self._settings.crash_on,
        )
        faulthandler.cancel_dump_traceback_later()
        kept = self._settings.keep_trials or result.outcome in self._settings.crash_on or result.failure is not None
        if result.outcome is not Outcome.INVALID:
            self._draw_map(simulator, folder if kept else None)
        failure = result.failure and replace(result.failure, last_output=read_tail(folder / OUTPUT))
        wall_s, setup_s = time.monotonic() - began, made - began + result.setup_s
        result = replace(result, worker=os.getpid(), kept=kept, wall_s=wall_s, setup_s=setup_s, failure=failure)
        if kept:
            # The next trial gets a folder of its own; this one now belongs to the hunt.
            self._folder = None
            if result.failure is not None and result.failure.traceback:
                (folder / "error.log").write_text(result.failure.traceback, encoding="utf-8", errors="replace")
        return result

    def full_braking(self, agent: str) -> FullBraking | None:
        """Return how a vehicle of the last trial brakes as hard as it can, where its simulator says."""
        offered = getattr(self._simulator, "full_braking", None)
        found: FullBraking | None = offered(agent) if offered is not None else None
        return found

    def _overruled(self, overruled: Overruled, agent: str, simulator: Simulator, arguments: Mapping[str, Any]) -> Agent:
        made = self._parts.agent(agent, simulator, arguments)
        return Braking(made, simulator, agent, overruled.after) if agent == overruled.agent else made

    def _draw_map(self, simulator: Simulator, kept: Path | None) -> None:
        """Write the map down, once for all workers; for a trial that is kept, where an argument has made it another."""
        path = self._settings.scratch / MAP
        draw = getattr(simulator, "lanes", None)
        if draw is None or (path.exists() and kept is None):
            return
        lanes = draw()
        if lanes is self._lanes:  # of a simulator whose map is always the same
            return
        text = json.dumps([[lane.id, lane.width, lane.shape] for lane in lanes])
        if not path.exists():
            temporary = path.with_suffix(f".{os.getpid()}")
            temporary.write_text(text, encoding="utf-8")
            temporary.replace(path)
        elif kept is not None and path.read_text(encoding="utf-8") != text:
            (kept / MAP).write_text(text, encoding="utf-8")
            return
        self._lanes = lanes

    def _prepare(self, spec: TrialSpec) -> tuple[BlackBox, Path]:
        """Give the trial its scratch folder: that of the last one, whose pages are warm, or a new one."""
        folder = scratch_of(self._settings.scratch, spec.number)
        if folder.exists():
            shutil.rmtree(folder)  # of an earlier attempt at the same trial
        if self._folder is None:
            self._fresh += 1
            made = self._settings.scratch / f"new-{os.getpid()}-{self._fresh}"
            made.mkdir()
            if self._box is not None:
                self._box.close()
            self._box = BlackBox(made / BLACK_BOX)
            output = os.open(made / OUTPUT, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            os.dup2(output, 1)
            os.dup2(output, 2)
            os.close(output)
            self._stack = (made / STACK).open("w")
            faulthandler.enable(self._stack)
            faulthandler.register(signal.SIGUSR1, self._stack)
            self._folder = made
        assert self._box is not None
        self._box.begin(pid=os.getpid(), trial=spec.number, started=time.monotonic())
        os.ftruncate(1, 0)
        os.ftruncate(self._stack.fileno(), 0)
        os.rename(self._folder, folder)  # noqa: PTH104 - Path.rename builds a path for nothing
        self._folder = folder
        return self._box, folder


def read_map(scratch: Path, trial: Path) -> list[Lane]:
    """Return the map of a trial that is kept, or that of its hunt; nothing where none has been written down."""
    for folder in (trial, scratch):
        with suppress(OSError, ValueError):
            data = json.loads((folder / MAP).read_text(encoding="utf-8"))
            return [Lane(name, width, tuple(map(tuple, shape))) for name, width, shape in data]
    return []


def read_tail(path: Path) -> str:
    """Return the last few thousand characters of a file; nothing where there is none."""
    try:
        with path.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - _TAIL))
            return file.read().decode("utf-8", "replace")
    except OSError:
        return ""


def _die_with_parent() -> None:
    """Have the kernel end this process when its parent is gone, whatever it is doing; where that can be had."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


# A pool's task is a function, and what the process keeps warm has to live somewhere between two of them.
_worker: Worker | None = None


def start_worker(settings: WorkerSettings) -> None:
    """Make this process a worker; a pool's initializer."""
    global _worker
    _worker = Worker(settings)


def run_trial(spec: TrialSpec) -> TrialResult:
    """Run a trial in the worker that this process is; a pool's task."""
    assert _worker is not None
    return _worker.run(spec)
