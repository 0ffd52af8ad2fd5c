"""Options of earlier versions are refused with an instruction, on the command line, in Python and in files."""

from __future__ import annotations

import pytest

import crashhunt
from crashhunt.base.older_versions import refuse_removed_words, removed_fix
from crashhunt.cli import make_parser
from crashhunt.errors import PluginError, UsageError
from crashhunt.executors import PoolExecutor, _protocol
from crashhunt.suites import Suite

OMIT = "omit it: every trial has its own process"
SAYS = "; use --rare with --disturb and rates"


def test_removed_option_is_found_by_its_name_on_the_command_line_in_python_and_in_toml():
    assert removed_fix("--splitting") == removed_fix("splitting") != ""
    assert removed_fix("--recycle-after") == removed_fix("recycle_after") == OMIT
    assert removed_fix("recycle") == removed_fix("--parallel") == ""


def test_command_line_refuses_a_removed_option_with_what_to_do():
    with pytest.raises(UsageError, match=f"there is no option '--splitting'{SAYS}"):
        make_parser().parse_args(["run", "--rare", "--splitting", "h", "1", "2", "3"])


def test_removed_value_of_an_option_is_refused_where_it_follows_the_option():
    with pytest.raises(UsageError, match=f"there is no '--rare splitting'{SAYS}"):
        refuse_removed_words(["run", "--rare", "splitting", "h"])
    refuse_removed_words(["run", "splitting", "--rare", "h"])


def test_python_refuses_a_removed_argument_with_what_to_do():
    with pytest.raises(UsageError, match=f"has no argument 'splitting'{SAYS}"):
        crashhunt.prepare("h", 1, 2, 3, splitting=True)


def test_suite_refuses_a_removed_key_with_what_to_do(tmp_path):
    (tmp_path / "suite.toml").write_text("[defaults]\nsplitting = true\n[[hunts]]\nname = 'a'\n")
    with pytest.raises(UsageError, match=f"unknown key .*splitting'{SAYS}"):
        Suite.read(tmp_path / "suite.toml")


def test_executor_that_requires_a_removed_argument_is_refused_with_what_to_do(monkeypatch):
    class Old:
        def __init__(self, settings, *, parallel, recycle_after): ...

    class Passes:
        def __init__(self, settings, *, parallel):
            PoolExecutor(settings, parallel=parallel, recycle_after=5)

    for kind in (Old, Passes):
        monkeypatch.setattr(_protocol, "executor_of", lambda word, kind=kind: kind)
        with pytest.raises(PluginError, match=f"the executor 'old' cannot be created: .*recycle_after.*{OMIT}"):
            _protocol.make_executor("old", None, parallel=1)
