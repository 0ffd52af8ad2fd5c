"""What copies have found is run from the start, and what was found before stays where nobody may run anything."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from crashhunt.base.errors import SimulatorError
from crashhunt.disturbances import disturber_of, parse_rates
from crashhunt.hunts._fork_results import ForkCrashes
from crashhunt.hunts._progress import PhaseClock, Progress
from crashhunt.hunts._verification import Found, VerificationRuns
from crashhunt.trial import Branch, Branches, Disturbance, Outcome, Stress, TrialResult, TrialSpec

FOUND = Found(TrialSpec(3, 1, {"ego": {}}, {}, 9), "collision", 5)


def runs(tmp_path, stops, run):
    (tmp_path / "probes" / "000001-collision").mkdir(parents=True)
    return SimpleNamespace(place=SimpleNamespace(path=tmp_path), stops=stops, notes=[], failed=[], parallel=2, run=run,
                           phases=PhaseClock(lambda _: None, 2))  # fmt: skip


def test_the_one_that_stops_keeps_what_there_was(tmp_path):
    copies = VerificationRuns(runs(tmp_path, [2], None), None)
    assert (copies.crashes([FOUND], "probes", "probes"), copies.is_stopped) == (((), 0), True)
    assert [path.name for path in (tmp_path / "probes").iterdir()] == ["000001-collision"]


def test_what_cannot_be_run_is_reported_and_the_hunt_has_ended_well(tmp_path):
    def fails(specs, folder):
        assert ([*specs], folder) == ([FOUND.spec], "probes")
        yield from ()
        raise SimulatorError("no room")

    again = runs(tmp_path, [], fails)
    assert VerificationRuns(again, None).crashes([FOUND], "probes", "probes") == ((), 1)
    assert again.notes == ["what copies have found could not be run from the start: no room"]
    assert not (tmp_path / "probes").exists()


@pytest.mark.parametrize(("outcome", "step"), [("survived", 5), ("collision", 6)])
def test_another_end_is_no_crash_of_it(tmp_path, outcome, step):
    def another(specs, folder):
        for spec in specs:
            yield SimpleNamespace(result=TrialResult(spec, Outcome(outcome), steps=step))

    again = runs(tmp_path, [], another)
    assert VerificationRuns(again, None).crashes([FOUND], "probes", "probes") == ((), 0)
    assert [result.steps for result in again.failed] == [step]


class Copies:
    """Of a hunt with or without models; what is run from the start crashes again, but for some trials."""

    def __init__(self, *, words="brake=0.02", flaky=(), **run):
        settings = SimpleNamespace(run=SimpleNamespace(**{"keep_going": False, "only_at_fault": False} | run))
        self.again = SimpleNamespace(settings=settings)
        self.disturber = disturber_of(parse_rates([words] if words else []), agents=("ego",), step_length_s=0.1)
        self.flaky, self.ran = flaky, []

    def crash(self, found, folder):
        self.ran.append((found.spec.number, folder))
        return None if found.spec.number in self.flaky else found


def ended(number, *, branch=None, probe=None):
    """A trial of which a copy crashed, with so strong a disturbance."""

    def brake(strength):
        return Disturbance(2, "ahead", "brake", strength, 2.0, "ego")

    branches = Branches(crashes=(Branch((brake(branch),), 1, "collision", 5, -9.0),)) if branch else None
    stress = Stress(0.5, disturbance=brake(probe), outcome="collision", step=5) if probe else None
    spec = TrialSpec(number, 1, {"ego": {}}, {}, 9)
    return TrialResult(spec, Outcome.SURVIVED, branches=branches, stress=stress)


def looked(copies, *results, deterministic=False):
    """Which trial ends a hunt by a copy, and what was run from the start."""
    copies.again.settings.run.deterministic = deterministic
    progress = Progress()
    at = ForkCrashes(copies, progress, SimpleNamespace(upcoming=None))
    for result in results:
        at.add(result)
    told = []
    assert at.look(lambda: told.append(1)) is bool(progress.copied)
    assert len(told) == len({number for number, _ in copies.ran})
    assert not at.look()  # once
    return progress.last_wanted, copies.ran


def test_a_hunt_ends_at_the_first_copy_that_crashes_from_the_start():
    assert looked(Copies(), ended(1), ended(2, branch=3.0)) == (2, [(2, "branches")])
    assert looked(Copies(flaky=(2,)), ended(3, probe=3.0), ended(2, branch=3.0, probe=3.0)) == (
        3, [(2, "branches"), (2, "probes"), (3, "probes")],
    )  # fmt: skip
    for deterministic in (False, True):
        found = looked(Copies(), ended(5, branch=3.0), ended(2, branch=3.0), deterministic=deterministic)
        assert found == (2, [(2, "branches")])


def test_only_kinds_that_a_hunt_has_end_it():
    """Of all that probes ask for, something is bound to make a trial crash."""
    assert looked(Copies(words=""), ended(2, probe=3.0)) == (None, [])
    assert looked(Copies(words="stop=0.02"), ended(2, probe=3.0)) == (None, [])
    for run in ({"keep_going": True}, {"only_at_fault": True}):
        assert looked(Copies(**run), ended(2, branch=3.0)) == (None, [])


def test_a_copy_of_an_earlier_trial_comes_before_a_crash_where_that_is_asked_for():
    for deterministic, wanted in ((False, 4), (True, 2)):
        copies, progress = Copies(deterministic=deterministic), Progress()
        at = ForkCrashes(copies, progress, SimpleNamespace(upcoming=None))
        crashed = replace(ended(4), outcome=Outcome.COLLISION)
        progress.found[4] = crashed
        for number in (2, 6):
            at.add(ended(number, branch=3.0))
        assert at.look() is deterministic
        assert progress.last_wanted == wanted
        assert progress.unsaved is (None if deterministic else crashed)
        assert (progress.ended_by_copy is not None) is deterministic
        assert len(copies.ran) == deterministic


def test_a_deterministic_hunt_that_is_resumed_runs_trials_of_lower_numbers_first():
    for deterministic, waits in ((False, False), (True, True)):
        copies, progress = Copies(deterministic=deterministic), Progress()
        trials = SimpleNamespace(upcoming=1)
        at = ForkCrashes(copies, progress, trials)
        copies.again.ledger = SimpleNamespace(
            plain_results=lambda: [ended(3, branch=3.0).to_json(), ended(0).to_json()],
            result={3: ended(3, branch=3.0)}.get,
        )
        at.resume()
        assert copies.ran == ([] if waits else [(3, "branches")])
        assert progress.is_done is not waits
        trials.upcoming = 4
        assert at.look() is waits
        assert progress.last_wanted == 3


def test_what_is_kept_is_not_run_again_and_stays(tmp_path):
    kept = tmp_path / "probes" / "000003-collision"
    again = runs(tmp_path, [], lambda specs, folder: iter([] if not specs else 1 / 0))
    kept.mkdir()
    bundle = SimpleNamespace(path=kept, result=SimpleNamespace(spec=FOUND.spec))
    copies = VerificationRuns(again, None, {"probes": {3: bundle}})
    assert copies.crashes([FOUND], "probes", "probes") == ((bundle,), 0)
    assert [path.name for path in (tmp_path / "probes").iterdir()] == ["000003-collision"]
