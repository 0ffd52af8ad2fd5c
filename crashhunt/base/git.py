"""Git: queries about a folder that ignore a hook's repository, temporary work trees, and builds of commits in them.

Git ignores most of the files that a build makes. They enter the index of the temporary work tree, so that a snapshot of
this tree contains them. The index of the user's own work tree does not change.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import tempfile
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.base.process_owners import this_process
from crashhunt.base.processes import running
from crashhunt.base.signals import describe_death
from crashhunt.base.temporary import temporary_beside, temporary_folder

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence


_TIMEOUT_S = 60

# Git sets these variables for its hooks and for `rebase --exec`, and they take precedence over `-C FOLDER`. They are
# the ones of `git rev-parse --local-env-vars` that name a repository or parts of it.
_REPOSITORY_VARIABLES = frozenset({
    "GIT_ALTERNATE_OBJECT_DIRECTORIES", "GIT_COMMON_DIR", "GIT_DIR", "GIT_GRAFT_FILE", "GIT_IMPLICIT_WORK_TREE",
    "GIT_INDEX_FILE", "GIT_OBJECT_DIRECTORY", "GIT_PREFIX", "GIT_SHALLOW_FILE", "GIT_WORK_TREE",
})  # fmt: skip


def _environment_of_git() -> dict[str, str]:
    """Return the environment variables of this process without those that name a repository."""
    return {name: value for name, value in os.environ.items() if name not in _REPOSITORY_VARIABLES}


def work_tree(folder: Path) -> Path | None:
    """Return the root of a folder's git work tree, with symbolic links resolved; None if there is none.

    Git refuses a work tree that belongs to another user. The result is then None as well.
    """
    found = query(folder, "rev-parse", "--show-toplevel")
    return Path(os.path.realpath(os.fsdecode(found.rstrip(b"\n")))) if found else None


def tracked_files(top: Path) -> frozenset[str]:
    """Return the names of all files that git tracks in a work tree, relative to its root, with ``/`` as separator."""
    found = git_directory(top)
    if found is None:
        return frozenset()
    try:
        status = (found / "index").stat()
    except OSError:
        return frozenset()
    return _tracked_files(top, (status.st_ino, status.st_size, status.st_mtime_ns))


@lru_cache(maxsize=4)
def _tracked_files(top: Path, _index: tuple[int, int, int]) -> frozenset[str]:
    """List the files that git tracks.

    The list is cached until git's index changes, because a corpus may have hundreds of cases.
    """
    found = query(top, "ls-files", "-z") or b""
    return frozenset(map(os.fsdecode, filter(None, found.split(b"\0"))))


def git_directory(top: Path) -> Path | None:
    """Return the folder of a work tree's repository, with symbolic links resolved; None if there is none."""
    found = query(top, "rev-parse", "--absolute-git-dir")
    return Path(os.path.realpath(os.fsdecode(found.rstrip(b"\n")))) if found else None


def query(folder: Path, *words: str) -> bytes | None:
    """Return the output of a git command that changes nothing; None if git or the repository is missing.

    The configuration of a repository may name programs, such as one that watches its files. None of them runs, except
    the filters of files that git compares.
    """
    safe = ("core.fsmonitor=false", f"core.hooksPath={os.devnull}")
    options = [word for setting in safe for word in ("-c", setting)]
    command = ["git", "--no-optional-locks", *options, "-C", str(folder), *words]
    try:
        done = subprocess.run(
            command, capture_output=True, stdin=subprocess.DEVNULL, check=False, timeout=_TIMEOUT_S,
            env=_environment_of_git(),
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


# Commits that are checked out in temporary work trees, and the environment in which their code is imported.
#
# The user's own work tree does not change. Each temporary one has the token of this process in its name, and so has
# what git writes about it in the repository. If this process is killed, a later command removes both.


def top_of(folder: Path) -> Path:
    """Return the root of the work tree that contains a folder.

    Raises:
        CrashhuntError: no work tree contains the folder, or git cannot be run.
    """
    return Path(git(folder, "rev-parse", "--show-toplevel"))


def commit_of(folder: Path, revision: str) -> str:
    """Return the commit that a revision names, as 40 or 64 hexadecimal digits.

    Raises:
        UsageError: the revision does not exist.
    """
    return git(folder, "rev-parse", "--verify", "--quiet", f"{revision}^{{commit}}", what=revision)


@contextmanager
def checked_out(top: Path, commit: str, *, purpose: str, name: str = "") -> Iterator[Path]:
    """Yield a temporary work tree with a commit of a repository, and remove it at the end.

    Args:
        top: root of the user's work tree.
        commit: digits of the commit, as `commit_of` returns them.
        purpose: first part of the temporary folder's name, such as ``bisect``.
        name: last part of the work tree's name, if this process has several work trees at a time.

    Raises:
        CrashhuntError: git reports an error.
    """
    # Git gives the name of the work tree to what it writes about it.
    token = f"crashhunt-{this_process().token}{f'-{name}' if name else ''}"
    known = Path(top, git(top, "rev-parse", "--git-common-dir")) / "worktrees" / token
    with temporary_folder(purpose) as scratch, temporary_beside(known, name=token):
        tree = scratch.resolve() / token
        git(top, "worktree", "add", "--detach", "--quiet", str(tree), commit)
        try:
            yield tree
        finally:
            git(top, "worktree", "remove", "--force", str(tree), skipped=True)


def import_environment(folder: Path, tree: Path) -> dict[str, str]:
    """Return the environment variables with which modules are imported from a work tree.

    Modules in the root of the work tree and in its ``src`` are found as well.
    """
    places = dict.fromkeys(map(str, (folder, tree, tree / "src")))
    paths = [*places, *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**_environment_of_git(), "PYTHONPATH": os.pathsep.join(paths), "PYTHONDONTWRITEBYTECODE": "1"}


ORIGIN_SCRIPT = "import importlib.util, sys; print(importlib.util.find_spec(sys.argv[1]).origin)"
"""A program for another Python, which prints the file of the module that it is given, and does not import it."""


def run_to_end(
    command: Sequence[str], folder: Path | None, environment: Mapping[str, str]
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end and return its output; if this process is killed, the command is killed too."""
    with running(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        output, errors = child.communicate()
    return subprocess.CompletedProcess(command, child.returncode, output, errors)


def git(folder: Path, *words: str, what: str = "", skipped: bool = False) -> str:
    """Run a git command in a folder, and return its output.

    ``what`` is the revision that the command resolves, for the error message. With ``skipped``, the output is returned
    even if git reports an error.

    Raises:
        UsageError: the revision does not exist.
        CrashhuntError: git reports an error, or is not installed.
    """
    command: Sequence[str] = ["git", "-C", str(folder), *words]
    try:
        environment = {**_environment_of_git(), "LC_ALL": "C"}
        done = run_to_end(command, None, environment)
    except OSError as error:
        raise CrashhuntError(f"git cannot be run: {error.strerror}", fix="install git") from None
    if done.returncode and not skipped:
        if what:
            raise UsageError(
                f"{what!r} is not a commit of the repository {folder}",
                fix="give a branch, a tag or a commit of this repository",
            )
        said = " ".join(done.stderr.split()) or f"git {words[0]} failed"
        raise CrashhuntError(said, fix="run the command in the repository of the agent", where=str(folder))
    return done.stdout.strip()


# Builds of commits: the command, its output, its time limit, and the files that it makes.

_QUIET_S = 3.0  # before a note on what takes so long
_MAX_LINES, _MAX_CHARACTERS = 3, 300  # of the output in an error
_COMPILER_ERROR = re.compile(r"\berror(\[\w+\])?: ")  # of gcc, clang and rustc
# A pipe that ends with this process, also if it is killed, lets a shell kill the group of the build.
_RUN_BUILD = 'exec 3<&0; (read -r _ <&3; kill -KILL 0) & exec /bin/sh -c "$1" 3<&- </dev/null'


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
    """Run the command that builds a commit; the time limit and the end of this process end all its processes.

    The output goes to ``log``; without it to a temporary file, which stays only if the build fails. ``tell`` is called
    with a note if the build takes more than some seconds.

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
            ["/bin/sh", "-c", _RUN_BUILD, "sh", command], cwd=folder, env=_environment_of_git(),
            stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT, start_new_session=True,
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
            process.communicate()
            if not how and log is None:
                kept.unlink(missing_ok=True)
    if how:
        lines = kept.read_bytes().decode("utf-8", "replace").splitlines()
        said = [" ".join(line.split()) for line in lines if line.strip()]
        errors = " | ".join(filter(_COMPILER_ERROR.search, said))[:_MAX_CHARACTERS]
        shown = errors or " | ".join(said[-_MAX_LINES:])[-_MAX_CHARACTERS:] or "no output"
        raise BuildError(f"--build {command!r} {how}: {shown}", fix=f"{kept} has its whole output", where=name)


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
