"""What copies have found is run from the start, and what was found before stays where nobody may run anything."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from crashhunt.base.errors import SimulatorError
from crashhunt.hunts._from_the_start import Found, FromTheStart
from crashhunt.trial import TrialSpec

FOUND = Found(TrialSpec(3, 1, {"ego": {}}, {}, 9), "collision", 5)


def runs(tmp_path, stops, run):
    (tmp_path / "probes" / "000001-collision").mkdir(parents=True)
    return SimpleNamespace(place=SimpleNamespace(path=tmp_path), stops=stops, notes=[], parallel=2, run=run)


def test_whoever_stops_keeps_what_there_was(tmp_path):
    copies = FromTheStart(runs(tmp_path, [2], None), None)
    assert (copies.crashes([FOUND], "probes"), copies.is_stopped) == ((), True)
    assert [path.name for path in (tmp_path / "probes").iterdir()] == ["000001-collision"]


def test_what_cannot_be_run_is_told_and_the_hunt_has_ended_well(tmp_path):
    def fails(specs, folder):
        assert ([*specs], folder) == ([FOUND.spec], "probes")
        yield from ()
        raise SimulatorError("no room")

    again = runs(tmp_path, [], fails)
    assert FromTheStart(again, None).crashes([FOUND], "probes") == ()
    assert again.notes == ["what copies have found could not be run from the start: no room"]
    assert not (tmp_path / "probes").exists()


@pytest.mark.parametrize(("outcome", "step"), [("survived", 5), ("collision", 6)])
def test_another_end_is_no_crash_of_it(tmp_path, outcome, step):
    def another(specs, folder):
        for spec in specs:
            yield SimpleNamespace(result=SimpleNamespace(spec=spec, outcome=outcome, steps=step))

    assert FromTheStart(runs(tmp_path, [], another), None).crashes([FOUND], "probes") == ()
