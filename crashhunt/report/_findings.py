"""A kind of crashes as something to be told at a place in the agent's code: for reviews, alerts and summaries."""

from __future__ import annotations

import ast
import hashlib
import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePath
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.text import one_line
from crashhunt.snapshots import Snapshot
from crashhunt.triage import own_frames

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.crashes import Bundle
    from crashhunt.triage import Group, Signature

__all__ = ["Finding", "findings_of"]


@dataclass(frozen=True, slots=True)
class Finding:
    """A kind of crashes, and where to tell it.

    Args:
        rule: the outcome, such as ``collision``.
        title: of the kind.
        message: what happened in the shortest example, and how to look at it.
        file: the agent's, relative to its project; empty where nobody knows.
        line: of the file, from 1: that of the failure, else the one in which the agent is defined.
        fingerprint: the same for the same kind, whenever it is found.
        known: the case of a corpus that is the same; empty for none.
        group: the crashes.
    """

    rule: str
    title: str
    message: str
    file: str
    line: int
    fingerprint: str
    known: str
    group: Group


def findings_of(groups: Sequence[Group], known: Mapping[Signature, str] | None = None) -> list[Finding]:
    """Return the kinds of crashes, in the order of their groups; no code of theirs is run.

    Args:
        groups: of the crashes.
        known: the cases of a corpus by kind.
    """
    found = []
    for group in groups:
        example = group.shortest
        file, line = _place(example)
        count = "1 crash" if group.count == 1 else f"{group.count} crashes"
        fault = f" At fault: {group.fault}." if group.fault not in ("", "nobody can tell") else ""
        message = f"{example.result.summary}.{fault} {count}; look at it: crashhunt show {example.path}"
        found.append(
            Finding(
                group.signature.outcome, one_line(str(group.signature)), one_line(message), file, line,
                _fingerprint(group.signature), (known or {}).get(group.signature, ""), group,
            )
        )  # fmt: skip
    return found


def _fingerprint(signature: Signature) -> str:
    return hashlib.blake2b(json.dumps(signature.to_json(), sort_keys=True).encode(), digest_size=16).hexdigest()


def _place(bundle: Bundle) -> tuple[str, int]:
    """Where in the agent's project to tell of a crash."""
    failure = bundle.result.failure
    for frame in own_frames(failure) if failure is not None else ():
        if name := _in_project(frame.file):
            return name, frame.line
    return _definition(bundle.hunt / layout.SNAPSHOTS / bundle.snapshot, bundle.driver)


@cache
def _definition(snapshot: Path, driver: str) -> tuple[str, int]:
    """Where the class or function is that drives."""
    kept = Snapshot(snapshot)
    try:
        agents = kept.settings().agents
        module, _, attribute = agents[driver or next(iter(agents))].agent.partition(":")
        for root in kept.code:
            for file in (
                Path(root, *module.split(".")).with_suffix(".py"),
                Path(root, *module.split("."), "__init__.py"),
            ):
                if file.is_file() and (name := _in_project(file)):
                    return name, _line_of(file, attribute)
    except (CrashhuntError, OSError, ValueError, KeyError, StopIteration):
        pass
    return "", 1


def _line_of(file: Path, attribute: str) -> int:
    for node in ast.parse(file.read_bytes()).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == attribute:
            return node.lineno
    return 1


def _in_project(file: PurePath) -> str:
    """The name of a file in the project that it is of: of a snapshot's, where it was; empty where it is of none."""
    parts = file.parts
    for place in range(len(parts) - 1, 2, -1):
        if parts[place - 1] == layout.CODE and parts[place - 3] == layout.SNAPSHOTS:
            if parts[place].startswith("@"):  # a work tree
                return "/".join(parts[place + 1 :])
            return "" if parts[place] == layout.PACKAGE.name else "/".join(parts[place:])
    here = Path.cwd()
    return file.relative_to(here).as_posix() if file.is_relative_to(here) else ""
