"""Finds the commit that introduced a crash: git bisect in a separate work tree, with the crash as the test."""

from __future__ import annotations

import json
import math
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.agent_locators import is_program
from crashhunt.base.codec import Serializable
from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.base.git import (
    ORIGIN_SCRIPT,
    BuildError,
    checked_out,
    clean_tree,
    commit_of,
    files_outside,
    git,
    import_environment,
    run_build,
    run_to_end,
    top_of,
)
from crashhunt.base.temporary import temporary_folder
from crashhunt.corpus._case_runs import Got
from crashhunt.corpus._cases import add_case
from crashhunt.plans import read_settings

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.crashes import Bundle

_BISECT_WORDS: dict[Got, str] = {"still": "bad", "fixed": "good", "changed": "skip", "cannot_run": "skip"}
_FIRST_BAD_COMMIT = re.compile(r"^([0-9a-f]{7,64}) is the first \S+ commit", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Bisected(Serializable):
    """The result of a bisection."""

    commit: str | None  # the first commit with the crash; None if revisions that cannot run make it ambiguous
    subject: str  # the subject line of the commit's message
    candidates: tuple[str, ...]  # the commits that may have introduced the crash, if the result is ambiguous
    tried: dict[str, Got]  # the tried revisions, each with the status of the crash


def bisect(
    bundle: Bundle,
    good: str,
    *,
    bad: str = "HEAD",
    folder: Path | None = None,
    watch: Callable[[str, Got, str], None] = lambda _revision, _got, _why: None,
    tell: Callable[[str], None] = lambda _: None,
    build: str = "",
    build_limit_s: float = math.inf,
) -> Bisected:
    """Find the commit of the agent's repository that introduced a crash.

    Revisions are checked out in a temporary work tree. The user's work tree does not change.

    Args:
        bundle: The crash.
        good: A revision without the crash.
        bad: A revision with the crash.
        folder: The folder inside the agent's repository from which the agent is imported; by default the current one.
        watch: Called with each tried revision, the status of the crash, and the reason why it cannot run.
        tell: Called with each warning.
        build: Command line that builds each revision in its work tree; empty for no build.
        build_limit_s: Maximum wall time of a build, in s.

    Raises:
        UsageError: A revision does not exist or has the wrong status, or the code does not come from the work tree.
        CrashhuntError: git reports an error.
    """
    folder = (folder or Path.cwd()).resolve()
    top = top_of(folder)
    ends = [commit_of(folder, name) for name in (good, bad)]
    settings = read_settings(bundle.hunt / layout.HUNT)
    modules = {
        agent.agent.partition(":")[0]
        for agent in settings.agents.values()
        if not agent.agent.startswith("crashhunt.") and not is_program(agent.agent)
    }
    with temporary_folder("bisect") as scratch, checked_out(top, ends[1], purpose="bisect") as tree:
        inside = tree / folder.relative_to(top)
        for name, values in settings.texts.items():
            for path in files_outside(values, (inside, scratch)):
                tell(f"every revision uses the same file: {path} ({name}), which the work tree does not contain")
        case = add_case(bundle, scratch / "corpus").case.path.resolve()
        revisions = _Revisions(
            case=case, folder=inside, tree=tree, modules=modules, build=build, build_limit_s=build_limit_s, watch=watch,
            tell=tell,
        )  # fmt: skip
        revisions.require("still", bad, "--bad")
        git(tree, "checkout", "--quiet", "--detach", ends[0])
        revisions.require("fixed", good, "--good")
        said = git(tree, "bisect", "start", ends[1], ends[0])
        judged = set()
        while not (found := _FIRST_BAD_COMMIT.search(said)) and "only 'skip'ped commits left" not in said:
            head = git(tree, "rev-parse", "HEAD")
            if head in judged:  # git proposes the same revision again if it finds no path
                raise _no_way(good, bad, head)
            judged.add(head)
            got = revisions.tried[head] if head in revisions.tried else revisions.run()[0]
            said = git(tree, "bisect", _BISECT_WORDS[got], skipped=True)
        commit = found[1] if found is not None else None
        return Bisected(
            commit=commit,
            subject=git(tree, "log", "-1", "--format=%s", commit) if commit is not None else "",
            candidates=() if commit is not None else tuple(re.findall(r"^[0-9a-f]{40,64}$", said, re.MULTILINE)),
            tried=revisions.tried,
        )


@dataclass
class _Revisions:
    """Runs the case of a crash with the revision that is checked out."""

    case: Path
    folder: Path
    tree: Path
    modules: set[str]
    build: str
    build_limit_s: float
    watch: Callable[[str, Got, str], None]
    tell: Callable[[str], None]
    tried: dict[str, Got] = field(default_factory=dict)

    def run(self) -> tuple[Got, str]:
        """Build the revision and run the case; return the status of the crash, and why the case cannot run."""
        revision = git(self.tree, "rev-parse", "HEAD")
        try:
            if self.build:
                name, limit_s = revision[:12], self.build_limit_s
                run_build(self.build, self.folder, None, limit_s=limit_s, name=name, tell=self.tell)
            got, why = _run(self.case, self.folder, self.tree, self.modules)
        except BuildError as error:
            got, why = "cannot_run", str(error)
        self.tried[revision] = got
        if self.build:
            clean_tree(self.tree)
        self.watch(revision, got, why)
        return got, why

    def require(self, expected: Got, revision: str, option: str) -> None:
        """Run the case, and refuse a revision with another status than the option demands."""
        got, why = self.run()
        if why:
            fix = "" if self.build else ", or --build COMMAND if the agent needs files that Git does not track"
            raise UsageError(f"{option} {revision} cannot run: {why}", fix=f"give another revision{fix}")
        if got != expected:
            message = f"{option} {revision}: there, the crash is {got.replace('_', ' ')}, and not {expected}"
            raise UsageError(message, fix="give another revision")


def _no_way(good: str, bad: str, parts: str) -> UsageError:
    """Return the error for revisions on two branches whose common ancestor already has the crash."""
    message = f"--good {good} is not before --bad {bad}: their common ancestor {parts[:12]} already has the crash"
    return UsageError(message, fix="give a --good revision before that ancestor")


def _run(case: Path, folder: Path, tree: Path, modules: set[str]) -> tuple[Got, str]:
    """Run a case with the code of a work tree, in a new process; return its status, and why it cannot run."""
    environment = import_environment(folder, tree)
    for module in sorted(modules):
        place = [sys.executable, "-P", "-c", ORIGIN_SCRIPT, module]
        found = run_to_end(place, folder, environment)
        origin = found.stdout.strip()
        if found.returncode == 0 and not Path(origin).resolve().is_relative_to(tree):
            raise UsageError(
                f"{module!r} is imported from {origin}, independent of the revision",
                fix="give --from FOLDER, the folder of the repository that contains the module",
            )
        if found.returncode != 0:
            last = found.stderr.strip().rpartition("\n")[2]
            return "cannot_run", f"{module!r} cannot be imported: {last}"
    command = [sys.executable, "-P", "-m", "crashhunt", "corpus", "run", str(case), "--json"]
    done = run_to_end(command, folder, environment)
    try:
        report = json.loads(done.stdout)["cases"][0]
        got: Got = report["got"]
    except (ValueError, KeyError, IndexError):
        raise CrashhuntError(
            f"the corpus case could not be run: {done.stderr.strip()[-300:]}",
            fix="run crashhunt corpus run to see the whole error",
        ) from None
    return got, str(report.get("now", "")) if got == "cannot_run" else ""
