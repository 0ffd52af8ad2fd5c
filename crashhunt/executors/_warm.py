"""Warm-up once: copies of a worker that sleep where the traffic has warmed up, for trials that begin in the same way.

A worker that has reset its simulator leaves a copy of itself there, asleep, and goes on with its trial. The next trial
with the same seed and arguments of the scenario is run by a copy of that copy, in the folder that the worker has
prepared, and with the same generators: so nothing in its digest tells the difference. Where such a process dies, the
worker dies in the same way, so that whoever looks after workers need not know.
"""

from __future__ import annotations

import faulthandler
import json
import os
import signal
from collections import OrderedDict
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypedDict

from crashhunt.base import forks
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.memory import FREE, free_memory
from crashhunt.base.processes import end_descendants, kill
from crashhunt.episode import words_of
from crashhunt.trial import TrialResult, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.trial import ResultData, SpecData

__all__ = ["WarmCopies"]

_RECEIVED = 1 << 16
_WORTH_S = 0.02  # a copy of a copy costs some ten milliseconds, half of them for its end
_STALE = 8  # as many times as there are copies, trials go by without one before it makes room for another

# Kept apart from what an agent may put in their place.
_dumps, _loads, _leave, _write = json.dumps, json.loads, os._exit, os.write


class _Job(TypedDict):
    """What a sleeping copy is asked: a trial, and how much of its black box there is."""

    spec: SpecData
    reserved: int


class _Said(TypedDict, total=False):
    """What comes of it: a result, or what was raised, or why it was not run; and how the process ended."""

    number: int
    result: ResultData
    error: dict[str, str]
    raised: str
    unfit: str
    ended: int


class WarmCopies:
    """The copies that a worker keeps asleep.

    They end with the worker, or when too many others have been used since.

    Args:
        most: how many, at the same time.
        tell: called with what people should know.
        worth_s: wall time that a warm-up takes at least which is worth a copy, in s.
    """

    def __init__(self, most: int, tell: Callable[[str], None], *, worth_s: float = _WORTH_S) -> None:
        self._worth_s = worth_s
        self._most = most
        self._tell = tell
        self._asleep: OrderedDict[str, _Asleep] = OrderedDict()  # the one that was used last is the last
        self._trials = 0

    def run(self, spec: TrialSpec, reserved: int) -> TrialResult | None:
        """Run a trial in a copy of the copy for it; None where there is none.

        Args:
            spec: the trial; its folder has been prepared.
            reserved: how much of its black box there is, in bytes.

        Raises:
            CrashhuntError: as the trial said.
            RuntimeError: the process that ran it is damaged, in words.
        """
        self._trials += 1
        key = _key(spec)
        found = self._asleep.get(key)
        if found is None:
            return None
        self._asleep.move_to_end(key)
        found.used = self._trials
        said = found.ask({"spec": spec.to_json(), "reserved": reserved}, spec.number)
        if said is None or "unfit" in said:
            self._asleep.pop(key).end()
            if said is not None:
                self._stop(said["unfit"])
            return None
        if "error" in said:
            raise CrashhuntError(**said["error"])
        if "raised" in said:
            raise RuntimeError(said["raised"])
        if "ended" in said:
            _die(said["ended"])
        return TrialResult.from_json(said["result"])

    def keep(self, spec: TrialSpec, run: Callable[[TrialSpec, int], TrialResult], *, took_s: float) -> None:
        """Leave a copy of this process asleep, where there is room, for trials that begin as this one has.

        Args:
            spec: the trial whose simulator has been reset just now.
            took_s: wall time that it took, in s.
            run: called in a copy of the copy, with a trial and how much of its black box there is.
        """
        if self._most == 0 or took_s < self._worth_s or not self._make_room():
            return
        wakes, ours = os.pipe()
        theirs, says = os.pipe()
        try:
            pid = forks.fork(lambda: _sleep(wakes, says, run), forks.held(), keeps=(wakes, says))
        except forks.CannotForkError as error:
            self._stop(error.message)
            os.close(ours)
            os.close(theirs)
        else:
            self._asleep[_key(spec)] = _Asleep(pid, ours, theirs, self._trials)
        finally:
            os.close(wakes)
            os.close(says)

    @property
    def processes(self) -> frozenset[int]:
        """The copies."""
        return frozenset(one.pid for one in self._asleep.values())

    def _stop(self, why: str) -> None:
        self._most = 0
        self._tell(f"trials in the same traffic do not share its warm-up: {why}")

    def _make_room(self) -> bool:
        if free_memory() < FREE:
            self._tell(
                f"less than {FREE:.0%} of the memory is free: fewer warmed-up copies are kept than there might be"
            )
            return False
        if len(self._asleep) < self._most:
            return True
        key, oldest = next(iter(self._asleep.items()))
        # Where trials take turns in more traffics than there are copies, the oldest one is the next to be used.
        if self._trials - oldest.used < _STALE * self._most:
            return False
        del self._asleep[key]
        oldest.end()
        return True


@dataclass(slots=True, eq=False)
class _Asleep:
    """A sleeping copy, as its worker knows it.

    Args:
        pid: its process.
        asks: the end of a pipe to it.
        says: the end of one from it.
        used: by which trial last.
    """

    pid: int
    asks: int
    says: int
    used: int

    def ask(self, job: _Job, number: int) -> _Said | None:
        """Return what it says of a trial; None where it is not there."""
        text = _dumps(job).encode() + b"\n"
        try:
            while text:
                text = text[_write(self.asks, text) :]
        except BrokenPipeError:
            return None
        received = b""
        while True:
            *lines, received = received.split(b"\n")
            for line in lines:
                said: _Said = _loads(line)
                if said["number"] == number:  # else how the one before has ended
                    return said
            data = os.read(self.says, _RECEIVED)
            if not data:
                _die(forks.ended(self.pid))
            received += data

    def end(self) -> None:
        kill(self.pid)
        forks.ended(self.pid)
        os.close(self.asks)
        os.close(self.says)


def _die(code: int) -> None:
    """End as the process did that ran the trial."""
    if code < 0:
        faulthandler.disable()  # which process it was it has said itself
        with suppress(OSError, ValueError):
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    _leave(code)


def _sleep(wakes: int, says: int, run: Callable[[TrialSpec, int], TrialResult]) -> None:
    """Be a sleeping copy: whenever it is asked for a trial, have a copy run it."""
    with os.fdopen(wakes, "rb", closefd=False) as jobs:
        for line in jobs:
            job: _Job = _loads(line)
            number = job["spec"]["number"]
            try:
                pid = forks.fork(partial(_run, job, says, run), forks.held(), keeps=(says,))
            except forks.CannotForkError as error:
                _say(says, {"number": number, "unfit": error.message})
                continue
            code = forks.ended(pid)
            end_descendants()
            _say(says, {"number": number, "ended": code})


def _run(job: _Job, says: int, run: Callable[[TrialSpec, int], TrialResult]) -> None:
    from crashhunt.executors._remains import DAMAGED

    spec = TrialSpec.from_json(job["spec"])
    said: _Said = {"number": spec.number}
    place = os.fstat(says)
    try:
        said["result"] = run(spec, job["reserved"]).to_json()
    except CrashhuntError as error:
        said["error"] = {"message": error.message, "fix": error.fix, "where": error.where}
    except BaseException as error:
        said["raised"] = f"{type(error).__name__}: {words_of(error)}"
    try:
        if not os.path.samestat(os.fstat(says), place):  # the agent has closed it, and opened something else
            _leave(DAMAGED)
        _say(says, said)
    except OSError:
        _leave(DAMAGED)


def _say(says: int, said: _Said) -> None:
    text = _dumps(said).encode() + b"\n"
    while text:
        text = text[_write(says, text) :]


def _key(spec: TrialSpec) -> str:
    """What the traffic of a trial follows from."""
    script = None if spec.script is None else spec.script.to_json()
    return json.dumps([spec.seed, dict(spec.scenario_arguments), spec.only, script], sort_keys=True)
