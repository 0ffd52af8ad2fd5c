"""Commits of a Git repository checked out in temporary work trees, and the environment in which their code is imported.

The user's own work tree does not change. Each temporary one has the token of this process in its name, and so has what
git writes about it in the repository. If this process is killed, a later command removes both.
"""

from __future__ import annotations

import os
import subprocess
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.base.git import environment_of_git
from crashhunt.base.processes import die_with
from crashhunt.base.temporary import temporary_beside, temporary_folder, this_process

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

__all__ = ["checked_out", "commit_of", "git", "import_environment", "run_to_end", "top_of"]


def top_of(folder: Path) -> Path:
    """Return the top of the work tree of a folder.

    Raises:
        CrashhuntError: it is in no work tree, or git cannot be run.
    """
    return Path(git(folder, "rev-parse", "--show-toplevel"))


def commit_of(folder: Path, revision: str) -> str:
    """Return the commit that a revision names, as 40 or 64 digits.

    Raises:
        UsageError: there is no such commit.
    """
    return git(folder, "rev-parse", "--verify", "--quiet", f"{revision}^{{commit}}", what=revision)


@contextmanager
def checked_out(top: Path, commit: str, *, purpose: str, name: str = "") -> Iterator[Path]:
    """Yield a temporary work tree of a repository with a commit, and remove it at the end.

    Args:
        top: of the user's work tree.
        commit: as `commit_of` returns it.
        purpose: first part of the name of the temporary folder, such as ``bisect``.
        name: last part of the name of the work tree, where this process has several at a time.

    Raises:
        CrashhuntError: git fails.
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
    """Return the environment variables with which code is imported from a work tree.

    Args:
        folder: in the work tree, from which modules are imported.
        tree: its top; modules in it and in its ``src`` are found as well.
    """
    places = dict.fromkeys(map(str, (folder, tree, tree / "src")))
    paths = [*places, *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**environment_of_git(), "PYTHONPATH": os.pathsep.join(paths), "PYTHONDONTWRITEBYTECODE": "1"}


def run_to_end(
    command: Sequence[str], folder: Path | None, environment: Mapping[str, str]
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end and return its output; if this process is killed, the command is killed too."""
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False,
        preexec_fn=partial(die_with, os.getpid()),
    )  # fmt: skip


def git(folder: Path, *words: str, what: str = "", skipped: bool = False) -> str:
    """Return git's output.

    Args:
        folder: of the repository.
        words: of the command.
        what: revision that the command resolves; the error names it.
        skipped: whether to return the output also if git ends with an error.

    Raises:
        UsageError: there is no such revision.
        CrashhuntError: git fails, or is not installed.
    """
    command: Sequence[str] = ["git", "-C", str(folder), *words]
    try:
        environment = {**environment_of_git(), "LC_ALL": "C"}
        done = run_to_end(command, None, environment)
    except OSError as error:
        raise CrashhuntError(f"git cannot be run: {error.strerror}", fix="install git") from None
    if done.returncode and not skipped:
        if what:
            raise UsageError(f"{what!r} is no commit of {folder}", fix="give a revision as git knows it")
        said = " ".join(done.stderr.split()) or f"git {words[0]} failed"
        raise CrashhuntError(said, fix="run it in the repository of the agent", where=str(folder))
    return done.stdout.strip()
