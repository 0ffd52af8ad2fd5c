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


SHOWS = """
import os, subprocess, sys
from crashhunt import cli

def show(_):
    with open(sys.argv[1], "w") as file:
        subprocess.run(["/bin/sh", "-c", "echo from a child; echo from a child >&2"], check=True)
        print("to people", file=sys.stderr)
        for place in map("/proc/self/fd/{}".format, range(3)):
            print(os.path.exists(place) and os.readlink(place), file=file)
    return 0

cli._run = show
cli.main([])
"""


@pytest.mark.parametrize("closed", ["2>&-", "<&- >&-", "<&- >&- 2>&-"])
def test_no_file_takes_the_descriptor_of_a_closed_standard_stream(tmp_path, closed):
    file = tmp_path / "file"
    command = ["/bin/sh", "-c", f'exec "$0" -c "$1" "$2" {closed}', sys.executable, SHOWS, file]
    done = subprocess.run(command, stdin=subprocess.PIPE, capture_output=True, text=True, check=False)
    names = [name for name in ("<&-", ">&-", "2>&-") if name in closed.split()]
    shown = file.read_text().splitlines()
    assert done.returncode == 0
    assert [shown[("<&-", ">&-", "2>&-").index(name)] for name in names] == ["/dev/null"] * len(names)
    assert len(shown) == 3  # nothing else has been written into the file
    assert done.stdout == ("" if ">&-" in names else "from a child\n")
