"""Builds of commits in temporary work trees: the command, its output, its time limit, and the files that it makes.

Git ignores most of these files. They enter the index of the temporary work tree, so that a snapshot of this tree
contains them. The index of the user's own work tree does not change.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.git import environment_of_git, git
from crashhunt.base.processes import die_with
from crashhunt.base.signals import describe_death

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

_QUIET_S = 3.0  # before a note on what takes so long
_MAX_LINES, _MAX_CHARACTERS = 3, 300  # of the output in an error


class BuildError(CrashhuntError):
    """The build of a commit failed."""


def run_build(
    command: str,
    folder: Path,
    log: Path | None,
    *,
    limit_s: float,
    name: str,
    tell: Callable[[str], None] = lambda _: None,
) -> None:
    """Run the command that builds a commit; Ctrl-C and the time limit end all its processes.

    Args:
        command: command line for the shell.
        folder: folder of the work tree in which the command runs.
        log: file for the output; None for a temporary file, which stays only if the build fails.
        limit_s: time limit, in s.
        name: name of the built version, for messages.
        tell: function called with a note if the build takes more than some seconds.

    Raises:
        BuildError: the command failed, or took too long.
    """
    if log is None:
        handle, path = tempfile.mkstemp(prefix="crashhunt-build-", suffix=".log")
        os.close(handle)
        kept = Path(path)
    else:
        kept = log
    with kept.open("wb") as output:
        process = subprocess.Popen(
            command, shell=True, cwd=folder, env=environment_of_git(), stdin=subprocess.DEVNULL,
            stdout=output, stderr=subprocess.STDOUT, start_new_session=True, preexec_fn=partial(die_with, os.getpid()),
        )  # fmt: skip
        how = ""
        try:
            with suppress(subprocess.TimeoutExpired):
                process.wait(min(_QUIET_S, limit_s))
            if process.returncode is None and limit_s > _QUIET_S:
                tell(f"building {name}: {command}")
            if code := process.wait(max(0.0, limit_s - _QUIET_S)):
                how = describe_death(code)
        except subprocess.TimeoutExpired:
            how = f"still ran after {limit_s:g} s"
        finally:
            with suppress(ProcessLookupError):  # of the processes that it has started, too
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if not how and log is None:
                kept.unlink(missing_ok=True)
    if how:
        lines = kept.read_bytes().decode("utf-8", "replace").splitlines()
        said = [" ".join(line.split()) for line in lines if line.strip()]
        last = " | ".join(said[-_MAX_LINES:])[-_MAX_CHARACTERS:] or "no output"
        raise BuildError(f"--build {command!r} {how}: {last}", fix=f"{kept} has its whole output", where=name)


def track_built(tree: Path) -> None:
    """Add the names of all untracked files, including ignored files, to the index of a temporary work tree."""
    git(tree, "add", "--force", "--intent-to-add", "--", ".", skipped=True)


def clean_tree(tree: Path) -> None:
    """Remove what a build has made or changed in a temporary work tree."""
    git(tree, "reset", "--quiet", "--hard")
    git(tree, "clean", "-ffdxq", skipped=True)


def copy_built(tree: Path, place: Path) -> None:
    """Copy the files that a build has made or changed in a work tree to a folder, with their modes."""
    listed = git(tree, "ls-files", "-z", "--others", "--modified", "--deduplicate")
    place.mkdir()
    for name in filter(None, listed.split("\0")):
        if (source := tree / name).is_file() or source.is_symlink():
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, place / name, follow_symlinks=False)


def files_outside(values: Iterable[str], folders: Iterable[Path]) -> Iterator[str]:
    """Yield the values that name the same file for each of several folders, so that the file is in none of them."""
    places = list(folders)
    for value in values:
        with suppress(OSError, ValueError):
            found = {(folder / value).resolve() for folder in places}
            if len(found) == 1 and (path := found.pop()).is_file():
                yield str(path)
