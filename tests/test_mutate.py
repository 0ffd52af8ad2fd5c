"""What `scripts/mutate` relies on: tests for every module, and slips that can still be made."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts"


@pytest.fixture
def mutate(monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPTS))
    import mutate

    yield mutate
    for name in ("mutate", "slips", "copies"):
        sys.modules.pop(name, None)


def test_every_module_has_nearest_tests(mutate):
    files = [file for name in mutate.all_packages() for file in mutate.modules_of(name)]
    assert [str(file) for file in files if not mutate.nearest_tests(file)] == []


def test_tests_elsewhere_exist(mutate):
    for name, patterns in mutate._TESTS_ELSEWHERE.items():
        assert (mutate.ROOT / "crashhunt" / name).exists(), name
        for pattern in patterns:
            assert [*(mutate.ROOT / "tests").glob(pattern)], pattern


def test_listed_equivalent_slips_can_be_made(mutate):
    assert mutate.stale_equivalents(mutate.equivalents()) == []


def test_equivalent_slip_of_changed_code_is_stale(mutate):
    gone = {("crashhunt/no_such_module.py", "-a\n+b"): "reason", ("crashhunt/errors.py", "-a\n+b"): "reason"}
    assert mutate.stale_equivalents(gone) == ["crashhunt/errors.py", "crashhunt/no_such_module.py"]
