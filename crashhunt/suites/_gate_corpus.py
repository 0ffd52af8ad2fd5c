"""The corpus that a gate runs with HEAD before its hunts."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.base.git import run_to_end
from crashhunt.corpus import find_cases
from crashhunt.plans import read_settings
from crashhunt.statistics import GateCase

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.suites._gate_versions import GateVersion

_DEFAULT_CORPUS = "crashes"  # as in the action `corpus`


def run_corpus(
    given: Path | None, folder: Path, head: GateVersion, *, environment: Mapping[str, str] | None, parallel: int,
    trusted: bool,
) -> tuple[GateCase, ...] | None:  # fmt: skip
    """Run the corpus cases of HEAD with HEAD's code, in a separate process; None if there is no corpus.

    Args:
        given: path of the corpus, relative to the folder; None for ``crashes`` of a commit, if it exists.
        folder: folder from which HEAD is imported.
        head: the version.
        environment: environment variables with which a commit is imported; None if HEAD is an agent.
        parallel: number of trials at a time.
        trusted: whether the corpus may run even if it is not trusted. That of a commit is trusted as its code is.

    Raises:
        UsageError: the corpus is not a folder, or this agent drives in none of its cases.
        CrashhuntError: the corpus cannot be run.
    """
    if environment is None and given is None:
        return None
    corpus = folder / (given or _DEFAULT_CORPUS)
    try:
        if not corpus.is_dir():
            raise UsageError(f"--corpus {given} is not a folder in HEAD", fix="give a folder that HEAD contains")
        cases = find_cases([corpus])
    except CrashhuntError:
        if given is None:
            return None
        raise
    if environment is None:
        drivers = set(head.agents.values())
        cases = [case for case in cases if drivers & _drivers_of(case)]
        if not cases:
            message = f"--corpus {given} has no case in which the agent {head.word} drives"
            raise UsageError(message, fix="omit --corpus, or give a corpus with crashes of this agent")
    command = [sys.executable, "-P", "-m", "crashhunt", "corpus", "run", *map(str, cases), "--json"]
    command += ["--parallel", str(parallel)]
    if trusted or environment is not None:
        command.append("--trust")
    done = run_to_end(command, folder, dict(os.environ if environment is None else environment))
    try:
        reports = json.loads(done.stdout)["cases"]
        return tuple(
            GateCase(name=Path(one["path"]).name, expected=one["expected"], got=one["got"], now=one.get("now", ""))
            for one in reports
        )
    except (ValueError, KeyError, TypeError):
        said = " ".join(done.stderr.split())[-300:].removeprefix("crashhunt: ")
        raise CrashhuntError(f"the corpus of HEAD cannot be run: {said}", fix="see crashhunt corpus run") from None


def _drivers_of(case: Path) -> set[str]:
    try:
        return {chosen.agent for chosen in read_settings(case / layout.HUNT).agents.values()}
    except CrashhuntError:
        return set()
