from __future__ import annotations

import importlib
import inspect
import pkgutil

import pytest

import crashhunt

MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(crashhunt.__path__, "crashhunt.")
    if not module.name.endswith("__main__")
)


@pytest.mark.parametrize("name", MODULES)
def test_what_a_module_offers_is_listed_and_documented(name):
    module = importlib.import_module(name)
    offered = module.__all__  # Ruff sorts it
    for attribute in offered:
        value = getattr(module, attribute)  # an entry that leads nowhere fails here
        if inspect.isclass(value) or inspect.isfunction(value):
            assert inspect.getdoc(value), f"{name}.{attribute} has no docstring"
    if not any(part.startswith("_") for part in name.split(".")):
        mine = {
            attribute
            for attribute, value in vars(module).items()
            if not attribute.startswith("_")
            and (inspect.isclass(value) or inspect.isfunction(value))
            and value.__module__ == name
        }
        assert mine <= set(offered), f"{name} has public names that it does not list"
