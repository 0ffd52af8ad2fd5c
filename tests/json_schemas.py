"""Checks what commands print with ``--json`` against the schema files that users get."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import jsonschema

import crashhunt
from crashhunt.cli._list import with_list

FOLDER = Path(crashhunt.__file__).parent / "guide" / "reference" / "schemas"


@functools.cache
def validator(name: str) -> Any:
    """The validator of a schema file."""
    return jsonschema.Draft202012Validator(json.loads((FOLDER / f"{name}.json").read_text()))


def schema_of(words: tuple[str, ...]) -> str:
    """The name of the schema of what a command prints."""
    words = tuple(with_list(words))
    return "-".join(words[:2]) if words[0] in ("corpus", "suite") else words[0]


def check_output(words: tuple[str, ...], out: str) -> None:
    """Fail where a command has printed an object that its schema refuses."""
    if "--json" not in words or not out.startswith("{"):
        return
    found = json.loads(out)
    checks = validator("error" if "error" in found else schema_of(words))
    problems = [f"{error.json_path}: {error.message[:200]}" for error in checks.iter_errors(found)]
    assert not problems, f"{words}: {problems}"
