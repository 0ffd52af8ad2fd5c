"""Golden files: what commands and simulators gave before, kept in ``tests/golden/``.

A refactoring must leave these files as they are. ``CRASHHUNT_GOLDEN=write`` writes them anew, after a change that is
meant to change them: ``CRASHHUNT_GOLDEN=write scripts/test -m "nightly or not nightly" tests/e2e/test_golden.py``.
"""

from __future__ import annotations

import difflib
import json
import os
import platform
import re
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

from crashhunt.base.integrity import digest_of_data
from crashhunt.snapshots import processor, vector_extension

ROOT = Path(__file__).parents[1]
GOLDEN = ROOT / "tests" / "golden"
WRITE = os.environ.get("CRASHHUNT_GOLDEN") == "write"
_LINE = 320  # letters of a line of JSON at most, where an object fits into it
_ACCEPT = 'CRASHHUNT_GOLDEN=write scripts/test -m "nightly or not nightly" tests/e2e/test_golden.py'
_LONGEST_DIFF = 80  # lines; the first of them say what has changed

# Numbers that depend on the machine's load, and words that depend on where and when a command ran.
_CHANGING = {
    "authentication_code", "bytes", "crashhunt", "created", "created_utc", "fingerprint", "host", "hostname",
    "integrity", "libraries", "libsumo", "machine", "made_utc", "newest_kind_s", "numpy", "origin", "per_second", "pid",
    "python", "rate_per_s", "saved_utc", "seconds_left", "snapshot", "started", "started_utc", "thread", "traceback",
    "trusted_at", "versions", "wall_s", "warnings",
}  # fmt: skip
_SNAPSHOT = re.compile(r"\b[0-9a-f]{16}\b")
_CODE_LINE = re.compile(r"\.py:\d+")
# Sentences for people: their wording is no interface, and a golden file must not change where only a message does.
_PROSE = {"detail", "fix", "help", "message", "notes", "reason", "summary", "title", "words"}
_MANY_WORDS = 4
_ROWS = 15  # of a longer list of objects, the first and the last are written, and a digest of all


def compare_golden(name: str, found: str) -> None:
    """Compare a text with the golden file of that name, or write it there.

    Raises:
        pytest.fail.Exception: they differ; the message is a diff and the command that accepts the new text.
    """
    path = GOLDEN / name
    if WRITE:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(found, encoding="utf-8")
        return
    expected = path.read_text(encoding="utf-8") if path.exists() else ""
    if found == expected:
        return
    diff = [*difflib.unified_diff(expected.splitlines(), found.splitlines(), f"golden/{name}", "now", lineterm="")]
    more = f"\n… and {len(diff) - _LONGEST_DIFF} lines more" if len(diff) > _LONGEST_DIFF else ""
    pytest.fail("\n".join(diff[:_LONGEST_DIFF]) + f"{more}\n\nIf that is meant: {_ACCEPT}", pytrace=False)


def compare_golden_json(name: str, found: object) -> None:
    """Compare data with a golden JSON file, as `compare_golden` does."""
    compare_golden(name, _laid_out(found) + "\n")


def _laid_out(value: Any, indent: str = "") -> str:
    """Return JSON text with a line for each object that fits into one: a diff then shows what an object was and is."""
    line = json.dumps(value, ensure_ascii=False)
    if len(line) + len(indent) <= _LINE or not isinstance(value, dict | list) or not value:
        return line
    inner = indent + " "
    if isinstance(value, dict):
        parts = [f"{json.dumps(name, ensure_ascii=False)}: {_laid_out(part, inner)}" for name, part in value.items()]
    else:
        parts = [_laid_out(part, inner) for part in value]
    first, last = "{}" if isinstance(value, dict) else "[]"
    return f"{first}\n" + ",\n".join(inner + part for part in parts) + f"\n{indent}{last}"


def read_golden(name: str) -> Any:
    """Return the data of a golden JSON file; skip the test where the files are being written."""
    if WRITE:
        pytest.skip("compares a part of a file that another test writes")
    return json.loads((GOLDEN / name).read_text(encoding="utf-8"))


def need_versions(name: str, *packages: str) -> dict[str, str]:
    """Return the versions behind a golden file of trials; skip the test where the installed ones are others.

    Another SUMO, highway-env or numpy may compute other traffic: then the digests of the file say nothing. So may
    another kind of processor, because numpy's sines, which highway-env uses, round differently on some of them, also
    where the extensions are the same.
    """
    found = {package: version(package) for package in packages} | {"machine": platform.machine()}
    if Path(name).parent.name == "trials" and "highway-env" in packages:
        found |= {"simd": vector_extension(), "processor": processor()}
    path = GOLDEN / name
    if not WRITE and path.exists():
        expected = json.loads(path.read_text(encoding="utf-8"))["versions"]
        if found != expected:
            pytest.skip(f"the golden file was made with {expected}, and here is {found}")
    return found


def need_python(minor: int) -> None:
    """Skip a test whose golden text argparse lays out, which other versions of Python do otherwise."""
    if sys.version_info[:2] != (3, minor):
        pytest.skip(f"argparse of Python 3.{minor} made the golden file")


def normalised(value: Any, folder: Path, *, key: str = "") -> Any:
    """Return JSON data without what differs between two runs of one command.

    Numbers and words that change become their type, and sentences ``<text>``. Floats keep nine digits: another
    processor's mathematical functions may differ in the last ones.

    Args:
        value: what a command printed.
        folder: in which it ran.
        key: under which the value stands.
    """
    if isinstance(value, dict):
        return {name: normalised(inner, folder, key=name) for name, inner in value.items()}
    if key in _CHANGING and value is not None:
        return f"<{type(value).__name__}>"
    if isinstance(value, list):
        found = [normalised(inner, folder, key=key) for inner in value]
        if len(found) <= _ROWS or not isinstance(found[0], dict):
            return found
        return [found[0], f"<{len(found)} in all, {digest_of_data(found)[:16]}>", found[-1]]
    if isinstance(value, float):
        return float(f"{value:.9g}")
    if isinstance(value, str):
        if key in _PROSE and value:
            return "<text>"
        text = (
            value.replace(str(folder), "<folder>")
            .replace(str(ROOT), "<crashhunt>")
            .replace(version("crashhunt"), "<version>")
        )
        if len(text.split()) >= _MANY_WORDS:
            return "<text>"
        return _CODE_LINE.sub(".py:<line>", _SNAPSHOT.sub("<snapshot>", text))
    return value
