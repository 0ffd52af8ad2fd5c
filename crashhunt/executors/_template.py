"""The template of a pool's workers: a process that has imported everything and run nothing. Every worker is its fork.

So a worker is there in milliseconds, and each begins in the same state. The template does nothing but fork, and tell
how its workers ended: it hears from the pool by a socket, and gives each worker one of its own.
"""

from __future__ import annotations

import gc
import json
import os
import select
import signal
import socket
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import DISK, CrashhuntError
from crashhunt.base.limits import limit_behind
from crashhunt.base.plugins import locate, registered
from crashhunt.base.processes import adopt_orphans, die_with, end_descendants, kill
from crashhunt.episode import WorkerSettings, answer_file, words_of
from crashhunt.executors._remains import DAMAGED
from crashhunt.executors._worker import Worker, loaded
from crashhunt.trial import TrialSpec

if TYPE_CHECKING:
    from crashhunt.base.plain import ErrorData
    from crashhunt.episode import Parts
    from crashhunt.executors._messages import Answer, FromTemplate, TemplateJob, ToTemplate

__all__ = ["main"]

_MESSAGE = 1 << 16  # bytes; an order to start a worker is some hundred
_ORPHANS_EVERY_S = 0.5  # looking for what dead workers have left behind walks all of /proc
_LOOK_EVERY_S = 0.02  # where the kernel does not tell when a process ends
# What belongs to the process as a whole is for the hunt; a worker dies of it as any process does.
_NOT_OURS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)

# Kept apart from what an agent may put in their place.
_dumps, _loads, _leave = json.dumps, json.loads, os._exit


def main() -> None:
    """Be the template; standard error is a log."""
    control = socket.socket(fileno=int(sys.argv[1]))
    job: TemplateJob = json.loads(Path(sys.argv[2]).read_text(encoding="utf-8"))
    sys.path[:] = job["sys_path"]
    for number in _NOT_OURS:
        signal.signal(number, signal.SIG_IGN)
    adopt_orphans()
    parts: Parts | None = None
    try:
        settings = WorkerSettings.from_json(job["settings"])
        if not job["late"]:
            parts = loaded(settings)
            if not _can_be_forked():
                _send(control, {"unfit": True})
                return
        elif settings.scenario.simulator in registered("simulators"):
            locate("simulators", settings.scenario.simulator)
    except CrashhuntError as error:
        _send(control, error.to_json())
        return
    gc.collect()
    gc.freeze()
    _send(control, {"ready": os.getpid()})
    _serve(control, settings, parts)


def _serve(control: socket.socket, settings: WorkerSettings, parts: Parts | None) -> None:
    slots: dict[int, int] = {}  # process to slot
    ended: dict[int, int] = {}  # process to what the kernel tells its end by, where it does
    while True:
        wait_s = _LOOK_EVERY_S if len(ended) < len(slots) else _ORPHANS_EVERY_S
        ready, _, _ = select.select([control.fileno(), *ended.values()], [], [], wait_s)
        if control.fileno() in ready:
            data, descriptors, _, _ = socket.recv_fds(control, _MESSAGE, 1)
            if not data:
                return  # the keeper ends everybody
            message: ToTemplate = json.loads(data)
            if "kill" in message:
                for pid in [pid for pid, slot in slots.items() if slot == message["kill"]]:
                    kill(pid)
                continue
            pid = os.fork()
            if pid == 0:
                for descriptor in ended.values():
                    os.close(descriptor)
                control.close()
                _be_worker(socket.socket(fileno=descriptors[0]), settings, parts)
            os.close(descriptors[0])
            slots[pid] = message["slot"]
            with suppress(AttributeError, OSError):
                ended[pid] = os.pidfd_open(pid)
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                break
            if pid == 0:
                break
            if pid in ended:
                os.close(ended.pop(pid))
            if pid in slots:
                _send(control, {"slot": slots.pop(pid), "pid": pid, "exit_code": os.waitstatus_to_exitcode(status)})
        # Whoever else is here has been left behind by a worker that has died: those of living workers are theirs.
        end_descendants(frozenset(slots))


def _be_worker(pool: socket.socket, settings: WorkerSettings, parts: Parts | None) -> None:
    """Run trials until the pool has no more, or one has changed what the next would find; does not return."""
    code = DAMAGED
    try:
        for number in _NOT_OURS:
            signal.signal(number, signal.SIG_DFL)
        os.setsid()  # what a terminal or a batch system tells everybody is for the hunt
        die_with(_template)
        worker = None
        answer: Answer
        place = os.fstat(own := pool.fileno())
        with pool.makefile("rb") as specs:
            for line in specs:
                try:
                    worker = worker or Worker(settings, parts, warm_copies=settings.warm_copies)
                    result = worker.run(TrialSpec.from_json(_loads(line)))
                    answer = {"result": result.to_json(), "change": worker.change}
                except CrashhuntError as error:
                    answer = error.to_json()
                except BaseException as error:
                    answer = _explained(error, used=worker is not None and worker.used)
                text = _dumps(answer).encode() + b"\n"
                if not _is_file(own, place):
                    answer_file(settings.scratch, _loads(line)["number"]).write_bytes(text)
                    return
                while text:
                    text = text[os.write(own, text) :]
                if answer.get("change", True):
                    break
        code = 0
    finally:
        _leave(code)


def _explained(error: BaseException, *, used: bool) -> Answer:
    """What came of a trial that raised what it should not: of its agent's doing where there was one, or our own."""
    said = f"{type(error).__name__}: {words_of(error)}"
    if used and not (isinstance(error, OSError) and error.errno in DISK):
        return {"damaged": said}
    fix = "free some space" if isinstance(error, OSError) and error.errno in DISK else "see to what it needs"
    fix = limit_behind(error) or fix
    return CrashhuntError(f"a worker cannot begin: {said}", fix=f"{fix}, and run the same command again").to_json()


def _is_file(descriptor: int, place: os.stat_result) -> bool:
    """Whether it is still what it was; an agent may have closed it, and opened something else in its place."""
    try:
        return os.path.samestat(os.fstat(descriptor), place)
    except OSError:
        return False


def _can_be_forked() -> bool:
    """Whether what has been imported allows it: a thread does not come along, and neither does a graphics card."""
    try:
        threads = len(os.listdir("/proc/self/task"))  # noqa: PTH208 - how many is enough
    except OSError:
        threads = len(sys._current_frames())
    torch = sys.modules.get("torch")
    return threads == 1 and not (torch is not None and torch.cuda.is_initialized())


def _send(control: socket.socket, message: FromTemplate | ErrorData) -> None:
    with suppress(OSError):  # nobody is there any more, which is seen elsewhere
        control.send(json.dumps(message).encode())


_template = os.getpid()
