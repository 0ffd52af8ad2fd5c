"""The processes that commands and keepers of tests are forked from, and what is installed for them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import pytest
import warm
from commands import state_of
from conftest import _commands, outdated_entry_points

from crashhunt.episode._failures import _contents_of

NOTHING = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


@pytest.fixture
def start_keeper(tmp_path):
    """Starts a process of an empty script."""
    script = tmp_path / "keeper.py"
    script.touch()
    words, environment = [sys.executable, "-P", str(script), "0"], {**os.environ, **_commands().warm._at_start}

    def start(server=None):
        server = server or _commands().warm
        return warm.Forked(server.control, words, env=environment, pass_fds=(), start_new_session=True, **NOTHING)

    return start


def test_servers_outlast_a_signal_to_the_group_of_the_session(toy):
    # `timeout 500 pytest` sends SIGTERM to the group. A hunt of the test ends as asked, and the next one of the same
    # test failed with "Broken pipe".
    toy.crashhunt("--version")
    for server in _commands().pids:
        for number in warm.OF_THE_GROUP:
            os.kill(server, number)
    run = ("run", "h", "1", "2", "20", "--scenario", "toy", "--arg", "speed=5", "--no-snapshot", "--json")
    assert toy.crashhunt(*run).json["outcomes"] == {"survived": 2}
    command = toy.begin("run", "h2", "1", "2", "20", "--scenario", "toy", "--set", "step_wall_s=5", "--no-snapshot")
    command.terminate()  # which a command itself heeds, even before it has begun
    assert command.wait(60) != 0
    command.communicate()


def test_abandoned_command_reports_where_its_threads_were(toy):
    command = toy.begin("dashboard", ".", "--no-browser", "--port", "0")
    while not any(os.fstat(file.fileno()).st_size for file in command._files) and command.poll() is None:
        time.sleep(0.01)  # until it serves, and says so
    command.abandon(error := ValueError())
    assert "most recent call first" in error.__notes__[0]
    assert "_dashboard.py" in error.__notes__[0]
    assert error.__notes__[0].endswith(("state: S", "state: R", "state: D"))
    assert command.poll() == -signal.SIGUSR1


def test_server_of_keepers_outlasts_a_killed_process_that_asked(start_keeper, monkeypatch):
    assert start_keeper().wait(60) == 0
    _, server = _commands().pids
    with monkeypatch.context() as patch:
        patch.setattr(warm.Process, "__init__", lambda self, words, reply: reply.close())  # as the kernel does
        os.kill(server, signal.SIGSTOP)
        while state_of(server) != "T":
            time.sleep(0.01)
        try:
            start_keeper()
        finally:
            os.kill(server, signal.SIGCONT)
    assert start_keeper().wait(60) == 0


def test_server_that_is_gone_is_no_broken_pipe_of_crashhunt(start_keeper):
    lost, kept = warm.Warm.start(os.environ)
    kept.kill()
    kept.wait()
    with lost.control, pytest.raises(RuntimeError, match="the process that the tests fork has ended"):
        start_keeper(lost)


CHANGES = {
    "nothing": lambda place, kind: [vars(place), place.function(), kind.method, kind()],
    "a function": lambda place, kind: setattr(place, "function", len),
    "another object": lambda place, kind: setattr(place, "number", 4),
    "a function less": lambda place, kind: delattr(place, "function"),
    "a function more": lambda place, kind: setattr(place, "another", len),
    "a method": lambda place, kind: setattr(kind, "method", len),
    "there and back": lambda place, kind: (setattr(kind, "method", len), setattr(kind, "method", kind.old)),
}


@pytest.mark.parametrize("change", CHANGES)
def test_fork_records_a_module_again_that_has_changed_since(change, monkeypatch):
    place = types.ModuleType("place")
    exec("number = 3\nfunction = lambda: 1\nclass Kind:\n    def method(self): pass\n    old = method\n", vars(place))
    recorded = []

    def record(name, module):
        recorded.append(name)
        return _contents_of(name, module)

    known = warm._Contents(place, _contents_of("place", place))
    monkeypatch.setitem(warm._contents, id(vars(place)), known)
    CHANGES[change](place, place.Kind)
    assert warm._contents_of(record, "place", place) == _contents_of("place", place)
    assert recorded == ([] if change == "nothing" else ["place"])
    assert set(known.found[1]) == {place.Kind}


def test_installation_with_other_entry_points_is_named(tmp_path):
    ours, other = Path(__file__).parents[1] / "pyproject.toml", tmp_path / "pyproject.toml"
    assert outdated_entry_points(ours) == []
    other.write_text(ours.read_text().replace(':ToySimulator"', ':AnotherSimulator"'))
    assert outdated_entry_points(other) == ["toy"]
