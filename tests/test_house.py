"""The house rules that no linter knows; import-linter sees to the floors (see pyproject.toml)."""

from __future__ import annotations

import ast
from pathlib import Path

import crashhunt

ROOT = Path(crashhunt.__file__).parent


def private_imports(file: Path) -> list[str]:
    """The private modules and names that a file imports from outside its own package."""
    package = file.relative_to(ROOT).parts[0]
    found = []
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.ImportFrom) or node.module is None or not node.module.startswith("crashhunt."):
            continue
        _, *parts = node.module.split(".")
        names = [alias.name for alias in node.names if alias.name.startswith("_") and not alias.name.startswith("__")]
        if parts[0] != package and (names or any(part.startswith("_") for part in parts)):
            found.append(f"{file.relative_to(ROOT)}:{node.lineno} imports {node.module} {names}")
    return found


def test_nothing_private_is_imported_from_outside_its_package():
    # `crashhunt.errors` and `crashhunt.space` are names under which users import what lies in a package.
    files = [file for file in ROOT.rglob("*.py") if file.name not in ("errors.py", "space.py")]
    assert [line for file in files for line in private_imports(file)] == []


# What other libraries have in one version and not in another, or in one of their classes.
_OTHERS = ("plans/_plan.py", "recording/_schemas.py", "simulators/accelerator/", "simulators/highway/")


def asked_by_name(file: Path) -> list[str]:
    """Where a file asks whether something has an attribute, by a name that no type checker sees."""
    found = []
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name) or len(node.args) < 2:
            continue
        name = node.args[1].value if isinstance(node.args[1], ast.Constant) else None
        if node.func.id in ("getattr", "hasattr") and isinstance(name, str) and not name.startswith("__"):
            found.append(f"{file.relative_to(ROOT)}:{node.lineno} asks for {name!r}")
    return found


def test_optional_faculties_are_protocols():
    """Of simulators and agents see their ``_protocol.py``, and `crashhunt.base.faculties`."""
    files = [file for file in ROOT.rglob("*.py") if not str(file.relative_to(ROOT)).startswith(_OTHERS)]
    assert [line for file in files for line in asked_by_name(file)] == []
