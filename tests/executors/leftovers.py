"""An agent that leaves state behind, of one kind in each trial, and looks for every kind that an earlier trial left.

A trial is a fork of a process that has run no trial, so all objects of Python are one kind: memory. There are a few of
them, of each place that has memory; the other kinds are those of the kernel, and those that forks share.

Tests copy this file to where they work. Run by itself, it prints for each kind whether it is found before and after it
is left: a kind that is never found would test nothing.
"""

import array
import atexit
import builtins
import contextlib
import contextvars
import ctypes
import fcntl
import functools
import gc
import io
import json
import locale
import logging
import math
import mmap
import multiprocessing
import os
import platform
import resource
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
import types
import warnings

import gymnasium
import numpy as np

from crashhunt.simulators import toy

KINDS = {}
libc = ctypes.CDLL(None, use_errno=True)
libm = ctypes.CDLL("libm.so.6")
NOBODY = 65534
IS_ROOT = os.geteuid() == 0
UPWARD = {"x86_64": 0x800, "aarch64": 0x400000}.get(platform.machine(), 0)
FREE_DESCRIPTOR = 77
PR_SET_NAME, PR_GET_NAME, PR_SET_NO_NEW_PRIVS, PR_GET_NO_NEW_PRIVS = 15, 16, 38, 39
PR_SET_DUMPABLE, PR_GET_DUMPABLE, PR_SET_TIMERSLACK, PR_GET_TIMERSLACK = 4, 3, 29, 30


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


# ---- objects of a module ------------------------------------------------------------------------------------------

COUNT = 0
BYTES = bytearray(8)
NUMBERS = array.array("d", [0.0])
VALUES = np.zeros(3)
VIEW = memoryview(bytearray(4))


@left_where(lambda: COUNT)
def module_global():
    global COUNT
    COUNT += 1


@left_where(lambda: any(BYTES) or NUMBERS[0] or VALUES.any() or any(VIEW))
def buffer_of_numbers():
    BYTES[0] = VIEW[1] = 1
    NUMBERS[0] = VALUES[1] = 0.5


class Plain:
    nested = {"gains": [1.0, 2.0]}  # noqa: RUF012


@left_where(lambda: Plain.nested["gains"][0] != 1.0)
def nested_in_class():
    Plain.nested["gains"][0] = 3.0


@functools.lru_cache
def cached(value):
    return [value]


@left_where(lambda: cached.cache_info().currsize)
def lru_cache():
    cached(1)


GENERATOR = (number for number in range(100))


@left_where(lambda: GENERATOR.gi_frame.f_lasti > 4 and next(GENERATOR) != 0)
def generator():
    next(GENERATOR)
    next(GENERATOR)


CONTEXT = contextvars.ContextVar("CONTEXT", default=0)
LOCK = threading.Lock()
EVENT = threading.Event()


@left_where(lambda: CONTEXT.get())
def context_variable():
    CONTEXT.set(1)


@left_where(lambda: LOCK.locked() or EVENT.is_set())
def lock_and_event():
    LOCK.acquire()
    EVENT.set()


DATABASE = sqlite3.connect(":memory:")
DATABASE.execute("create table seen (number)")


@left_where(lambda: DATABASE.execute("select count(*) from seen").fetchone()[0])
def database_in_memory():
    DATABASE.execute("insert into seen values (1)")


C_BUFFER = ctypes.create_string_buffer(8)


@left_where(lambda: C_BUFFER.raw != bytes(8))
def ctypes_buffer():
    ctypes.memset(C_BUFFER, 1, 8)


class Cyclic:
    def __del__(self):
        global COLLECTED
        COLLECTED = True


COLLECTED = False


@left_where(lambda: gc.collect() and COLLECTED)
def garbage_with_finalizer():
    one = Cyclic()
    one.itself = one


KEPT = Plain()


# ---- random numbers and arithmetic --------------------------------------------------------------------------------

RNG = np.random.default_rng(1)


@left_as(lambda: str(RNG.bit_generator.state))
def numpy_generator():
    RNG.random()


@left_where(lambda: libc.rand() != 1804289383)
def random_of_c():
    libc.srand(99)


@left_as(libm.fegetround)
def rounding_mode():
    libm.fesetround(UPWARD)


@left_as(np.geterr)
def numpy_error_state():
    np.seterr(all="ignore")


# ---- crashhunt, the simulator, libraries ----------------------------------------------------------------------------


@left_as(lambda: toy._ACCELERATION)
def constant_of_crashhunt():
    toy._ACCELERATION = 4.0


@left_as(lambda: toy.ToySimulator._target)
def method_of_simulator():
    toy.ToySimulator._target = lambda *_: 3.0


@left_as(lambda: (vars(gymnasium.Env).get("left"), len(gymnasium.registry)))
def gymnasium_class_and_registry():
    gymnasium.Env.left = 1
    gymnasium.register("Left-v0", "nowhere:Nothing")


@left_as(lambda: (builtins.abs, hasattr(builtins, "left")))
def builtin_function():
    builtins.abs, builtins.left = (lambda _: 1), 1


def _found_in(*names):
    modules = [(sys.modules[module], name) for module, name in names if module in sys.modules]
    return lambda: [getattr(module, name) for module, name in modules]


@left_as(_found_in(("libsumo.vehicle", "getSpeed"), ("libsumo", "simulationStep"), ("math", "tau")))
def function_of_sumo():
    math.tau = 6.0
    if "libsumo" in sys.modules:
        sys.modules["libsumo"].vehicle.getSpeed = sys.modules["libsumo"].simulationStep = None


HIGHWAY = sys.modules.get("highway_env.vehicle.kinematics")


@left_as(lambda: HIGHWAY and (HIGHWAY.Vehicle.MAX_SPEED, HIGHWAY.Vehicle.clip_actions, HIGHWAY.Vehicle.LENGTH))
def class_of_highway_env():
    if HIGHWAY:
        HIGHWAY.Vehicle.MAX_SPEED, HIGHWAY.Vehicle.LENGTH = 11.0, 9.0


# ---- the interpreter ----------------------------------------------------------------------------------------------


@left_as(lambda: ("left_over" in sys.modules, len(sys.path)))
def modules_and_path():
    sys.modules["left_over"] = types.ModuleType("left_over")
    sys.path.append("/left")


@left_as(lambda: (len(sys.meta_path), len(sys.path_hooks), "/left" in sys.path_importer_cache))
def import_hooks():
    sys.meta_path.insert(0, types.SimpleNamespace(find_spec=lambda *_: None))
    sys.path_hooks.append(lambda _: None)
    sys.path_importer_cache["/left"] = None


@left_as(lambda: len(warnings.filters))
def warning_filters():
    warnings.filterwarnings("error", "left")


@left_as(lambda: (gc.get_threshold(), gc.isenabled(), len(gc.callbacks)))
def garbage_collector():
    gc.set_threshold(5, 5, 5)
    gc.disable()
    gc.callbacks.append(lambda *_: None)


@left_as(lambda: atexit._ncallbacks())
def atexit_callback():
    atexit.register(os._exit, 5)


FORKED = []


@left_where(lambda: FORKED)
def fork_hook():
    os.register_at_fork(before=lambda: FORKED.append(1))
    FORKED.append(0)


@left_where(lambda: sys.gettrace() or sys.getprofile() or threading.gettrace())
def trace_and_profile():
    sys.setprofile(lambda *_: None)
    threading.settrace(lambda *_: None)


@left_where(lambda: hasattr(sys.stdout, "left") or sys.stdin is None)
def standard_streams():
    sys.stdin, sys.stdout = None, io.StringIO()
    sys.stdout.left = 1


def _logging():
    handlers = [handler for handler in logging.getLogger().handlers if type(handler) is logging.NullHandler]
    return len(handlers), logging.getLogger("left").level, logging.root.manager.disable


@left_as(_logging)
def logging_state():
    logging.getLogger().addHandler(logging.NullHandler())
    logging.getLogger("left").setLevel(5)
    logging.disable(5)


@left_as(lambda: (time.timezone, os.environ.get("TZ")))
def time_zone():
    os.environ["TZ"] = "left-3"
    time.tzset()


@left_where(lambda: locale.setlocale(locale.LC_TIME) != locale.setlocale(locale.LC_MONETARY))
def locale_setting():
    now = locale.setlocale(locale.LC_TIME)  # which SUMO sets for all categories at once
    locale.setlocale(locale.LC_TIME, "C" if now != "C" else "C.UTF-8")


@left_where(lambda: multiprocessing.get_start_method(allow_none=True) == "spawn")
def start_method():
    multiprocessing.set_start_method("spawn", force=True)


# ---- the process --------------------------------------------------------------------------------------------------


@left_where(lambda: "LEFT" in os.environ)
def environment():
    os.environ["LEFT"] = "1"


libc.getenv.restype = ctypes.c_char_p


@left_where(lambda: libc.getenv(b"LEFT_IN_C"))
def environment_of_c():
    libc.setenv(b"LEFT_IN_C", b"1", 1)


@left_as(os.getcwd)
def working_folder():
    os.chdir("/")


def _umask():
    now = os.umask(0o22)
    os.umask(now)
    return now


@left_as(_umask)
def umask():
    os.umask(0o077)


@left_as(lambda: (resource.getrlimit(resource.RLIMIT_NOFILE), resource.getrlimit(resource.RLIMIT_CORE)))
def resource_limits():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft - 1, hard))


@left_as(lambda: os.getpriority(os.PRIO_PROCESS, 0))
def niceness():
    os.nice(1)


@left_as(lambda: len(os.sched_getaffinity(0)))
def processor_affinity():
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


@left_where(lambda: callable(signal.getsignal(signal.SIGUSR2)))
def signal_handler():
    signal.signal(signal.SIGUSR2, lambda *_: None)


@left_where(lambda: signal.SIGUSR2 in signal.pthread_sigmask(signal.SIG_BLOCK, ()))
def signal_mask():
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR2})


@left_where(lambda: signal.SIGURG in signal.sigpending())
def pending_signal():
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGURG})
    os.kill(os.getpid(), signal.SIGURG)


@left_where(lambda: any(signal.getitimer(timer)[0] for timer in (signal.ITIMER_REAL, signal.ITIMER_VIRTUAL)))
def interval_timer():
    signal.setitimer(signal.ITIMER_REAL, 1000)
    signal.setitimer(signal.ITIMER_VIRTUAL, 1000)


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


def _comm():
    with open("/proc/self/comm") as file:
        return file.read()


@left_where(lambda: _comm() == "left\n")
def process_name():
    libc.prctl(PR_SET_NAME, b"left", 0, 0, 0)


@left_as(lambda: (libc.prctl(PR_GET_NO_NEW_PRIVS, 0, 0, 0, 0), libc.prctl(PR_GET_TIMERSLACK, 0, 0, 0, 0)))
def process_controls():
    libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    libc.prctl(PR_SET_TIMERSLACK, 77_000, 0, 0, 0)


@left_where(lambda: os.geteuid() == NOBODY)
def effective_user():
    if IS_ROOT:
        os.seteuid(NOBODY)


@left_where(lambda: os.getuid() == NOBODY)
def user():
    if IS_ROOT:
        os.setuid(NOBODY)


@left_where(lambda: os.getegid() == NOBODY or NOBODY in os.getgroups())
def group():
    if IS_ROOT:
        os.setgroups([NOBODY])
        os.setegid(NOBODY)


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
