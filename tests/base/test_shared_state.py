"""A fork has open files and memory of its own."""

from __future__ import annotations

import fcntl
import gc
import mmap
import multiprocessing
import os
import socket
import tempfile
from pathlib import Path

import pytest

from crashhunt.base.shared_state import SharedState


def in_fork(work):
    """What a function returns in a fork that has separated itself."""
    shared = SharedState(known={0, 1, 2})
    receive, send = os.pipe()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            shared.separate()
            os.write(send, repr(work()).encode())
            code = 0
        finally:
            os._exit(code)
    os.close(send)
    with os.fdopen(receive) as pipe:
        said = pipe.read()
    assert os.waitpid(child, 0)[1] == 0
    return said


def test_position_and_flags_of_an_open_file_are_the_forks_own(tmp_path):
    (tmp_path / "file").write_text("0123456789")
    with (tmp_path / "file").open("r+b", buffering=0) as file:
        file.seek(3)

        def move():
            flags = fcntl.fcntl(file, fcntl.F_GETFL)
            fcntl.fcntl(file, fcntl.F_SETFL, flags | os.O_NONBLOCK)
            return file.read(2), file.tell(), file.write(b"x")

        assert in_fork(move) == "(b'34', 5, 1)"
        assert (file.tell(), fcntl.fcntl(file, fcntl.F_GETFL) & os.O_NONBLOCK) == (3, 0)
        assert in_fork(lambda: file.read()) == "b'34x6789'"  # what is written to a file with a name stays
        assert not os.get_inheritable(file.fileno())


def test_content_of_a_file_without_a_name_is_the_forks_own():
    with tempfile.TemporaryFile() as file:
        file.write(b"before")
        file.flush()

        def write():
            file.seek(0)
            file.write(b"after!")
            file.flush()
            file.seek(0)
            return file.read()

        assert in_fork(write) == "b'after!'"
        file.seek(0)
        assert file.read() == b"before"


def test_shared_memory_is_the_forks_own_and_shared_with_forks_of_it():
    mapped, value = mmap.mmap(-1, 5000), multiprocessing.Value("i", 7)
    mapped[4999] = 5

    def change():
        before = mapped[4999], value.value
        if (child := os.fork()) == 0:
            mapped[4999], value.value = 6, 8
            os._exit(0)
        os.waitpid(child, 0)
        return before, (mapped[4999], value.value)

    assert in_fork(change) == "((5, 7), (6, 8))"
    assert (mapped[4999], value.value) == (5, 7)


def test_mapping_of_a_file_with_a_name_stays_shared(tmp_path):
    (tmp_path / "file").write_bytes(bytes(100))
    with (tmp_path / "file").open("r+b") as file, mmap.mmap(file.fileno(), 100) as mapped:
        assert in_fork(lambda: mapped.__setitem__(0, 9)) == "None"
        assert mapped[0] == 9


def test_what_is_too_large_is_reported_and_stays_shared():
    gc.collect()  # what other tests have left open
    known = [int(file.name) for file in [*Path("/proc/self/fd").iterdir()] if file.exists()]
    if before := SharedState(known).remaining:
        pytest.skip(f"this process shares {before} already")
    with mmap.mmap(-1, 17 << 20) as mapped:
        assert SharedState(known).remaining == "shared memory of 17 MB"
        assert in_fork(lambda: mapped.__setitem__(0, 9)) == "None"
        assert mapped[0] == 9
    with tempfile.TemporaryFile() as file:
        file.truncate(18 << 20)
        assert SharedState(known).remaining == "a file without a name of 18 MB"
    assert SharedState(known).remaining == ""


def test_file_that_was_closed_since_is_no_obstacle(tmp_path):
    (tmp_path / "file").write_text("x")
    file = (tmp_path / "file").open()
    shared = SharedState()
    file.close()
    shared.separate()


def test_pipes_and_sockets_of_modules_are_reported(monkeypatch):
    monkeypatch.setattr(SharedState, "_add_mapping", lambda *_: None)  # memory that other tests have mapped as shared
    assert SharedState(known=range(1000)).remaining == ""
    receive, send = os.pipe()
    first, second = socket.socketpair()
    with first, second:
        others = set(range(1000)) - {receive, send}
        assert SharedState(known=others).remaining == "a pipe"
        assert SharedState(known=others | {receive, send}).remaining == ""
        assert SharedState(known=set(range(1000)) - {first.fileno()}).remaining == "a socket"
    os.close(receive)
    os.close(send)
