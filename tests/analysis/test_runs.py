"""Running candidates, where what runs them knows less than is asked."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt import trial_reruns
from crashhunt.analysis import _minimization_runs as _runs
from crashhunt.base.errors import BundleError, CrashhuntError, RecorderError
from crashhunt.crashes import Bundle, Signature, signature_of
from crashhunt.replays import _prepare
from crashhunt.trial import ALL_AGENTS, Collision, Failure, Outcome, TrialResult, TrialSpec
from crashhunt.trial_reruns import EndedRun, OutOfTimeError, StoppedError


@dataclass
class Worker:
    scratch: object = field(default_factory=Path)
    keep_trials: bool = True
    warm_copies: int = 0
    code: tuple = ()


class Refuses:
    """A crashhunt that is too old to leave anybody out.

    Args:
        worker, parallel: as of any executor.
    """

    error = CrashhuntError

    def __init__(self, worker, *, parallel, snapshot):
        pass

    def submit(self, spec):
        self.spec = spec

    def completed(self, timeout_s):
        raise self.error(f"trial {self.spec.number} has only, which this crashhunt does not know")

    def cancel(self, *, above=-1):
        pass


def test_an_older_crashhunt_that_refuses_to_leave_others_out_has_no_one_excluded(tmp_path, monkeypatch):
    monkeypatch.setattr(trial_reruns, "PoolExecutor", Refuses)
    rerun = SimpleNamespace(worker=Worker(), bundle=SimpleNamespace(result=SimpleNamespace(steps_begun=9)))
    words = {"parallel": 1, "budget": 9, "time_s": None, "stopped": lambda: False, "watch": None}
    runs = _runs.Runs(rerun, None, tmp_path / "memory", **words)
    spec = TrialSpec(0, 1, {}, {}, 9, only=(ALL_AGENTS,))
    assert runs.entered(spec) == ()
    monkeypatch.setattr(Refuses, "error", RecorderError)
    with pytest.raises(RecorderError):  # of a full disk nobody concludes anything
        runs.entered(spec)


FAILED = Failure("ValueError", "no plan", 'Traceback\n  File "a.py", line 1, in act\nValueError: no plan\n', "ego")


class Instant:
    """Runs trials at once; what comes of each is given by its argument.

    Args:
        worker, parallel: as of any executor.
    """

    made = ()
    place = -1  # of those that wait, the one that ends next

    def __init__(self, worker, *, parallel, snapshot):
        self.worker, self.parallel, self.waiting, self.ran, self.cancelled, self.closed = (
            worker,
            parallel,
            [],
            [],
            [],
            0,
        )
        Instant.made = (*Instant.made, self)

    def submit(self, spec):
        self.waiting.append(spec)

    def completed(self, timeout_s):
        if self.waiting:
            spec = self.waiting.pop(self.place)
            self.ran.append(spec)
            same, steps = spec.arguments["ego"]["same"], spec.arguments["ego"]["steps"]
            outcome = Outcome.AGENT_ERROR if same in ("yes", "other") else Outcome.SURVIVED
            failure = replace(FAILED, kind="KeyError") if same == "other" else FAILED if same == "yes" else None
            yield TrialResult(spec, outcome, steps=steps, failure=failure, digest=f"{steps:032x}", kept=same == "yes")

    def cancel(self, *, above=-1):
        self.cancelled.append(above)
        self.waiting = [spec for spec in self.waiting if spec.number <= above]

    def close(self):
        self.closed += 1


def candidate(same, steps=5, name=0):
    return TrialSpec(0, 1, {"ego": {"same": same, "steps": steps, "name": name}}, {}, 50)


@pytest.fixture
def make_runs(tmp_path, monkeypatch):
    """Makes runs of a crash of 20 steps; the memory of what came of candidates is a file."""
    monkeypatch.setattr(trial_reruns, "PoolExecutor", Instant)
    monkeypatch.setattr(_prepare, "is_current_code", lambda rerun: True)
    monkeypatch.setattr(Instant, "made", ())
    result = TrialResult(candidate("yes", 20), Outcome.AGENT_ERROR, steps=20, failure=FAILED, digest="f" * 32)
    bundle = Bundle(tmp_path / "b", result, 1, "abc")
    rerun = SimpleNamespace(worker=Worker(), bundle=bundle)

    def make(**options):
        words = {"parallel": 2, "budget": 9, "time_s": None, "stopped": lambda: False, "watch": None, **options}
        return _runs.Runs(rerun, signature_of(bundle), tmp_path / "memory", **words)

    return make


def test_the_first_that_crashes_in_the_same_manner_is_found_whichever_ends_first(make_runs):
    seen = []
    runs = make_runs(watch=lambda count, budget: seen.append((count, budget)))
    others = [candidate("no"), candidate("other", 6), candidate("yes", 7), candidate("no", 8), candidate("yes", 9)]
    assert runs.first(others) == 2
    assert (runs.count, runs.steps) == (3, 5 + 6 + 7)  # what lies beyond it does not count
    assert seen == [(3, 9)]
    (executor,) = Instant.made
    assert executor.parallel == 2
    assert executor.worker.keep_trials is False
    assert {spec.max_steps for spec in executor.ran} == {runs.most_steps} == {21}
    numbers = [spec.number for spec in executor.ran]
    assert len({*numbers}) == len(numbers)
    assert runs.first([candidate("no"), candidate("other", 6)]) is None
    assert runs.first([]) is None
    runs.close()
    assert executor.closed == 1


def test_what_need_not_be_known_is_given_up(make_runs, monkeypatch):
    monkeypatch.setattr(Instant, "place", 0)
    runs = make_runs(budget=99)
    assert runs.first([candidate("yes", 3, name) for name in range(5)]) == 0
    (executor,) = Instant.made
    (ran,) = executor.ran
    assert executor.waiting == []
    assert executor.cancelled == [ran.number]
    again = [candidate("no"), candidate("yes", 7)]
    executor.waiting.insert(0, replace(candidate("yes"), number=3))  # of what has been given up
    assert runs.first(again) == 1


def test_what_came_of_a_candidate_is_remembered(make_runs, tmp_path):
    runs = make_runs(budget=99)
    others = [candidate("no"), candidate("yes", 7), candidate("yes", 8)]
    assert runs.first(others) == 1
    known = make_runs(budget=99)
    assert known.first([*others, candidate("yes", name=1)]) == 1
    assert known.first([candidate("no")]) is None
    assert (known.count, known.steps) == (3, 5 + 7 + 5)
    assert Instant.made[1].ran == []
    assert known.first([candidate("no")], again=True) is None
    assert len(Instant.made[1].ran) == 1
    known.most_steps = 30  # where more is allowed, it may do it
    assert known.first([candidate("no")]) is None
    assert len(Instant.made[1].ran) == 2
    (tmp_path / "memory").write_text((tmp_path / "memory").read_text() + '{"key": "x", "same')  # it was killed
    assert make_runs().first(others) == 1


def test_more_than_the_budget_is_not_run(make_runs):
    runs = make_runs(budget=3)
    with pytest.raises(StoppedError) as error:
        runs.first([candidate("no", name=name) for name in range(4)])
    assert not isinstance(error.value, OutOfTimeError)
    assert runs.count == len(Instant.made[0].ran) == 3
    with pytest.raises(StoppedError):
        runs.first([candidate("yes")])
    assert make_runs(budget=3).first([candidate("no", name=0), candidate("yes"), *[candidate("no", name=9)] * 5]) == 1


@pytest.mark.parametrize(
    ("options", "error"), [({"stopped": lambda: True}, StoppedError), ({"time_s": 1e-9}, OutOfTimeError)]
)
def test_it_stops_when_asked_and_when_time_is_over(make_runs, options, error):
    runs = make_runs(**options)
    with pytest.raises(error) as stopped:
        runs.first([candidate("no"), candidate("no", 6)])
    assert type(stopped.value) is error
    assert Instant.made[0].waiting == []
    assert make_runs(time_s=99.0).first([candidate("no", 6), candidate("no", 7, 1)]) is None


@pytest.mark.parametrize(("digest", "names"), [(f"{4:032x}", ("a", "b")), ("0" * 32, ())])
def test_who_enters_is_what_the_same_trial_has_written(make_runs, tmp_path, monkeypatch, digest, names):
    runs = make_runs()
    folder = tmp_path / "entered"
    folder.mkdir()
    (folder / "entered.json").write_text('["a", "b", "a"]')
    monkeypatch.setattr(trial_reruns, "scratch_of", lambda scratch, number: folder)
    monkeypatch.setattr(trial_reruns.layout, "ENTERED", "entered.json")
    result = runs._rerun.bundle.result
    runs._rerun = SimpleNamespace(bundle=SimpleNamespace(result=replace(result, digest=digest)))
    everybody = replace(candidate("yes", 4), only=(ALL_AGENTS,))
    assert runs.entered(everybody) == names
    assert (runs.count, runs.steps) == (1, 4)
    assert not folder.exists()
    with pytest.raises(StoppedError):
        make_runs(stopped=lambda: True).entered(replace(everybody, max_steps=3))


def test_what_disturbed_others_that_are_moved_is_in_their_ways():
    wanted = Signature("collision", "collider", "rear end", "", "road", "", disturbed=True)
    found = replace(wanted, disturbed=False)
    assert not _runs.is_same(found, wanted, candidate("yes"))
    assert _runs.is_same(found, wanted, replace(candidate("yes"), script=object()))
    assert not _runs.is_same(replace(found, role="victim"), wanted, replace(candidate("yes"), script=object()))
    assert not _runs.is_same(None, wanted, candidate("yes"))


HIT = Collision("ego", "collider", "ego", "a", ("overlap",), "collision", 0.0, 0.0)


@pytest.mark.parametrize(
    ("outcome", "collision", "same"),
    [
        (Outcome.COLLISION, HIT, True),
        (Outcome.COLLISION, replace(HIT, role="victim"), False),
        (Outcome.COLLISION, replace(HIT, agent="other"), False),
        (Outcome.COLLISION, None, True),  # its signature says the rest
        (Outcome.SURVIVED, None, False),
    ],
)
def test_of_a_collision_the_signature_is_made_only_where_it_may_be_the_same(
    make_runs, monkeypatch, outcome, collision, same
):
    runs = make_runs()
    bundle = runs._rerun.bundle
    was = replace(bundle.result, outcome=Outcome.COLLISION, failure=None, collision=HIT)
    runs._rerun = SimpleNamespace(bundle=replace(bundle, result=was))
    asked = []
    monkeypatch.setattr(runs, "_signature_of", lambda ended: asked.append(ended) or runs._signature)
    result = TrialResult(candidate("yes"), outcome, steps=7, collision=collision, digest="d")
    assert runs._judged(EndedRun(0, result, None, bundle.path)) == _runs.Ran(same, 7, "d")
    assert len(asked) == same


@pytest.mark.parametrize("fails", [True, False])
def test_bundle_that_is_made_for_its_signature_is_removed(make_runs, tmp_path, monkeypatch, fails):
    runs = make_runs()
    folder = tmp_path / "trial"
    folder.mkdir()
    (folder / "blackbox.bin").touch()
    result = TrialResult(candidate("yes"), Outcome.COLLISION, steps=7, collision=HIT)

    def write_bundle(place, result, trial, **words):
        assert (place.parent, trial) == (tmp_path, folder)
        place.mkdir()
        if fails:
            raise BundleError("it died before it had recorded anything")
        return "bundle"

    monkeypatch.setattr(_runs, "write_bundle", write_bundle)
    monkeypatch.setattr(trial_reruns, "read_map", lambda scratch, folder: None)
    monkeypatch.setattr(_runs, "signature_of", lambda bundle: f"of {bundle}")
    assert runs._signature_of(EndedRun(0, result, None, folder)) == (None if fails else "of bundle")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["trial"]
