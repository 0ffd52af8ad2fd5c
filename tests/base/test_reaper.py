"""The reaper of a process: it resumes what another process stops, and forwards how its module ended."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from crashhunt.base.processes import children_of
from crashhunt.base.reaper import Kept


def test_keeper_resumes_what_it_keeps_after_a_stop_from_outside(tmp_path):
    (tmp_path / "waits.py").write_text("import time\ndef main():\n    time.sleep(60)\n")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    kept = Kept("waits", environment=environment, stdin=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60
        while not (children := children_of(kept.process.pid)):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        stat = Path(f"/proc/{children[0]}/stat")
        os.kill(children[0], signal.SIGSTOP)
        while stat.read_bytes().rpartition(b")")[2].split()[0] != b"T":
            assert time.monotonic() < deadline
        while stat.read_bytes().rpartition(b")")[2].split()[0] == b"T":
            assert time.monotonic() < deadline, "it was not resumed"
            time.sleep(0.01)
    finally:
        kept.end()


def test_missing_module_of_a_snapshot_ends_its_process(tmp_path):
    (tmp_path / "imports.py").write_text("import no_such_library\ndef main(): pass\n")
    kept = Kept("imports", environment={**os.environ, "PYTHONPATH": str(tmp_path)}, stdin=subprocess.DEVNULL)
    try:
        assert kept.process.wait(60) == 1
    finally:
        kept.end()


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.nightly)])
def test_signal_of_a_terminal_does_not_end_a_reaper_while_its_python_starts(tmp_path, number):
    (tmp_path / "waits.py").write_text("import time\ndef main():\n    time.sleep(0.3)\n")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    with ExitStack() as started:
        keeps = []
        for attempt in range(8):
            keeps.append(Kept("waits", environment=environment, stdin=subprocess.DEVNULL))
            started.callback(keeps[-1].end)
            time.sleep(attempt * 0.01)  # Python needs 10 to 80 ms to start
            os.kill(keeps[-1].process.pid, number)
        assert [kept.process.wait(60) for kept in keeps] == [0] * 8


def test_kept_process_handles_signals_of_a_terminal(tmp_path):
    (tmp_path / "tells.py").write_text(
        "import signal, sys\n"
        "def main():\n"
        "    handled = signal.getsignal(signal.SIGINT) is signal.default_int_handler\n"
        "    sys.exit(7 if handled and not signal.pthread_sigmask(signal.SIG_BLOCK, ()) else 1)\n"
    )
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    kept = Kept("tells", environment={**os.environ, "PYTHONPATH": str(tmp_path)}, stdin=subprocess.DEVNULL)
    try:
        assert kept.process.wait(60) == 7
        assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == blocked
    finally:
        kept.end()
