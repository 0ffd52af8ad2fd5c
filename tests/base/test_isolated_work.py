"""Work in a fork of a command: programs that it starts end with it, however it ends."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from crashhunt.base.processes import is_alive, kill

if TYPE_CHECKING:
    from pathlib import Path

SCRIPT = """
import os, subprocess, sys, time
from crashhunt.base.isolation import work_apart

def work(report):
    started = subprocess.Popen(["sleep", "600"], start_new_session=True)
    with open(sys.argv[1] + ".new", "w") as file:
        file.write(str(started.pid))
    os.rename(sys.argv[1] + ".new", sys.argv[1])
    {does}
    return {{}}

work_apart(work, task="it fails", timeout_s={timeout_s})
"""


def begin(tmp_path: Path, does: str, timeout_s: float = 60.0) -> tuple[subprocess.Popen[str], int]:
    """Return a command that does some work apart, and the process that the work has started."""
    file, script = tmp_path / "started", SCRIPT.format(does=does, timeout_s=timeout_s)
    process = subprocess.Popen([sys.executable, "-c", script, file], stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not file.exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.005)
    return process, int(file.read_text())


def has_ended(pid: int) -> bool:
    deadline = time.monotonic() + 300
    while is_alive(pid):
        if time.monotonic() > deadline:
            kill(pid)
            return False
        time.sleep(0.005)
    return True


@pytest.mark.parametrize(
    ("does", "timeout_s", "says"),
    [
        ("os._exit(0)", 60.0, "it fails: its process exited with 0 meanwhile"),
        ("time.sleep(600)", 1.5, "it fails: its process took longer than 1.5 s meanwhile"),
        ("1 / 0", 60.0, "it fails: its process raised ZeroDivisionError"),
        ("pass", 60.0, ""),
    ],
)
def test_a_program_that_the_work_has_started_ends_with_the_work(tmp_path, does, timeout_s, says):
    process, started = begin(tmp_path, does, timeout_s)
    _, said = process.communicate(timeout=300)
    assert has_ended(started)
    assert says in said
    assert (process.returncode == 0) == (not says)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_program_that_the_work_has_started_ends_with_the_command(tmp_path, number):
    process, started = begin(tmp_path, "time.sleep(600)")
    process.send_signal(number)
    process.communicate(timeout=300)
    assert has_ended(started)


SERVER = """
import os, signal, sys
from crashhunt.base.isolation import ServerApart
from crashhunt.base.errors import PluginError, UsageError

def answer(request):
    if "leave" in request:
        os.fork() or signal.pause()  # a copy of it holds what it has inherited
        os._exit(0)
    if "wait" in request:
        os.read(os.pipe()[0], 1)
    if "refuse" in request:
        raise UsageError("no", fix="another")
    seen.append(request["say"])
    return {"pid": os.getpid(), "seen": seen}

seen = []
server = ServerApart(answer, task="it fails", fix="correct it", timeout_s=200.0)
first, second = server.ask({"say": 1}), server.ask({"say": 2})
assert first["pid"] == second["pid"] != os.getpid()
assert (second["seen"], seen) == ([1, 2], [])
for request, kind, says in (
    ({"refuse": 1}, UsageError, "no; another"),
    ({sys.argv[1]: 1}, PluginError, sys.argv[2]),
    ({"say": 3}, PluginError, "it fails: its process has ended; correct it"),
):
    if "wait" in request:  # all others may take as long as a loaded machine needs
        server._timeout_s = 0.5
    try:
        server.ask(request)
    except kind as error:
        assert says == str(error), str(error)
    else:
        raise AssertionError(request)
server.close()
"""


@pytest.mark.parametrize(
    ("does", "says"),
    [
        ("leave", "it fails: its process exited with 0 meanwhile; correct it"),
        ("wait", "it fails: it took longer than 0.5 s; correct it"),
    ],
)
def test_a_server_answers_until_its_process_ends(does, says):
    words = [sys.executable, "-c", SERVER, does, says]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stderr) == (0, "")
