"""How the compiled core gets into an installation, and that an installation never fails for it."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import types
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def hook(monkeypatch, tmp_path):
    """A hook of scripts/build_core.py; hatchling itself is not needed, nor is it part of a development environment."""
    interface = types.ModuleType("interface")
    interface.BuildHookInterface = object
    monkeypatch.setitem(sys.modules, "hatchling.builders.hooks.plugin.interface", interface)
    specification = importlib.util.spec_from_file_location("build_core", ROOT / "scripts" / "build_core.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    monkeypatch.setattr(module.tempfile, "mkdtemp", lambda **_: str(tmp_path))
    made = module.CoreHook()
    made.root, made.target_name = str(ROOT), "wheel"
    warnings = []
    made.app = types.SimpleNamespace(display_warning=warnings.append, warnings=warnings)
    monkeypatch.delenv("CRASHHUNT_CORE", raising=False)
    monkeypatch.setenv("CXX", "true")  # a compiler that has nothing to say
    return made


def built(hook, version="standard"):
    data = {"force_include": {}, "force_include_editable": {}, "pure_python": True}
    hook.initialize(version, data)
    return data


@pytest.mark.parametrize(("version", "where"), [("standard", "force_include"), ("editable", "force_include_editable")])
def test_it_goes_next_to_the_package(hook, version, where):
    data = built(hook, version)
    core, kernel, link_order, native_stack = data[where].values()
    assert core.startswith("_crashhunt_core.cpython-")
    assert kernel.startswith("_crashhunt_highway.cpython-")
    assert (link_order, native_stack) == ("_crashhunt_link_order.so", "_crashhunt_native_stack.so")
    assert (data["pure_python"], data["infer_tag"]) == (False, True)


@pytest.mark.parametrize("compiler", ["/no/such/compiler", "false"])
def test_without_a_compiler_that_works_it_is_excluded(hook, monkeypatch, compiler):
    monkeypatch.setenv("CXX", compiler)
    assert built(hook) == {"force_include": {}, "force_include_editable": {}, "pure_python": True}
    assert "goes without its compiled core" in hook.app.warnings[0]
    assert "goes without its kernel for highway-env" in hook.app.warnings[1]
    assert "goes without its fixed order of SUMO's links" in hook.app.warnings[2]
    assert "goes without its native stacks of dying trials" in hook.app.warnings[3]
    monkeypatch.setenv("CRASHHUNT_CORE", "1")
    with pytest.raises((OSError, subprocess.SubprocessError)):
        built(hook)


def test_without_a_compiler_at_all_and_elsewhere_it_is_excluded(hook, monkeypatch):
    monkeypatch.delenv("CXX")
    monkeypatch.setenv("PATH", "/nowhere")
    assert built(hook)["pure_python"]
    monkeypatch.setattr(sys, "platform", "darwin")
    assert built(hook)["pure_python"]
    assert "for CPython on Linux" in hook.app.warnings[4]


def test_it_can_be_excluded(hook, monkeypatch):
    monkeypatch.setenv("CRASHHUNT_CORE", "0")
    assert built(hook)["pure_python"]
    assert not hook.app.warnings
