"""The examples of docstrings give what they say."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

import crashhunt

ROOT = Path(crashhunt.__file__).parent
# What `accelerate` answers depends on the classes that its process has met before.
NOT_RUN = {"crashhunt.highway.accelerator._acceleration"}
BY_NIGHT = {"crashhunt"}  # a whole hunt, which tests/e2e/test_api.py has by day


def modules_with_examples() -> list[str]:
    found: list[str] = []
    for file in sorted(ROOT.rglob("*.py")):
        if ">>> " in file.read_text(encoding="utf-8"):
            parts = file.relative_to(ROOT.parent).with_suffix("").parts
            found.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return [name for name in found if name not in NOT_RUN]


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.nightly if name in BY_NIGHT else ()) for name in modules_with_examples()],
)
def test_examples_give_what_they_say(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ran = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert ran.attempted
    assert not ran.failed
