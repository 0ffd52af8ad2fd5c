"""What the command line does, from Python: also in a script without a guard, and on what is not finished."""

from __future__ import annotations

import shutil

import pytest
from conftest import keeps_going

import crashhunt
from crashhunt.errors import CrashhuntError


@pytest.fixture
def hunt(toy, made_once, monkeypatch):
    monkeypatch.chdir(toy.folder)
    return made_once(keeps_going, toy)


def test_comparisons_are_printable(hunt):
    shutil.copytree(hunt.folder / "h", hunt.folder / "again")  # the same trials
    found = crashhunt.compare("h", "again")
    assert repr(found).startswith("<comparison h: ")
    assert found.pairs[0].both == found.hunts[0].crashes


def test_mistakes_are_errors_of_ours(hunt):
    class Local:
        pass

    for words, message in (
        ({"agent": Local}, "is not in a module that workers can import"),
        ({"agent": "nothing:There"}, "cannot be imported"),
        ({"arguments": {"sped": 3}}, "did you mean"),
        ({"crash_on": ["boom"]}, "'boom' is not an outcome that can count as a crash"),
    ):
        with pytest.raises(CrashhuntError, match=message):
            crashhunt.run("x", 1, 1, 1, scenario="toy", **words)
    with pytest.raises(AttributeError, match="no attribute 'hunt_for'"):
        _ = crashhunt.hunt_for
