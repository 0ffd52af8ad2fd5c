from __future__ import annotations

import importlib
import inspect
import os
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import crashhunt
from crashhunt.base.plugins import CurrentFolder, describe_unused_clone, import_module, locate, registered
from crashhunt.errors import PluginError
from crashhunt.trial import signature_of


class TakesNothing:
    pass


class TakesAsMade(TakesNothing):
    def __new__(cls, count: int = 1):
        return super().__new__(cls)


class SaysWhatItTakes:
    __signature__ = inspect.signature(lambda headway_s=1.0, mode="calm": None)


@pytest.mark.parametrize(
    ("factory", "taken"),
    [(TakesNothing, []), (TakesAsMade, ["count"]), (SaysWhatItTakes, ["headway_s", "mode"])],
)
def test_classes_without_a_constructor_of_their_own(factory, taken):
    found = signature_of(factory)
    assert (list(found.arguments), found.open) == (taken, False)


def test_everything_that_is_registered_can_be_imported():
    for group in ("agents", "executors", "oracles", "samplers", "simulators"):
        names = registered(group)
        assert names, group
        for name in names:
            assert callable(locate(group, name))


def test_what_is_installed_or_removed_meanwhile_is_seen(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    os.utime(tmp_path, (1, 1))  # the clock of a file system may stand still for some milliseconds
    assert "mine" not in registered("agents")
    about = tmp_path / "mine-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[crashhunt.agents]\nmine = mine:Agent\n")
    assert registered("agents")["mine"].value == "mine:Agent"
    about.rename(tmp_path / "mine-1.0.removed")
    os.utime(tmp_path, (2, 2))
    assert "mine" not in registered("agents")


@pytest.mark.parametrize(
    ("content", "name", "says"),
    [
        ("raise RuntimeError('boom')", "broken:Agent", "boom"),
        ("import not_there", "broken:Agent", "not_there"),
        ("Agent = 3", "broken:Agent", "int"),
        ("class Agent: pass", "broken:Agnet", "did you mean 'Agent'"),
        ("", "broken", "not a registered name"),
        ("", ":Agent", "not a registered name"),
        ("def f(:", "broken:Agent", "SyntaxError"),
    ],
)
def test_what_leads_nowhere_states_why(tmp_path, monkeypatch, content, name, says):
    (tmp_path / "broken.py").write_text(content)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    sys.modules.pop("broken", None)
    with pytest.raises(PluginError) as caught:
        locate("agents", name)
    sys.modules.pop("broken", None)
    assert says in str(caught.value)
    assert caught.value.fix


def test_module_with_the_name_of_another_one_is_named(tmp_path, monkeypatch):
    (tmp_path / "random.py").write_text("class Agent: pass")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(PluginError, match=r"no attribute 'Agent'; rename random\.py, because Python already"):
        locate("agents", "random:Agent")


def test_every_python_that_crashhunt_starts_ignores_the_current_folder():
    starts = 0
    for file in Path(crashhunt.__file__).parent.rglob("*.py"):
        for options in re.findall(r"\[\s*sys\.executable,\s*([^\s,]+)", file.read_text()):
            starts += 1
            assert options == '"-P"' or options.startswith("str(self.home"), (
                f"{file}: {options}"
            )  # the file's own folder
    assert starts > 5


def test_named_module_of_the_current_folder_comes_before_installed_ones(tmp_path, monkeypatch):
    for folder in ("here", "installed"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "utils_of_both.py").write_text(f"def place(): return {folder!r}")
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setattr(sys, "meta_path", [one for one in sys.meta_path if not isinstance(one, CurrentFolder)])
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place] + [str(tmp_path / "installed")])
    monkeypatch.delitem(sys.modules, "utils_of_both", raising=False)
    assert import_module("utils_of_both", installed=True).place() == "installed"
    del sys.modules["utils_of_both"]
    assert locate("agents", "utils_of_both:place")() == "here"
    del sys.modules["utils_of_both"]


@pytest.mark.parametrize(
    ("content", "name", "where", "says"),
    [
        ("import os\nimport not_there", "broken:Agent", "broken.py, line 2", "install 'not_there'"),
        ("import os\nimport not_there.inner", "broken:Agent", "broken.py, line 2", "install 'not_there'"),
        ("import json\n\njson.loads('x')", "broken:Agent", "broken.py, line 3", "JSONDecodeError"),
        ("def f():\n  return (", "broken:Agent", "broken.py, line 2", "SyntaxError"),
        ("import sys\nsys.exit(3)", "broken:Agent", "broken.py, line 2", "SystemExit: 3"),
        ("class Own(BaseException): ...\nraise Own('x')", "broken:Agent", "broken.py, line 2", "Own: x"),
        (
            "raise ValueError('x' * 10**7)",
            "broken:Agent",
            "broken.py, line 1",
            "(9999000 more characters",
        ),
        ("from json import nothing", "broken:Agent", "broken.py, line 1", "cannot import name 'nothing'"),
        ("", "brokn:Agent", "", "No module named 'brokn'; did you mean 'broken'?"),
        ("", "broken.inner:Agent", "", "No module named 'broken.inner'"),
        (
            "",
            "broken.py:Agent",
            "",
            "has a file name where a module name belongs; give 'broken:Agent', from the folder",
        ),
        ("", "./in/broken.py:Agent", "", "give 'broken:Agent', from the folder that holds broken.py"),
        ("x\0y", "broken:Agent", "", "null bytes"),
        ("def __getattr__(name):\n  import not_there", "broken:Agent", "broken.py, line 2", "install 'not_there'"),
        (
            "def __getattr__(name):\n  raise ImportError('libGL.so.1: cannot open shared object file: No such file')",
            "broken:Agent",
            "broken.py, line 2",
            "install the system library libGL.so.1 (apt install libgl1 ",
        ),
        (
            "raise ImportError('libmine.so: cannot open shared object file: No such file')",
            "broken:Agent",
            "broken.py, line 1",
            "install the system library libmine.so",
        ),
    ],
)
def test_an_import_that_fails_states_where(tmp_path, monkeypatch, content, name, where, says):
    (tmp_path / "broken.py").write_text(content)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    sys.modules.pop("broken", None)
    importlib.invalidate_caches()
    with pytest.raises(PluginError) as caught:
        locate("agents", name)
    sys.modules.pop("broken", None)
    assert caught.value.where == where
    assert says in str(caught.value)


def test_current_folder_has_no_module_of_python_or_of_a_dependency(tmp_path):
    finder = CurrentFolder()
    finder.folder = str(tmp_path)
    for name in ("helper", "json", "numpy", "PIL", "tomli_w", "mcap_protobuf"):
        (tmp_path / f"{name}.py").touch()
    assert [name for name in ("json", "numpy", "PIL", "tomli_w", "mcap_protobuf") if finder.find_spec(name)] == []
    assert finder.find_spec("helper").origin == str(tmp_path / "helper.py")
    assert finder.find_spec("helper", []) is None  # a module of a package


def test_clone_in_the_current_folder_is_reported_where_the_installed_package_is_used(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    installed = SimpleNamespace(__name__="highway_env", __file__="/v/lib/site-packages/highway_env/__init__.py")
    assert describe_unused_clone(installed) == ""
    (tmp_path / "highway_env").mkdir()
    assert describe_unused_clone(installed) == ""  # a folder without a package
    clone = tmp_path / "highway_env" / "__init__.py"
    clone.touch()
    said = describe_unused_clone(installed)
    assert said.startswith(
        "the package ./highway_env in the current folder is not used: highway_env is imported from /v/"
    )
    copy = SimpleNamespace(__name__="highway_env", __file__="/hunt/snapshots/1/code/highway_env/__init__.py")
    assert (
        describe_unused_clone(copy)
        == describe_unused_clone(SimpleNamespace(__name__="highway_env", __file__=None))
        == ""
    )


def test_an_adapter_of_a_planner_names_the_extra_that_it_needs(monkeypatch):
    monkeypatch.setitem(sys.modules, "fiss_planner", None)  # the import fails, also where it is installed
    monkeypatch.delitem(sys.modules, "crashhunt.agents.planners.fiss_agent", raising=False)
    with pytest.raises(PluginError) as caught:
        locate("agents", "crashhunt.agents.planners.fiss_agent:FissPlanner")
    assert "install" in caught.value.fix
    assert "[planners]" in caught.value.fix
