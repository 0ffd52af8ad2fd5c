"""A resource limit that makes something fail is named, with how to raise it."""

from __future__ import annotations

import errno
import os
import resource
import sys
import threading

import pytest

from crashhunt import cli
from crashhunt.base.errors import remedy
from crashhunt.base.resources import error_of_next_files, limit_behind
from crashhunt.cli import _explained
from crashhunt.cli._run import _leave_at_once
from crashhunt.episode._blame import internal_error
from crashhunt.episode._failures import failure_of

MEMORY = (
    MemoryError(),
    OSError(errno.ENOMEM, "Cannot allocate memory"),
    RuntimeError("can't start new thread"),
    ImportError("libarrow.so: failed to map segment from shared object"),
)
OTHERS = (
    ValueError("can't start new thread"),
    RuntimeError("no thread"),
    OSError(errno.ENOSPC, "No space left on device"),
    ImportError("No module named 'x'"),
)


class UnsayableError(ImportError):
    def __str__(self):
        raise KeyboardInterrupt


@pytest.fixture
def limits(monkeypatch):
    """The limits that this process seems to have, in bytes."""
    found = {}
    infinite = resource.RLIM_INFINITY
    monkeypatch.setattr("resource.getrlimit", lambda which: (found.get(which, infinite), infinite))
    return found


@pytest.mark.parametrize("error", MEMORY, ids=repr)
def test_limit_on_memory_is_named_where_there_is_one(limits, error):
    assert limit_behind(error) == ""
    limits[resource.RLIMIT_FSIZE] = 1 << 20
    assert limit_behind(error) == ""
    limits[resource.RLIMIT_AS] = 1500 << 20
    assert limit_behind(error) == "the limit on memory is 1500 MiB: raise it with ulimit -v"


@pytest.mark.parametrize("message", ["can't start new thread", "unable to start watchdog thread"])
def test_limit_on_processes_is_named_if_no_thread_can_be_started(limits, message):
    limits[resource.RLIMIT_NPROC] = 10
    said = "the limit on processes and threads is 10: raise it with ulimit -u, or that of the container"
    assert limit_behind(RuntimeError(message)) == said
    assert str(_explained(RuntimeError(message))) == f"no thread could be started: RuntimeError; {said}"
    assert internal_error(RuntimeError(message), 3).fix == said
    assert limit_behind(ValueError(message)) == ""
    assert limit_behind(RuntimeError("failed to map segment")) == ""


def test_both_limits_that_prevent_threads_are_named(limits):
    limits |= {resource.RLIMIT_NPROC: 10, resource.RLIMIT_AS: 1500 << 20}
    said = str(_explained(RuntimeError("can't start new thread")))
    assert said.startswith("no thread could be started: RuntimeError; the limit on processes and threads is 10: ")
    assert said.endswith("; the limit on memory is 1500 MiB: raise it with ulimit -v")
    assert str(_explained(MemoryError())).startswith("the memory does not suffice: MemoryError; the limit on memory")


@pytest.fixture
def no_threads(monkeypatch):
    def start(_):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", start)


def interrupt(_):
    raise KeyboardInterrupt


@pytest.mark.parametrize("arguments", [["show"], ["run", "--json"]])
def test_interrupt_of_a_library_that_starts_no_thread_is_not_taken_for_ctrl_c(
    arguments, limits, no_threads, monkeypatch, capfd
):
    limits[resource.RLIMIT_NPROC] = 10
    monkeypatch.setattr(cli, "_run", interrupt)
    monkeypatch.setitem(_leave_at_once.__globals__, "_leave", sys.exit)
    with pytest.raises(SystemExit, match="2"):
        cli.main(arguments) if "show" in arguments else _leave_at_once(as_json=True)
    out, err = capfd.readouterr()
    assert err.startswith("crashhunt: no thread could be started")
    assert err.endswith(
        "; the limit on processes and threads is 10: raise it with ulimit -u, or that of the container\n"
    )
    assert ('"no thread could be started"' in out) == ("--json" in arguments)


def test_ctrl_c_stays_one_if_threads_start(monkeypatch, capfd):
    monkeypatch.setattr(cli, "_run", interrupt)
    monkeypatch.setitem(_leave_at_once.__globals__, "_leave", sys.exit)
    with pytest.raises(SystemExit, match="130"):
        cli.main(["show"])
    with pytest.raises(SystemExit, match="130"):
        _leave_at_once(as_json=False)
    assert capfd.readouterr().err == "crashhunt: interrupted before the hunt began\n"


def test_limit_on_open_files_is_named_where_there_is_one(limits):
    error = OSError(errno.EMFILE, "Too many open files")
    assert limit_behind(error) == ""
    limits[resource.RLIMIT_NOFILE] = 16
    assert limit_behind(error) == "the limit on open files is 16: raise it with ulimit -n"
    assert limit_behind(OSError(errno.ENFILE, "Too many open files in system")) == ""


def test_error_of_next_files_closes_what_it_opens(monkeypatch):
    opened = []

    def open_two(path, flags):
        if len(opened) == 2:
            raise OSError(errno.EMFILE, "Too many open files")
        opened.append(os.dup(1))
        return opened[-1]

    monkeypatch.setattr(os, "open", open_two)
    assert error_of_next_files(2) is None
    opened.clear()
    assert error_of_next_files(3).errno == errno.EMFILE
    for descriptor in opened:
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fstat(descriptor)


def test_limit_on_files_is_named_where_there_is_one(limits):
    error = OSError(errno.EFBIG, "File too large")
    limits[resource.RLIMIT_AS] = 1 << 20
    assert limit_behind(error) == ""
    limits[resource.RLIMIT_FSIZE] = 1 << 19
    assert limit_behind(error) == "the limit on the size of a file is 0.5 MiB: raise it with ulimit -f"


@pytest.mark.parametrize(
    "error", [*OTHERS, UnsayableError("failed to map segment")], ids=lambda one: type(one).__name__
)
def test_what_no_limit_has_caused_names_none(limits, error):
    limits |= {resource.RLIMIT_AS: 1 << 30, resource.RLIMIT_FSIZE: 1 << 30}
    assert limit_behind(error) == ""


def test_trial_that_failed_by_a_limit_states_so(limits):
    assert failure_of(MemoryError(), "ego").message == ""
    limits |= {resource.RLIMIT_AS: 1 << 30, resource.RLIMIT_FSIZE: 1 << 30}
    assert failure_of(MemoryError(), "ego").message == "the limit on memory is 1024 MiB: raise it with ulimit -v"
    said = failure_of(OSError(errno.EFBIG, "File too large"), "ego").message
    assert said == "[Errno 27] File too large (the limit on the size of a file is 1024 MiB: raise it with ulimit -f)"


DISK = "free some space or make the folder writable, and run the same command again"
FILE = "see to that file or folder, and run the same command again"
OPEN = "raise the limit on open files (ulimit -n), and run the same command again"
LARGE = "raise the limit on the size of a file (ulimit -f), and run the same command again"
MORE = "leave it more processes (ulimit -u) or memory (ulimit -v), and run the same command again"
REMEDIES = [
    *((number, DISK) for number in ("ENOSPC", "EDQUOT", "EIO", "EROFS", "EACCES", "EPERM")),
    *((number, OPEN) for number in ("EMFILE", "ENFILE")),
    *((number, MORE) for number in ("EAGAIN", "ENOMEM")),
    ("EFBIG", LARGE),
    *((number, "") for number in ("EPIPE", "ECONNRESET", "ENOENT")),
]


@pytest.mark.parametrize(("number", "fix"), REMEDIES)
def test_only_what_a_disk_causes_is_blamed_on_the_disk(number, fix):
    code = getattr(errno, number)
    assert remedy(OSError(code, "failed")) == fix
    assert remedy(OSError(code, "failed", "hunt.toml")) == (fix or FILE)
    assert remedy(OSError("without a number")) == ""
