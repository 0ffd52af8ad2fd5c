"""Environments of Gymnasium with planted faults (`search_faults.py`), and what guided hunts find in them."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from crashhunt.trial import TrialSpec

pytestmark = pytest.mark.nightly  # by day, test_guided_known_crashes.py finds several kinds

STUDY = Path(__file__).parents[2] / "scripts" / "studies" / "search"


@pytest.fixture(scope="module")
def study():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(STUDY))
        yield importlib.import_module("search_faults")
    for name in ("search_faults", "stored_hunts"):
        del sys.modules[name]


def test_guided_hunts_find_rare_faults_after_a_common_one(study):
    hunts = [study.faults_found("rare", "guided", "name", seed) for seed in range(3000, 3004)]
    assert all(hunt.count("0") > 1 for hunt in hunts)
    assert sum(len({*hunt}) for hunt in hunts) >= 8  # of 12; random draws find 6


def test_planted_faults_are_as_rare_as_they_are_said_to_be(study):
    found = "".join("".join(study.faults_found("uneven", "random", "", seed)) for seed in range(3000, 3020))
    assert 35 < found.count("0") < 90  # 3000 trials, one in 50
    assert 2 <= found.count("1") <= 18  # one in 400


def test_evidence_of_a_crash_is_a_type_a_cell_or_a_name(study):
    planted = study._Planted(study.FAULTS["rare"], 3000)
    arguments = {"ego": dict(zip(("x0", "x1", "x2"), planted._centers[1].tolist(), strict=True))}
    hits = {}
    for evidence in study.EVIDENCE:
        result, fault = planted.result(TrialSpec(0, 5, arguments, {}, max_steps=1), evidence)
        assert fault == "1"
        hits[evidence] = result.collision.kind, bool(result.collision.cell)
    assert hits == {"type": ("terminated", False), "cell": ("terminated", True), "name": ("fault 1", False)}
