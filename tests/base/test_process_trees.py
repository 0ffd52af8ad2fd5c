"""Trees of processes: which are found, ended, resumed and spared."""

from __future__ import annotations

import os
import signal
import subprocess
import traceback
from pathlib import Path

import pytest
from conftest import wait_for

from crashhunt.base import processes
from crashhunt.base.processes import (
    adopt_orphans,
    children_of,
    descendants_of,
    end_descendants,
    exits_refused,
    has_child,
    is_alive,
    resume,
    running,
)

TREE = "sleep 60 & setsid sh -c 'sleep 60 & sleep 60; :' & wait"


def state(pid: int) -> bytes:
    return Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()[0]


def in_child(function) -> None:
    """Call a function in a fork of its own process group, which must return."""
    pid = os.fork()
    if pid == 0:
        os.setpgrp()
        try:
            function()
            os._exit(0)
        except BaseException:
            traceback.print_exc()
            os._exit(1)
    assert os.waitpid(pid, 0)[1] == 0


def test_whole_tree_is_ended_but_for_what_is_spared():
    def ends():
        adopt_orphans()
        assert not has_child()
        end_descendants()
        spared, doomed = (subprocess.Popen(["sh", "-c", TREE]) for _ in range(2))
        wait_for(lambda: len(descendants_of(os.getpid())) == 10)
        kept, found = ({process.pid, *descendants_of(process.pid)} for process in (spared, doomed))
        assert (len(kept), len(found), set(children_of(os.getpid()))) == (5, 5, {spared.pid, doomed.pid})
        assert set(processes._children_by_search(os.getpid())) == {spared.pid, doomed.pid}
        end_descendants(frozenset({spared.pid}))
        assert {pid for pid in kept | found if is_alive(pid)} == kept
        os.kill(spared.pid, signal.SIGKILL)  # its children become orphans
        end_descendants()
        assert not any(map(is_alive, kept))
        assert not has_child()

    in_child(ends)


def test_only_a_stopped_process_is_resumed():
    with subprocess.Popen(["sleep", "60"]) as process:
        try:
            resume(process.pid)
            process.send_signal(signal.SIGSTOP)
            wait_for(lambda: state(process.pid) == b"T")
            resume(process.pid)
            wait_for(lambda: state(process.pid) == b"S")
        finally:
            process.kill()
    resume(process.pid)  # it does not exist any more
    assert children_of(process.pid) == []
    assert not is_alive(process.pid)
    assert is_alive(1)


def test_foreign_code_cannot_end_the_process_but_its_forks_end_themselves():
    leave = os._exit
    with exits_refused():
        with pytest.raises(SystemExit, match=r"os\._exit\(3\)"):
            os._exit(3)
        pid = os.fork()
        if pid == 0:
            os._exit(7)
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 7
    assert os._exit is leave


def test_process_whose_parent_is_another_ends_at_once():
    pid = os.fork()
    if pid == 0:
        processes.die_with(os.getpid())  # its parent is another
        os._exit(9)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 1


interrupted_forks: list[bool] = []


def interrupt_fork() -> None:
    if interrupted_forks:
        signal.raise_signal(signal.SIGINT)


os.register_at_fork(after_in_parent=interrupt_fork)


def test_ctrl_c_in_a_hook_around_the_fork_of_a_program_is_not_lost():
    interrupted_forks.append(True)
    try:
        with pytest.raises(KeyboardInterrupt), running(["sleep", "60"]):
            pass
    finally:
        interrupted_forks.clear()
