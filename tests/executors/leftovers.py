"""An agent that leaves state behind, of one kind in each trial, and looks for every kind that an earlier trial left.

A trial is a fork of a process that has run no trial, so all objects of Python are one kind: memory. There are a few of
them; the other kinds are attributes of a process, of which there are a few too, and all that forks share.

Tests copy this file to where they work. Run by itself, it prints for each kind whether it is found before and after it
is left: a kind that is never found would test nothing.
"""

import array
import contextlib
import ctypes
import fcntl
import json
import mmap
import multiprocessing
import os
import platform
import signal
import subprocess
import sys
import tempfile
import threading
import types

from crashhunt.simulators import toy

KINDS = {}
libm = ctypes.CDLL("libm.so.6")
NOBODY = 65534
IS_ROOT = os.geteuid() == 0
UPWARD = {"x86_64": 0x800, "aarch64": 0x400000}.get(platform.machine(), 0)
FREE_DESCRIPTOR = 77


def left_where(found):
    """Register the decorated function, which leaves state behind, with the one that finds it."""

    def register(leave):
        KINDS[leave.__name__] = leave, found
        return leave

    return register


def left_as(read):
    """The same, for state that can be read, and is found where it is not what it was when this module was imported."""
    original = read()
    return left_where(lambda: read() != original)


# ---- memory and the processor ---------------------------------------------------------------------------------------

COUNT = 0
NUMBERS = array.array("d", [0.0])


@left_where(lambda: COUNT)
def module_global():
    global COUNT
    COUNT += 1


class Kept:
    """What must live as long as the process."""


KEPT = Kept()


@left_as(libm.fegetround)
def rounding_mode():
    libm.fesetround(UPWARD)


@left_as(lambda: toy.ToySimulator._target)
def method_of_simulator():
    toy.ToySimulator._target = lambda *_: 3.0


HIGHWAY = sys.modules.get("highway_env.vehicle.kinematics")


@left_as(lambda: HIGHWAY and (HIGHWAY.Vehicle.MAX_SPEED, HIGHWAY.Vehicle.clip_actions, HIGHWAY.Vehicle.LENGTH))
def class_of_highway_env():
    if HIGHWAY:
        HIGHWAY.Vehicle.MAX_SPEED, HIGHWAY.Vehicle.LENGTH = 11.0, 9.0


@left_as(lambda: ("left_over" in sys.modules, len(sys.path)))
def modules_and_path():
    sys.modules["left_over"] = types.ModuleType("left_over")
    sys.path.append("/left")


# ---- the process --------------------------------------------------------------------------------------------------


@left_where(lambda: "LEFT" in os.environ)
def environment():
    os.environ["LEFT"] = "1"


@left_as(os.getcwd)
def working_folder():
    os.chdir("/")


@left_where(lambda: signal.SIGUSR2 in signal.pthread_sigmask(signal.SIG_BLOCK, ()))
def signal_mask():
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR2})


def _is_open(descriptor):
    with contextlib.suppress(OSError):
        return bool(os.fstat(descriptor))


@left_where(lambda: _is_open(FREE_DESCRIPTOR))
def open_descriptor():
    os.dup2(0, FREE_DESCRIPTOR)


OWN_FILE = open(__file__, "rb", buffering=0)  # noqa: SIM115


@left_where(lambda: os.lseek(OWN_FILE.fileno(), 0, os.SEEK_CUR))
def offset_of_open_file():
    OWN_FILE.seek(40)


@left_where(lambda: fcntl.fcntl(OWN_FILE, fcntl.F_GETFL) & os.O_NONBLOCK)
def flags_of_open_file():
    fcntl.fcntl(OWN_FILE, fcntl.F_SETFL, os.O_NONBLOCK)


NAMELESS = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115


@left_where(lambda: os.pread(NAMELESS.fileno(), 9, 0))
def content_of_file_without_name():
    os.pwrite(NAMELESS.fileno(), b"left", 0)


MAPPED = mmap.mmap(-1, 64)
SHARED_VALUE = multiprocessing.Value("i", 0, lock=False)


@left_where(lambda: MAPPED[0])
def memory_map():
    MAPPED[0] = 1


@left_where(lambda: SHARED_VALUE.value)
def multiprocessing_value():
    SHARED_VALUE.value = 1


@left_as(threading.active_count)
def thread():
    threading.Thread(target=threading.Event().wait, daemon=True).start()


def _children():
    with open(f"/proc/self/task/{os.getpid()}/children") as file:
        return len(file.read().split())


@left_where(_children)
def child_process():
    nothing = subprocess.DEVNULL
    KEPT.child = subprocess.Popen(["sleep", "986"], stdin=nothing, stdout=nothing, stderr=nothing)


@left_where(lambda: os.geteuid() == NOBODY)
def effective_user():
    if IS_ROOT:
        os.seteuid(NOBODY)


@left_where(lambda: os.getuid() == NOBODY)
def user():
    if IS_ROOT:
        os.setuid(NOBODY)


class Agent:
    """Leaves state of one kind in its second step; fails in its first where it finds any."""

    def __init__(self, leaves=""):
        self.leave = KINDS[leaves][0] if leaves else lambda: None

    def reset(self, seed):
        self.step = 0

    def act(self, observation):
        self.step += 1
        if self.step == 1:
            found = [name for name, (_, find) in KINDS.items() if find()]
            if found:
                raise LookupError(f"an earlier trial has left: {', '.join(found)}")
        if self.step == 2:
            self.leave()
        return 5.0 + NUMBERS[0], 0


class MetaAgent(Agent):
    """The same, on highway-env."""

    def act(self, observation):
        super().act(observation)
        return 1


def _tried(leave, find, answer):
    """Write down whether a kind is found before and after it is left; ends this process."""
    write, leave_process, dumps = os.write, os._exit, json.dumps
    said = "null"
    try:
        before = bool(find())
        leave()
        said = dumps([before, bool(find())])
        if hasattr(KEPT, "child"):
            KEPT.child.kill()
    except BaseException as error:
        said = dumps(repr(error))
    finally:
        write(answer, said.encode())
        leave_process(0)


if __name__ == "__main__":
    seen = {}
    for name, (leave, find) in KINDS.items():
        receive, send = os.pipe()
        child = os.fork()
        if child == 0:
            _tried(leave, find, send)
        os.close(send)
        with os.fdopen(receive) as pipe:
            seen[name] = json.loads(pipe.read() or "null")
        os.waitpid(child, 0)
    print(json.dumps(seen))
