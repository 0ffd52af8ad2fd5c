"""Until when braking would have avoided a crash: what is said is tried, by driving the recorded actions and braking."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import pytest

from crashhunt.crashes import list_bundles
from crashhunt.testing import check_escape

if TYPE_CHECKING:
    from pathlib import Path

KEEP = ("--keep-going", "--deterministic", "--seed", "1")


def told(folder: Path) -> Counter[str]:
    return Counter(check_escape(bundle).verdict for bundle in list_bundles(folder))


@pytest.mark.nightly
def test_on_sumo_it_brakes_as_hard_as_its_type(shell):
    shell.crashhunt("run", "h", "2", "3", "600", "--arg", "speed=20:25", *KEEP)
    told_of = told(shell.folder / "h")
    assert told_of["wrong"] == 0
    assert told_of["right"] >= 2
    facts = shell.crashhunt("show", "h", "--json").json
    assert facts["braking"]["by"] == "running it"
    assert facts["full_braking"] == pytest.approx(8.0, abs=0.01)
    found = shell.crashhunt("show", "h").out
    assert "Braking at 8 m/s², the maximum of its vehicle type, could have avoided it" in found
