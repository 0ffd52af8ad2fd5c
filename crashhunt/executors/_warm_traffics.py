"""Warmed-up traffics: forks of a zygote that have reset the simulator, for trials that begin in the same traffic.

The zygote of a slot keeps some such processes suspended. A trial with the same seed and scenario arguments runs in a
fork of one of them, with the random generators as the reset left them: nothing in its digest shows the difference.
"""

from __future__ import annotations

import json
import os
import random
import sys
import time
from collections import OrderedDict
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from crashhunt.base import forks
from crashhunt.base.foreign_code import supports
from crashhunt.base.processes import adopt_orphans, children_of, end_descendants, kill
from crashhunt.base.resources import FREE, free_memory
from crashhunt.base.text import format_percent
from crashhunt.episode import options_of, seed_everything
from crashhunt.simulators import CountsSetUp
from crashhunt.trial import TrialSpec

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.executors._protocol import Job
    from crashhunt.executors._trial_process import TrialProcess
    from crashhunt.simulators import Info, Observations, Simulator

    Wait = Callable[[int | None, Callable[[], None]], None]


_CHUNK_BYTES = 1 << 16  # bytes at a time
_MIN_WARM_UP_S = 0.02  # a fork of a fork costs some ten milliseconds, half of them for its end
_TRIALS_UNTIL_STALE = 8  # a copy makes room after this many trials per copy without one in its traffic

# Bound here, before any agent is imported that could replace them.
_dumps, _loads = json.dumps, json.loads


class _Answer(TypedDict, total=False):
    """A report of a suspended process: the duration of its reset, its failure, or how the process of a trial ended."""

    took_s: float
    unfit: str
    pid: int
    ended: int


class WarmTraffics:
    """The suspended processes of a zygote: one for each traffic, in which the simulator has been reset.

    Args:
        limit: maximum number of suspended processes.
        notify: function called with texts for the user.
    """

    def __init__(self, limit: int, notify: Callable[[str], None]) -> None:
        self._limit = limit
        self._notify = notify
        self._suspended: OrderedDict[str, _Suspended] = OrderedDict()  # the most recently used is the last
        self._trials = 0
        self._trial: TrialProcess | None = None
        self._simulator: Simulator | None = None

    def prepare(self, trial: TrialProcess, simulator: Simulator) -> None:
        """Store the objects with which trials run."""
        self._trial, self._simulator = trial, simulator

    @property
    def processes(self) -> frozenset[int]:
        """The suspended processes, by traffic."""
        return frozenset(one.pid for one in self._suspended.values())

    def forget(self) -> None:
        """Close the pipes to the suspended processes in the present process, which runs a trial."""
        for one in self._suspended.values():
            one.close()
        self._suspended.clear()

    def run(self, job: Job, wait: Wait) -> tuple[int, int] | None:
        """Run a trial in a fork of the suspended process for its traffic; create that process if it is missing.

        ``wait`` waits until a descriptor can be read; its second argument is a function that kills the process.

        Returns:
            The process that ran the trial and its exit code; None if the trial has to run in a fork of the zygote.
        """
        if self._trial is None or self._limit == 0:
            return None
        self._trials += 1
        spec = TrialSpec.from_json(job["spec"])
        key = _traffic_key(spec)
        found = self._suspended.get(key) or self._make(key, spec, wait)
        if found is None:
            return None
        self._suspended.move_to_end(key)
        found.used = self._trials
        said = found.ask(_dumps(job).encode() + b"\n", wait)
        if said is None:  # it was killed, and the trial with it
            code = self._drop(key)
            return found.pid, code or -9
        if "unfit" in said:
            self._stop(said["unfit"])
            self._drop(key)
            return None
        return said["pid"], said["ended"]

    def _make(self, key: str, spec: TrialSpec, wait: Wait) -> _Suspended | None:
        if not self._make_room():
            return None
        requests, ours = os.pipe()
        theirs, answers = os.pipe()
        assert self._trial is not None
        assert self._simulator is not None
        be_suspended = partial(_be_suspended, requests, answers, self._trial, self._simulator, spec)
        try:
            pid = forks.fork(be_suspended, forks.held(), keeps=(requests, answers))
        except forks.CannotForkError as error:
            self._stop(error.message)
            os.close(ours)
            os.close(theirs)
            return None
        finally:
            os.close(requests)
            os.close(answers)
        made = self._suspended[key] = _Suspended(pid=pid, requests=ours, answers=theirs, used=self._trials)
        said = made.ask(b"", wait)
        if said is not None and said.get("took_s", 0.0) >= _MIN_WARM_UP_S:
            return made
        self._drop(key)
        if said is not None and "took_s" in said:
            self._limit = 0  # no warm-up here is worth it
        return None

    def _drop(self, key: str) -> int:
        return self._suspended.pop(key).end()

    def _stop(self, why: str) -> None:
        self._limit = 0
        self._notify(f"trials in the same traffic do not share its warm-up: {why}")

    def _make_room(self) -> bool:
        if free_memory() < FREE:
            self._notify(
                f"less than {format_percent(FREE)} of the memory is free: "
                "fewer warmed-up copies are kept than there might be"
            )
            return False
        if len(self._suspended) < self._limit:
            return True
        key, oldest = next(iter(self._suspended.items()))
        # Where trials take turns in more traffics than there are copies, the oldest one is the next to be used.
        if self._trials - oldest.used < _TRIALS_UNTIL_STALE * self._limit:
            return False
        self._drop(key)
        return True


@dataclass(slots=True, eq=False)
class _Suspended:
    """A suspended process and the pipes to it, as the zygote stores them."""

    pid: int  # process id of the suspended process
    requests: int  # the pipe for requests to the process
    answers: int  # the pipe for answers from the process
    used: int  # number of the last trial that used the process

    def ask(self, text: bytes, wait: Wait) -> _Answer | None:
        """Send a request to the process, and return its answer; None if the process has ended."""
        try:
            forks.write_all(self.requests, text)
        except BrokenPipeError:
            return None
        received = bytearray()
        while not received.endswith(b"\n"):
            wait(self.answers, self._kill)
            data = os.read(self.answers, _CHUNK_BYTES)
            if not data:
                return None
            received += data
        said: _Answer = _loads(received)
        return said

    def _kill(self) -> None:
        """Kill the trial, or the process itself if it is still resetting the simulator."""
        for pid in children_of(self.pid) or [self.pid]:
            kill(pid)

    def close(self) -> None:
        """Close the pipes to the process."""
        os.close(self.requests)
        os.close(self.answers)

    def end(self) -> int:
        """Kill the process, and return its exit code."""
        for child in children_of(self.pid):
            kill(child)
        kill(self.pid)
        code = forks.ended(self.pid)
        self.close()
        return code


def _be_suspended(requests: int, answers: int, trial: TrialProcess, simulator: Simulator, spec: TrialSpec) -> None:
    """Reset the simulator, and then run each requested trial in a fork."""
    adopt_orphans()
    began = time.monotonic()
    try:
        seed_everything(spec.seed)
        begun = simulator.reset(seed=spec.seed, options=options_of(spec, simulator))
    except BaseException:  # the trial resets again in a fork of the zygote, and reports what it raises
        _report(answers, {})
        return
    _report(answers, {"took_s": time.monotonic() - began})
    drawn = generators()

    def again(**_given: object) -> tuple[Observations, Info]:
        set_generators(drawn)
        return begun

    with os.fdopen(requests, "rb", closefd=False) as jobs:
        for line in jobs:
            try:
                pid = forks.fork(partial(_run, trial, line, again), forks.held())
            except forks.CannotForkError as error:
                _report(answers, {"unfit": error.message})
                continue
            code = forks.ended(pid)
            end_descendants()
            if supports(simulator, CountsSetUp):
                simulator.setup_steps = 0  # they have been counted, with the first trial
            _report(answers, {"pid": pid, "ended": code})


def generators() -> tuple[Any, ...]:
    """Return the state of the process's random generators."""
    torch = sys.modules.get("torch")
    ours = np.random.get_state()  # noqa: NPY002 - agents may use the global generator
    return random.getstate(), ours, torch.get_rng_state() if torch is not None else None


def set_generators(state: tuple[Any, ...]) -> None:
    """Restore the state of the process's random generators."""
    random.setstate(state[0])
    np.random.set_state(state[1])  # noqa: NPY002
    if state[2] is not None:
        sys.modules["torch"].set_rng_state(state[2])


def _run(trial: TrialProcess, line: bytes, again: Callable[..., tuple[Observations, Info]]) -> None:
    trial.run(_loads(line), again)


def _report(answers: int, said: _Answer) -> None:
    with suppress(BrokenPipeError):
        forks.write_all(answers, _dumps(said).encode() + b"\n")


def _traffic_key(spec: TrialSpec) -> str:
    """Return the key of a trial's traffic: its seed and the scenario's arguments."""
    script = None if spec.script is None else spec.script.to_json()
    return json.dumps([spec.seed, dict(spec.scenario_arguments), spec.only, script], sort_keys=True)
