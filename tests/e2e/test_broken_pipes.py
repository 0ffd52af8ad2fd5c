"""A broken pipe ends a command with 0 only where the reader of its output has gone."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

FAILS = """
import sys
from crashhunt import cli

def fail(*_):
    raise BrokenPipeError(32, "Broken pipe")

cli._run = fail
cli.main(["list"])
"""


@pytest.mark.parametrize("has_reader", [True, False])
def test_broken_pipe_between_processes_is_an_error_and_one_of_the_output_is_not(has_reader):
    reader, output = os.pipe()
    if not has_reader:
        os.close(reader)
    done = subprocess.run([sys.executable, "-c", FAILS], stdout=output, stderr=subprocess.PIPE, text=True, check=False)
    os.close(output)
    if has_reader:
        os.close(reader)
        assert done.returncode == 2
        assert "this should not happen: BrokenPipeError" in done.stderr
        assert len(done.stderr.splitlines()) == 1
    else:
        assert (done.returncode, done.stderr) == (0, "")


def test_closed_output_is_no_error():
    script = "import sys\nfrom crashhunt import cli\ncli._run = lambda _: sys.stdout.write('1') - 1\ncli.main([])"
    command = ["/bin/sh", "-c", 'exec "$0" -c "$1" >&-', sys.executable, script]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
