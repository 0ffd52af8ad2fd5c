"""Processes of one thread that run a script of this folder for a test; a fork of the tests' own may have more."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

from crashhunt.executors import worker_environment


def answer_of(script, what, folder):
    """Return what a script answers to a word."""
    done = subprocess.run(
        [sys.executable, Path(__file__).with_name(script), what, folder],
        env={**os.environ, **worker_environment()}, capture_output=True, text=True, check=False, timeout=500,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


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
