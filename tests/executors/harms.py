"""An agent that does harm of a kind, at a moment. Tests copy this file to where they work; the table is in `HARMS`."""

import atexit
import builtins
import contextlib
import ctypes
import fcntl
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

from crashhunt.base.errors import CrashhuntError, InvalidEpisodeError, RecorderError, SimulatorError

KEPT = []
HARMS = {}
libc = ctypes.CDLL(None)


def harm(nature):
    """Register a function that does harm, with what becomes of a process in which it is called.

    Args:
        nature: ``raises`` an exception, ``dies``, ``hangs``, or ``lives``.
    """

    def register(do):
        HARMS[do.__name__] = nature, do
        return do

    return register


def folder():
    """The scratch folder of the trial, where its output goes."""
    return Path(os.readlink("/proc/self/fd/1")).parent


# ---- exceptions ----------------------------------------------------------------------------------------------------


class MuteError(Exception):
    def __str__(self):
        raise RuntimeError("no words")


class LeavingError(Exception):
    def __str__(self):
        sys.exit(4)


class BareError(BaseException):
    pass


@harm("raises")
def raises_error():
    raise ValueError("harm")


@harm("raises")
def raises_bare():
    raise BareError("harm")


@harm("raises")
def interrupts():
    raise KeyboardInterrupt


@harm("raises")
def exits():
    sys.exit(4)


@harm("raises")
def raises_mute():
    raise MuteError


@harm("raises")
def raises_leaving():
    raise LeavingError


@harm("raises")
def raises_surrogate():
    raise ValueError("half \udcff a letter")


@harm("raises")
def raises_long_message():
    raise ValueError("ab\n" * 12_000_000)


@harm("raises")
def raises_group():
    raise ExceptionGroup("many", [ValueError(number) for number in range(20_000)])


@harm("raises")
def raises_chain():
    error = None
    for number in range(20_000):
        newer = ValueError(number)
        newer.__context__ = error
        error = newer
    raise error


@harm("raises")
def recurses():
    def deeper():
        deeper()

    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(10**9)
    try:
        deeper()
    finally:
        sys.setrecursionlimit(limit)


@harm("raises")
def feigns_full_disk():
    raise RecorderError("the disk is full", fix="buy one")


@harm("raises")
def feigns_end_of_hunt():
    raise CrashhuntError("the hunt is over", fix="go home")


@harm("raises")
def feigns_simulator():
    raise SimulatorError("SUMO gave up")


@harm("raises")
def feigns_invalid():
    raise InvalidEpisodeError("no room")


@harm("raises")
def raises_forever():
    def handle(*_):
        raise ValueError("again")

    signal.signal(signal.SIGALRM, handle)
    signal.setitimer(signal.ITIMER_REAL, 0.0005, 0.0005)


@harm("raises")
def runs_out_of_memory():
    limit = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (64 << 20), limit[1]))
    try:
        KEPT.append(bytearray(1 << 30))
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limit)


# ---- ends of the process -------------------------------------------------------------------------------------------


@harm("dies")
def exits_at_once():
    os._exit(3)


@harm("dies")
def dies_with_program():
    starts_daemon()
    os._exit(3)


@harm("dies")
def exits_with_success():
    os._exit(0)


@harm("dies")
def exits_with_79():
    os._exit(79)


@harm("dies")
def exits_with_78():
    os._exit(78)


@harm("dies")
def segfaults():
    ctypes.string_at(0)


@harm("dies")
def aborts():
    os.abort()


@harm("dies" if sys.version_info < (3, 12) else "raises")  # since then, Python raises RecursionError in time
def overflows_stack():
    sys.setrecursionlimit(10**9)

    class Shown:
        def __repr__(self):
            return repr(self)

    repr(Shown())


@harm("dies")
def becomes_another_program():
    os.execv("/bin/true", ["true"])


@harm("dies")
def divides_in_c():
    os.kill(os.getpid(), signal.SIGFPE)


@harm("dies")
def kills_itself():
    os.kill(os.getpid(), signal.SIGKILL)


@harm("dies")
def terminates_group():
    os.killpg(0, signal.SIGTERM)
    time.sleep(60)


@harm("dies")
def frees_what_is_not_its_own():
    libc.free(ctypes.c_void_p(0x1010))


# ---- endless waits -------------------------------------------------------------------------------------------------


@harm("hangs")
def sleeps():
    time.sleep(3600)


@harm("hangs")
def hangs_with_program():
    starts_daemon()
    time.sleep(3600)


@harm("hangs")
def loops():
    while True:
        pass


@harm("hangs")
def sleeps_in_c():
    ctypes.PyDLL(None).sleep(3600)


@harm("hangs")
def stops_itself():
    os.kill(os.getpid(), signal.SIGSTOP)


# ---- descriptors and files -----------------------------------------------------------------------------------------


@harm("lives")
def closes_everything():
    os.closerange(0, 1000)


@harm("lives")
def closes_output():
    os.close(1)
    os.close(2)


@harm("lives")
def covers_every_descriptor():
    nothing = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(64):
        os.dup2(nothing, descriptor)


@harm("lives")
def leaks_descriptors():
    with contextlib.suppress(OSError):
        while True:
            KEPT.append(os.open(os.devnull, os.O_RDONLY))


@harm("lives")
def writes_to_every_descriptor():
    for descriptor in range(64):
        with contextlib.suppress(OSError):
            if not os.path.isfile(f"/proc/self/fd/{descriptor}"):  # what is done to files has kinds of its own
                fcntl.fcntl(descriptor, fcntl.F_SETFL, os.O_NONBLOCK)
                os.write(descriptor, b'{"result": 1}\n{"error": {"message": "over", "fix": "", "where": ""}}\n')


@harm("lives")
def deletes_folder():
    shutil.rmtree(folder())


@harm("lives")
def deletes_all_scratch():
    for path in folder().parent.iterdir():
        if path.name.startswith(("trial-", "new-")):
            shutil.rmtree(path)


@harm("lives")
def replaces_folder_by_file():
    place = folder()
    shutil.rmtree(place)
    place.write_text("nothing")


@harm("lives")
def renames_folder():
    place = folder()
    place.rename(place.with_name(f"{place.name}-moved"))


@harm("lives")
def forbids_folder():
    folder().chmod(0)


@harm("lives")
def fills_folder():
    for name in ("error.log", "map.json", "entered.json", "answer.json"):
        (folder() / name).write_text('{"result": 1}')
    (folder() / "sub").mkdir(exist_ok=True)


@harm("lives")
def links_output_elsewhere():
    place = folder()
    for name in ("run.log", "stack.txt"):
        with contextlib.suppress(OSError):
            (place / name).unlink()
            (place / name).symlink_to("/etc/passwd")


@harm("lives")
def leaves_working_folder():
    os.makedirs("gone", exist_ok=True)
    os.chdir("gone")
    os.rmdir(os.getcwd())


@harm("lives")
def prints_much():
    print("x" * 3_000_000)


@harm("lives")
def prints_bytes():
    os.write(1, bytes(range(256)) * 100)


# ---- Python itself -------------------------------------------------------------------------------------------------


@harm("lives")
def no_open():
    builtins.open = None


@harm("lives")
def no_json():
    json.dumps = json.loads = json.encoder.JSONEncoder.encode = None


@harm("lives")
def no_os():
    os._exit = os.write = os.getpid = os.dup2 = None


@harm("lives")
def no_output():
    sys.stdout = sys.stderr = None


@harm("lives")
def no_environment():
    os.environ.clear()


@harm("lives")
def imports_fail():
    sys.meta_path[:] = []
    sys.path[:] = []


# ---- signals, limits, processes ------------------------------------------------------------------------------------


@harm("lives")
def deaf():
    for number in range(1, 65):
        with contextlib.suppress(OSError, ValueError):
            signal.signal(number, signal.SIG_IGN)


@harm("lives")
def blocks_signals():
    signal.pthread_sigmask(signal.SIG_BLOCK, range(1, 65))


@harm("lives")
def limits_files():
    resource.setrlimit(resource.RLIMIT_NOFILE, (1, 1))


@harm("lives")
def limits_size_of_files():
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))


@harm("lives")
def limits_processes():
    resource.setrlimit(resource.RLIMIT_NPROC, (1, 1))


@harm("lives")
def becomes_nobody():
    if os.geteuid() == 0:
        os.setuid(65534)


@harm("lives")
def starts_program():
    KEPT.append(subprocess.Popen(["sleep", "986"]))


@harm("lives")
def starts_daemon():
    subprocess.run(["setsid", "sh", "-c", "sleep 986 & sleep 986 &"], check=True)


@harm("lives")
def starts_threads():
    for _ in range(5):
        threading.Thread(target=time.sleep, args=(3600,), daemon=True).start()


@harm("lives")
def forks():
    os.fork()


@harm("lives")
def limits_its_parent():
    resource.prlimit(os.getppid(), resource.RLIMIT_NOFILE, (64, 64))


@harm("lives")
def pending_alarm():
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, 3600)


# ---- the processes above -------------------------------------------------------------------------------------------


def relatives():
    """Processes by what they are to this one: those of the hunt's machinery, but not the hunt itself."""

    def parent_of(pid):
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])

    zygote = os.getppid()
    template = parent_of(zygote)
    server = parent_of(template)
    found = {"zygote": zygote, "template": template, "server": server}
    output = os.readlink("/proc/self/fd/1")
    for name in filter(str.isdigit, os.listdir("/proc")):
        with contextlib.suppress(OSError):
            if parent_of(name) == server and int(name) != template:
                links = [os.readlink(f"/proc/{name}/fd/{one}") for one in os.listdir(f"/proc/{name}/fd")]
                if output in links:
                    found["supervisor"] = int(name)
    return found


def _attack(name, number):
    @harm("lives")
    def attack():
        os.kill(relatives()[name], number)
        time.sleep(0.3)

    HARMS[f"{signal.Signals(number).name}_to_{name}"] = HARMS.pop("attack")


for _name in ("zygote", "template", "server", "supervisor"):
    for _number in (signal.SIGKILL, signal.SIGTERM, signal.SIGSTOP):
        _attack(_name, _number)


# ---- moments -------------------------------------------------------------------------------------------------------


def in_signal_handler(do):
    """Do harm in a signal handler that runs while the simulator takes a step."""

    def handle(*_):
        do()

    signal.signal(signal.SIGALRM, handle)
    signal.setitimer(signal.ITIMER_REAL, 0.01)


def in_thread(do):
    def work():
        threading.excepthook = lambda *_: None
        do()

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(0.5)


def in_child(do):
    child = os.fork()
    if child == 0:
        try:
            do()
        finally:
            os._exit(0)
    until = time.monotonic() + 0.5
    while time.monotonic() < until and os.waitpid(child, os.WNOHANG)[0] == 0:
        time.sleep(0.005)


class Agent:
    """Does harm when it is told to: ``when`` is a moment of `MOMENTS`."""

    def __init__(self, what="", when="", **_):
        self.when = when
        self.do = HARMS[what][1] if what else lambda: None
        if when == "constructor":
            self.do()

    def reset(self, seed):
        self.step = 0
        if self.when == "reset":
            self.do()

    def act(self, observation):
        self.step += 1
        if (self.when, self.step) in (("first act", 1), ("fifth act", 5)):
            self.do()
        if self.step == 5:
            around = {"signal handler": in_signal_handler, "thread": in_thread, "child": in_child}.get(self.when)
            if around is not None:
                around(self.do)
            elif self.when == "exit":
                atexit.register(self.do)
        return 5.0, 0

    def close(self):
        if self.when == "close":
            self.do()

    def __del__(self):
        if self.when == "finalizer":
            self.do()


MOMENTS = (
    "constructor", "reset", "first act", "fifth act", "close", "finalizer", "signal handler", "thread", "child", "exit"
)  # fmt: skip
