"""What copies have found is run from the start, and what was found before stays where nobody may run anything."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest

from crashhunt.base.errors import SimulatorError
from crashhunt.disturbances import disturber_of, parse_rates
from crashhunt.hunts import _fork_results, _verification
from crashhunt.hunts._fork_results import (
    ForkCrashes,
    likeliest,
    mildest,
    verify_branches,
    verify_fork_results,
    verify_probes,
    verify_rare,
)
from crashhunt.hunts._progress import Progress
from crashhunt.hunts._verification import keep_near_misses
from crashhunt.trial import (
    KILLED,
    Branch,
    Branches,
    Disturbance,
    Failure,
    Forced,
    ForcedCopy,
    Forcing,
    Outcome,
    Stress,
    TrialResult,
    TrialSpec,
)


class Copies:
    """Of a hunt with or without models; what is run from the start crashes again, but for some trials."""

    def __init__(self, *, words="brake=0.02", flaky=(), **run):
        settings = SimpleNamespace(run=SimpleNamespace(**{"keep_going": False, "only_at_fault": False} | run))
        self.again = SimpleNamespace(setup=SimpleNamespace(settings=settings), progress=Progress())
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
    copies.again.setup.settings.run.deterministic = deterministic
    copies.again.progress = progress = Progress()
    at = ForkCrashes(copies, SimpleNamespace(upcoming=None))
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


def test_every_disturbance_of_a_crash_must_be_of_the_hunt():
    brake = Disturbance(2, "ahead", "brake", 3.0, 2.0, "ego")
    stop = replace(brake, step=4, what="stop")

    def with_both(copies):
        crashed = Branches(crashes=(Branch((brake, stop), 1, "collision", 5, -9.0),))
        return looked(copies, replace(ended(2), branches=crashed))

    assert with_both(Copies()) == (None, [])
    copies = Copies()
    copies.disturber = SimpleNamespace(models=copies.disturber.models, fixed=(stop,))  # planned for every trial
    assert with_both(copies) == (2, [(2, "branches")])
    copies = Copies()
    copies.disturber = SimpleNamespace(models=copies.disturber.models, fixed=(replace(stop, step=5),))
    assert with_both(copies) == (None, [])


def test_a_copy_of_an_earlier_trial_comes_before_a_crash_where_that_is_asked_for():
    for deterministic, wanted in ((False, 4), (True, 2)):
        copies = Copies(deterministic=deterministic)
        progress, at = copies.again.progress, ForkCrashes(copies, SimpleNamespace(upcoming=None))
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
        copies = Copies(deterministic=deterministic)
        progress = copies.again.progress
        trials = SimpleNamespace(upcoming=1)
        at = ForkCrashes(copies, trials)
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


# The sums of all trials, and what is run from the start at the end of a hunt.


class Ends:
    """In place of the runs from the start: what crashes again has a bundle, and one run does not finish."""

    def __init__(self, ledger, *, kept=None, stopped=False, unfinished=0, fails=(), disturber=None, **settings):
        self.kept, self.is_stopped, self.unfinished, self.fails = kept or {}, stopped, unfinished, fails
        self.again = SimpleNamespace(ledger=ledger, setup=SimpleNamespace(settings=SimpleNamespace(**settings)))
        self.asked, self.disturber = [], disturber

    def crashes(self, found, folder, name):
        self.asked.append(([one.spec.number for one in found], folder, name))
        self.found = found
        if self.is_stopped:
            return (), 0
        crashed = [one for one in found if one.spec.number not in self.fails]
        return tuple(
            SimpleNamespace(result=TrialResult(one.spec, Outcome.COLLISION)) for one in crashed
        ), self.unfinished


class Rows:
    """A ledger in memory."""

    def __init__(self, *results):
        self.rows, self.noted = {one.spec.number: one for one in results}, []

    def plain_results(self):
        return [self.rows[number].to_json() for number in sorted(self.rows)]

    def result(self, number):
        return self.rows.get(number)

    def most_dangerous(self, count, snapshots=()):
        return list(self.rows)[:count]

    def note(self, **facts):
        self.noted.append(facts)

    def facts(self):
        return {}


@pytest.fixture(autouse=True)
def sums(monkeypatch):
    """The sums that ledgers have of all trials; None for a hunt without copies."""
    found = SimpleNamespace(probes="sums of probes", branches="sums of branches")
    monkeypatch.setattr(_fork_results, "sums_of_probes", lambda ledger, facts: found.probes)
    monkeypatch.setattr(_fork_results, "sums_of_branches", lambda ledger, facts: found.branches)
    return found


def at(step, strength=4.0):
    return Disturbance(step, "ahead", "brake", strength, 2.0, "ego")


def trial(number, **more):
    return TrialResult(TrialSpec(number, number, {"ego": {}}, {}, 9), Outcome.SURVIVED, steps=9, digest="d", **more)


def branched(number, *likelihoods, **more):
    found = tuple(Branch((at(2, 1.0 + place),), 1, "collision", 5, one) for place, one in enumerate(likelihoods))
    return trial(number, branches=Branches(crashes=found, **more))


def test_branches_are_summed_and_the_likeliest_of_each_trial_runs_from_the_start(sums):
    ledger = Rows(
        branched(0),
        branched(1, -9.0, -2.0),
        branched(2, None, unanswered=1, why_unanswered="killed"),
        branched(3, -1.0, unanswered=2, why_unanswered="another reason"),
        trial(4),
    )
    copies = Ends(ledger, branch=True, unfinished=1, fails=(1,))
    report = verify_branches(copies)
    assert copies.asked == [([3, 1, 2], "branches", "branches")]
    assert [one.spec.disturbances for one in copies.found] == [(at(2, 1.0),), (at(2, 2.0),), (at(2, 1.0),)]
    assert {(one.outcome, one.step, one.spec.origin) for one in copies.found} == {("collision", 5, "branch")}
    assert (report.sums, report.why_unanswered) == ("sums of branches", "killed")
    assert (report.run_again, report.not_finished) == (3, 1)
    assert [bundle.result.spec.number for bundle in report.crashes] == [3, 2]
    stopped = verify_branches(Ends(ledger, branch=True, stopped=True))
    assert (stopped.run_again, stopped.crashes) == (0, ())
    sums.branches = None
    assert verify_branches(Ends(ledger, branch=False)) is None


def test_ten_likeliest_branches_run_and_those_that_are_kept_come_first():
    ledger = Rows(*(branched(number, -float(number)) for number in range(12)))
    copies = Ends(ledger, branch=True, kept={"branches": {11: "bundle"}})
    verify_branches(copies)
    assert copies.asked[0][0] == [11, *range(9)]


def test_likeliest_branch_of_a_trial_is_a_whole_trial():
    assert likeliest(trial(1)) is likeliest(branched(1)) is None
    found = likeliest(branched(1, None, -3.0, -7.0))
    assert found.spec == replace(trial(1).spec, disturbances=(at(2, 2.0),), origin="branch")


def probed(number, margin, least=None, **more):
    planned = {"disturbance": at(4), "outcome": "collision", "step": 6} if least is not None else {}
    return trial(number, stress=Stress(margin, **planned, **more))


def test_probes_are_summed_and_the_mildest_run_from_the_start(sums):
    ledger = Rows(
        probed(0, 1.0),
        probed(1, 0.5, 0.5),
        probed(2, None, why_unasked="killed"),
        probed(3, 0.25, 0.25),
        probed(4, None, why_unasked="another reason"),
        probed(5, 0.75, 0.75),
        probed(6, 0.875, 0.875),
        trial(7),
    )
    copies = Ends(ledger, probe="4s", unfinished=2, fails=(1,))
    report = verify_probes(copies)
    assert copies.asked == [([3, 1, 5], "probes", "probes")]
    assert {(one.outcome, one.step, one.spec.origin) for one in copies.found} == {("collision", 6, "probe")}
    assert {one.spec.disturbances for one in copies.found} == {(at(4),)}
    assert report.margins == (1.0, 0.5, 0.25, 0.75, 0.875)
    assert (report.sums, report.why_unasked) == ("sums of probes", "killed")
    assert (report.run_again, report.not_finished) == (3, 2)
    assert [bundle.result.spec.number for bundle in report.crashes] == [3, 5]
    assert report.by == (at(4), at(4))
    assert verify_probes(Ends(ledger, probe="4s", stopped=True)).run_again == 0
    kept = Ends(ledger, probe="4s", kept={"probes": {6: "bundle"}})
    verify_probes(kept)
    assert kept.asked[0][0] == [6, 3, 1]
    sums.probes = None
    assert verify_probes(Ends(ledger, probe="")) is None


def test_disturbance_of_a_probe_has_its_actual_values():
    stress = probed(1, 0.5, 0.5).stress
    drawn = Disturbance(4, "ahead", "stop", 1.0, 2.0, "ego")
    other = Disturbance(4, "ahead", "brake", 1.0, 2.0, "second")
    late = Disturbance(5, "ahead", "brake", 1.0, 2.0, "ego")
    actual = Disturbance(4, "ahead", "brake", 3.5, 2.0, "ego", "car")
    took_place = (drawn, other, late, actual)
    ran = replace(trial(1), disturbances=took_place, spec=replace(trial(1).spec, disturbances=took_place))
    assert _fork_results._as_it_took_place(stress, ran) == actual
    assert _fork_results._as_it_took_place(stress, trial(1)) == at(4)
    both = mildest(replace(ran, stress=stress))
    assert at(4) in both.spec.disturbances
    assert len(both.spec.disturbances) == 5
    assert [one.step for one in both.spec.disturbances] == sorted(one.step for one in both.spec.disturbances)
    assert mildest(trial(1)) is mildest(probed(1, 0.5)) is None


@pytest.mark.parametrize(
    ("settings", "confirmed"),
    [
        ({"probe": "4s", "branch": True}, {"probes": (1, 1), "branches": (0, 1)}),
        ({"probe": "4s", "branch": False}, {"probes": (1, 1)}),
        ({"probe": "", "branch": True}, {"branches": (0, 1)}),
        ({"probe": "", "branch": False}, None),
    ],
)
def test_confirmed_crashes_of_forks_are_noted(sums, settings, confirmed):
    sums.probes = settings["probe"] or None
    sums.branches = settings["branch"] or None
    ledger = Rows(branched(1, -2.0), probed(2, 0.5, 0.5), probed(3, 0.75, 0.75))
    copies = Ends(ledger, unfinished=1, fails=(3,), **settings)
    probes, branches = verify_fork_results(copies)
    assert (probes is None, branches is None) == (not settings["probe"], not settings["branch"])
    assert ledger.noted == ([{"confirmed": confirmed}] if confirmed else [])


@pytest.fixture
def weighty(monkeypatch):
    """Rare mode of a hunt whose roots 5 and 10 have copies that crashed."""

    def forced(number, *weights):
        copies = tuple(
            ForcedCopy("brake=6.0", 3, weight, 2, "collision" if weight < 9 else "", 7, disturbances=(at(2, weight),))
            for weight in weights
        )
        spec = TrialSpec(number, number, {"ego": {}}, {}, 9, forcing=Forcing(0.01))
        return TrialResult(spec, Outcome.SURVIVED, forced=Forced(0.9, {}, copies, 90))

    @dataclass(frozen=True)
    class Estimate:
        estimate: float | None = 0.1
        estimated: object = "interval"
        estimated_disturbed: object = "interval"
        why_not: str = ""
        why_not_disturbed: str = ""
        more_roots: int | None = 3

    rule = SimpleNamespace(
        weightiest=[forced(5, 0.5, 2.0, 9.5), forced(10, 1.5)], read=lambda: reads.append(1),
        estimate=Estimate,
    )  # fmt: skip
    reads = []
    monkeypatch.setattr(
        _fork_results, "rare_watch", lambda settings, ledger, disturber: rule if settings.rare else None
    )
    return reads


def test_weightiest_copies_of_rare_mode_run_from_the_start(weighty):
    copies = Ends(Rows(), rare=True, unfinished=0)
    report = verify_rare(copies)
    assert weighty == [1]
    assert copies.asked == [([5, 10], "branches", "rare crashes")]
    assert [(one.spec.disturbances, one.outcome, one.step) for one in copies.found] == [
        ((at(2, 2.0),), "collision", 7), ((at(2, 1.5),), "collision", 7),
    ]  # fmt: skip
    assert {(one.spec.forcing, one.spec.origin) for one in copies.found} == {(None, "rare")}
    assert (report.run_again, report.not_finished, len(report.crashes)) == (2, 0, 2)
    assert report.estimate.estimate == 0.1
    assert verify_rare(Ends(Rows(), rare=False)) is None


@pytest.mark.parametrize(
    ("options", "differences", "why"),
    [
        ({}, 0, ""),
        ({}, 3, "3 trials of the audit were not the same again"),
        ({"fails": (5,)}, 0, "1 of 2 crashes did not come again from the start"),
        ({"fails": (5,)}, 3, "1 of 2 crashes did not come again from the start"),
        ({"fails": (5,), "unfinished": 1}, 0, ""),
        ({"stopped": True}, 0, ""),
    ],
)
def test_estimate_of_rare_mode_is_withheld_where_runs_contradict_it(weighty, options, differences, why):
    report = verify_rare(Ends(Rows(), rare=True, **options), differences=differences)
    found = report.estimate
    assert (found.why_not, found.why_not_disturbed) == (why, why)
    empty = [
        found.estimate is None,
        found.estimated is None,
        found.estimated_disturbed is None,
        found.more_roots is None,
    ]
    assert empty == [bool(why)] * 4
    assert report.run_again == (0 if options.get("stopped") else 2)


@pytest.fixture
def near(tmp_path, monkeypatch):
    """Near misses of a hunt of trials 0 to 5, of which bundles of 1 and 9 are there."""
    kept = [SimpleNamespace(result=trial(number), path=tmp_path / f"{number}") for number in (1, 9)]
    removed, written = [], []
    monkeypatch.setattr(_verification, "list_near_misses", lambda directory: list(kept))
    monkeypatch.setattr(_verification, "remove_at_once", removed.append)

    def make(run, keep=3, stops=()):
        phases = []
        clock = SimpleNamespace(begin=lambda *given: phases.append(given), advance=lambda: phases.append("one"))
        setup = SimpleNamespace(
            place=SimpleNamespace(path=tmp_path), settings=SimpleNamespace(run=SimpleNamespace(near_misses=keep)),
            code=SimpleNamespace(newest=()),
        )  # fmt: skip
        again = SimpleNamespace(
            setup=setup, ledger=Rows(*map(trial, range(6))), progress=Progress(), is_stopped=bool(stops), run=run,
            phases=clock,
        )  # fmt: skip
        return SimpleNamespace(again=again, phases=phases, removed=removed, written=written, kept=kept)

    return make


def test_most_critical_trials_run_again_and_are_kept(near, tmp_path):
    def run(specs, folder):
        assert ([spec.number for spec in specs], folder) == ([0, 2, 3], "near-misses")
        kill = Failure(KILLED, "killed 3 times", exit_code=-9)
        ends = (trial(0), replace(trial(2), digest="e"), replace(trial(3), outcome=Outcome.INVALID, failure=kill))
        for end in ends:
            yield SimpleNamespace(
                result=end, write=lambda given, *, confirmed: found.written.append((given.spec.number, confirmed))
            )

    found = near(run, keep=4)
    assert keep_near_misses(found.again) == tuple(found.kept)
    assert found.removed == [tmp_path / "9"]
    assert found.written == [(0, True)]
    assert found.phases == [("near misses", 3), "one", "one", "one"]
    assert [one.spec.number for one in found.again.progress.failed] == [2]
    assert found.again.progress.notes == [
        "trial 2, a near miss, differs when replayed in a new process: it has no bundle",
        "trial 3, a near miss, was killed 3 times: it has no bundle until the same command is run again",
    ]


def test_near_misses_stay_where_none_are_asked_for_or_the_hunt_is_stopped(near):
    def never(specs, folder):
        pytest.fail("it runs")

    for options in ({"keep": 0}, {"stops": (2,)}):
        found = near(never, **options)
        assert keep_near_misses(found.again) == ()
        assert found.removed == []


def test_trials_without_a_criticality_leave_no_near_misses_and_a_note(near, monkeypatch):
    found = near(lambda specs, folder: iter(()))
    for finished, count in (([0], 1), ([], 0)):
        found.again.progress.notes.clear()
        monkeypatch.setattr(found.again.ledger, "most_dangerous", lambda keep, snapshots: [])
        monkeypatch.setattr(found.again.ledger, "numbers_of", lambda outcomes, found=finished: found, raising=False)
        keep_near_misses(found.again)
        assert [note.partition(",")[0] for note in found.again.progress.notes] == ["no near miss is kept"] * count


def test_near_misses_that_are_there_do_not_run_again(near):
    found = near(lambda specs, folder: iter([] if not specs else pytest.fail("it runs")), keep=2)
    found.kept[:] = [SimpleNamespace(result=trial(number), path=number) for number in (0, 1)]
    assert keep_near_misses(found.again) == tuple(found.kept)
    assert (found.removed, found.phases) == ([], [])
    found.kept[0].result = replace(trial(0), digest="other")

    def fails(specs, folder):
        assert [spec.number for spec in specs] == [0]
        yield from ()
        raise SimulatorError("no room")

    found.again.run = fails
    keep_near_misses(found.again)
    assert found.removed == [0]
    assert found.again.progress.notes == ["near misses could not be run again: no room"]
