"""A broken pipe ends a command with 141 only where the reader of its output has gone."""

from __future__ import annotations

import errno
import os
import subprocess
import sys

import pytest

from crashhunt.cli._common import unwritable_output
from crashhunt.cli._run import _of_output, _OutputClosedError
from crashhunt.errors import CrashhuntError

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
        assert (done.returncode, done.stderr) == (141, "")


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


SAYS_NO = """
import sys
from crashhunt import cli
from crashhunt.cli._common import make_console

cli._run = lambda _: [make_console(stderr="stderr" in sys.argv).print("worse"), 1][1]
cli.main([])
"""


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_unread_answer_is_neither_yes_nor_no(stream):
    reader, output = os.pipe()
    os.close(reader)
    streams = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, stream: output}
    done = subprocess.run([sys.executable, "-c", SAYS_NO, stream], **streams, check=False)
    os.close(output)
    assert done.returncode == 141


@pytest.mark.parametrize(
    ("raised", "wanted"),
    [
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), None),
        (
            OSError(errno.ENOSPC, "No space left on device"),
            r"standard error \(.+\) cannot be written: No space left on",
        ),
    ],
)
def test_hunt_does_not_blame_its_directory_for_its_output(raised, wanted):
    def watch(_):
        raise raised

    show = _of_output(watch, 2)
    with pytest.raises(_OutputClosedError if wanted is None else CrashhuntError, match=wanted):
        show(None)
    assert not issubclass(_OutputClosedError, Exception)  # else the ledger of the hunt would call it its failure


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.ENOSPC, "(/dev/full) cannot be written: No space left on device; free some space or redirect "),
        (errno.EBADF, "(/dev/full) cannot be written: Bad file descriptor; redirect "),
    ],
)
def test_error_of_output_names_the_file_behind_it(number, said):
    with open("/dev/full", "w") as full:
        kept = os.dup(2)
        os.dup2(full.fileno(), 2)
        try:
            error = unwritable_output(OSError(number, os.strerror(number)), 2)
        finally:
            os.dup2(kept, 2)
            os.close(kept)
    assert str(error) == f"standard error {said}standard error to another file, and run the same command again"


def test_interrupt_before_a_hunt_is_reported_even_if_the_disk_is_full():
    script = "from crashhunt.cli._run import _leave_at_once\n_leave_at_once(as_json=True)"
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-c", script]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "crashhunt: interrupted before the hunt began\n")
