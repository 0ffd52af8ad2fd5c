"""``crashhunt dashboard`` as a user runs it: its address, its end, and what it says of bad input."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
import threading
import urllib.request
from contextlib import suppress

import pytest
from conftest import crashes_on_loop
from served import served


def begun(shell, *words: str):
    """Start the command; return its process and what it says of its address."""
    process = shell.start("dashboard", *words, "--port", "0", "--json", "--no-browser")
    assert process.stdout is not None
    return process, json.loads(process.stdout.readline())


def fetched(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=60) as answer:
        return answer.read()


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.nightly)])
def test_it_prints_its_address_and_runs_until_it_is_stopped(shell, number):
    process, address = begun(shell)
    try:
        assert address["url"] == f"http://127.0.0.1:{address['port']}/"
        assert address["token"] == ""
        assert b"<title>Hunts" in fetched(address["url"])
        assert json.loads(fetched(f"{address['url']}api/hunts"))["hunts"] == []
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == (0 if number == signal.SIGINT else -signal.SIGTERM)
    assert out == ""
    assert err.splitlines() == [address["url"], "Ctrl-C ends the dashboard."]


NIGHTLY = pytest.mark.nightly  # by day, test_dashboard_folders.py, and cli/test_common.py has words for numbers


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nothing-here"], "'nothing-here' does not exist"),
        pytest.param(["--port", "70000"], "--port is 70000", marks=NIGHTLY),
        pytest.param(["--port", "-1"], "--port is -1", marks=NIGHTLY),
        pytest.param(["--port", "x"], "'x' is not a whole number", marks=NIGHTLY),
        (["--host", "no.such.host.invalid"], "--host 'no.such.host.invalid' is not known"),
        (["--host", "192.0.2.1", "--port", "0"], "cannot listen on 192.0.2.1"),
        pytest.param(["--host", "a" * 300], "is not known", marks=NIGHTLY),
        (["--token", "short"], "--token has 5 characters (allowed: at least 16"),
        (["--token", "with spaces in the text"], "printable ASCII without spaces"),
        (["faulty.py"], "faulty.py"),
    ],
)
def test_bad_input_is_one_line(shell, words, said):
    done = shell.crashhunt("dashboard", "--no-browser", *words, expect=2)
    (line,) = done.err.splitlines()
    assert said in line
    assert done.out == ""


@pytest.mark.parametrize("terminal", [True, pytest.param(False, marks=pytest.mark.nightly)])
def test_a_hunt_with_crashes_ends_with_the_command_on_a_terminal_only(toy, terminal):
    words = ("--scenario", "toy", "--arg", "speed=20", "--seed", "1", "--no-snapshot")
    reader, writer = pty.openpty() if terminal else os.pipe()
    toy.environment |= {"TERM": "xterm", "COLUMNS": "100"}
    shown = []

    def read():
        with suppress(OSError), open(reader, "rb", buffering=0) as screen:  # EIO when a terminal is closed
            while part := screen.read(65_536):
                shown.append(part)

    reading = threading.Thread(target=read)
    reading.start()
    toy.crashhunt("run", "my hunt", "1", "1", "99", *words, terminal=writer, streams=(1, 2))
    os.close(writer)
    reading.join(60)
    shown = b"".join(shown)
    assert b"000000-collision" in shown
    assert (b"Look at it: crashhunt dashboard 'my hunt'" in shown) is terminal


def test_other_commands_import_nothing_of_it(shell):
    script = (
        "import sys, crashhunt\n"
        "from crashhunt.cli import make_parser\n"
        "make_parser().format_help()\n"
        "print([name for name in sys.modules if name.split('.')[0] in ('starlette', 'uvicorn', 'plotly')"
        " or name.startswith('crashhunt.dashboard')])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"


@pytest.fixture
def exported(shell, made_once):
    """The archive of one crash."""
    made_once(crashes_on_loop, shell).crashhunt("export", "runs/one", "crash.zip")
    return shell.folder / "crash.zip"


def test_an_exported_crash_is_shown(exported):
    with served(exported) as dashboard:
        check_exported(dashboard.get)


def check_exported(get) -> None:
    (row,) = get("/api/hunts")["hunts"]
    assert (row["name"], row["exported"], row["damaged"]) == ("crash.zip", True, False)
    one = f"/api/hunts/{row['id']}"
    (crash,) = get(f"{one}/crashes")["crashes"]
    assert get(f"{one}/crashes/{crash['id']}")["steps"] > 0
    for what in ("", "/trials", "/map", "/importance"):
        get(one + what)
