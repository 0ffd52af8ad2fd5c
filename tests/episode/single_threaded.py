"""A process of one thread whose forks answer questions of tests; a fork of the tests' own may have more threads."""

from __future__ import annotations

import atexit
import functools
import json
import os
import socket
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path

from crashhunt.executors import worker_environment

SCRIPTS = ("branching", "forcing", "forking")


@functools.cache
def _server():
    """Start the process, which imports once for all questions; return the connection and its lines."""
    ours, theirs = socket.socketpair()
    words = [sys.executable, __file__, str(theirs.fileno())]
    with theirs:
        process = subprocess.Popen(words, env={**os.environ, **worker_environment()}, pass_fds=(theirs.fileno(),))
    atexit.register(process.wait)
    atexit.register(ours.close)  # comes first
    return ours, ours.makefile()


def answer_of(script, what, folder):
    """Return what a script answers to a word."""
    connection, lines = _server()
    connection.sendmsg([json.dumps([script, what, str(folder)]).encode() + b"\n"])
    assert lines.readline() == "0\n", (folder / "said.txt").read_text()
    return json.loads((folder / "answer.json").read_text())


def wait_for_the_end_of(pid):
    """Wait until a process has ended; it may not have been reaped."""
    deadline = time.monotonic() + 60.0
    while goes_on(pid):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def goes_on(pid):
    """Whether a process has not ended; it may not have been reaped."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def _answer(script, what, folder):
    """Answer in this fork, whose only open files are its output and those of the script."""
    said = os.open(folder / "said.txt", os.O_WRONLY | os.O_CREAT)
    os.dup2(said, 1), os.dup2(said, 2), os.close(said)
    answer = import_module(script).ANSWERS[what](folder)
    (folder / "answer.json").write_text(json.dumps(answer))


def _serve(connection):
    for script in SCRIPTS:
        import_module(script)
    for line in connection.makefile():
        script, what, folder = json.loads(line)
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                os.close(connection.detach())
                _answer(script, what, Path(folder))
                code = 0
            except BaseException:
                sys.excepthook(*sys.exc_info())
            finally:
                os._exit(code)
        connection.sendall(f"{os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])}\n".encode())


if __name__ == "__main__":
    _serve(socket.socket(fileno=int(sys.argv[1])))
