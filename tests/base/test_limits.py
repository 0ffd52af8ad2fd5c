"""A resource limit that makes something fail is named, with how to raise it."""

from __future__ import annotations

import errno
import resource

import pytest

from crashhunt.base.errors import remedy
from crashhunt.base.resources import limit_behind
from crashhunt.cli import _explained
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
REMEDIES = [
    (OSError(errno.ENOSPC, "No space left on device"), DISK),
    (OSError(errno.EDQUOT, "Disk quota exceeded"), DISK),
    (PermissionError(errno.EACCES, "Permission denied", "hunt.toml"), DISK),
    (FileNotFoundError(errno.ENOENT, "No such file or directory", "hunt.toml"), FILE),
    (
        OSError(errno.EMFILE, "Too many open files"),
        "raise the limit on open files (ulimit -n), and run the same command again",
    ),
    (BrokenPipeError(errno.EPIPE, "Broken pipe"), ""),
    (ConnectionResetError(errno.ECONNRESET, "Connection reset by peer"), ""),
    (OSError("without a number"), ""),
]


@pytest.mark.parametrize(("error", "fix"), REMEDIES, ids=lambda one: type(one).__name__)
def test_only_what_a_disk_causes_is_blamed_on_the_disk(error, fix):
    assert remedy(error) == fix
