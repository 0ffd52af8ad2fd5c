from __future__ import annotations

import ast
import importlib
import inspect
import json
import pkgutil
import tomllib
from pathlib import Path

import crashhunt


def test_what_a_module_offers_is_documented():
    undocumented = []
    for name in sorted(module.name for module in pkgutil.walk_packages(crashhunt.__path__, "crashhunt.")):
        if name.endswith("__main__"):
            continue
        try:
            module = importlib.import_module(name)
        except ModuleNotFoundError:
            assert name.startswith("crashhunt.agents.planners."), name  # which no test environment has
            continue
        own = [attribute for attribute, value in vars(module).items() if getattr(value, "__module__", "") == name]
        for attribute in {*own, *getattr(module, "__all__", ())}:
            value = getattr(module, attribute)  # a name that a package offers and that leads nowhere fails here
            if not attribute.startswith("_") and (inspect.isclass(value) or inspect.isfunction(value)):
                undocumented += [] if inspect.getdoc(value) else [f"{name}.{attribute}"]
    assert undocumented == []


def test_a_package_offers_at_run_time_what_type_checkers_see():
    root = Path(crashhunt.__file__).parent
    for file in root.rglob("__init__.py"):
        if "offer_lazily" not in (text := file.read_text()):
            continue
        tree = ast.parse(text)
        [block] = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
        assert all(isinstance(node, ast.ImportFrom) for node in block.body), file
        aliases = [alias for node in block.body for alias in node.names]
        assert [alias.name for alias in aliases if alias.asname != alias.name] == [], f"private in {file}"
        package = importlib.import_module(".".join(("crashhunt", *file.parent.relative_to(root).parts)))
        seen = sorted({alias.name for alias in aliases})
        assert (package.__name__, package.__all__, dir(package)) == (package.__name__, seen, seen)
        assert not hasattr(package, "a_name_that_it_lacks"), file


def test_entry_points_stay_as_they_are():
    """A crashhunt of a bundle finds its simulators by the entry points of the installed one: add, and never change."""
    tests = Path(__file__).parent
    points = tomllib.loads((tests.parent / "pyproject.toml").read_text())["project"]["entry-points"]
    frozen = json.loads((tests / "golden" / "entry_points.json").read_text())
    assert {group: {**points.get(group, {}), **targets} for group, targets in frozen.items()} == {
        group: points.get(group, {}) for group in frozen
    }
