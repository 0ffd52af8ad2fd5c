from __future__ import annotations

import ast
import importlib
import inspect
import json
import pkgutil
import tomllib
from pathlib import Path

import pytest

import crashhunt

MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(crashhunt.__path__, "crashhunt.")
    if not module.name.endswith("__main__")
)


@pytest.mark.parametrize("name", MODULES)
def test_what_a_module_offers_is_documented(name):
    if name.startswith("crashhunt.agents.planners."):  # needs the planner, which no test environment has
        pytest.importorskip(name, exc_type=ModuleNotFoundError)
    module = importlib.import_module(name)
    own = [attribute for attribute, value in vars(module).items() if getattr(value, "__module__", "") == name]
    for attribute in {*own, *getattr(module, "__all__", ())}:
        value = getattr(module, attribute)  # a name that a package offers and that leads nowhere fails here
        if not attribute.startswith("_") and (inspect.isclass(value) or inspect.isfunction(value)):
            assert inspect.getdoc(value), f"{name}.{attribute} has no docstring"


DOORS = [crashhunt.__file__, *(str(file) for file in sorted(Path(crashhunt.__file__).parent.rglob("*/__init__.py")))]


@pytest.mark.parametrize("file", [file for file in DOORS if "offer_lazily" in Path(file).read_text()])
def test_a_package_offers_at_run_time_what_type_checkers_see(file):
    tree = ast.parse(Path(file).read_text())
    [block] = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    seen = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        for alias in node.names:
            assert alias.asname == alias.name, "is private for type checkers"
            seen[alias.name] = node
    name = ".".join(("crashhunt", *Path(file).relative_to(Path(crashhunt.__file__).parent).parent.parts))
    package = importlib.import_module(name)
    assert package.__all__ == sorted(seen)
    assert dir(package) == sorted(seen)
    assert not hasattr(package, "a_name_that_it_lacks")


def test_entry_points_stay_as_they_are():
    """A crashhunt of a bundle finds its simulators by the entry points of the installed one: add, and never change."""
    tests = Path(__file__).parent
    points = tomllib.loads((tests.parent / "pyproject.toml").read_text())["project"]["entry-points"]
    frozen = json.loads((tests / "golden" / "entry_points.json").read_text())
    assert {group: {**points.get(group, {}), **targets} for group, targets in frozen.items()} == {
        group: points.get(group, {}) for group in frozen
    }
