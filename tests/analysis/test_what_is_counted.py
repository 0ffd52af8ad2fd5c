"""What-if runs without processes: what counts, what is excluded, what each intervention changes."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from crashhunt.analysis import (
    Counts,
    LeaveOut,
    Overrule,
    Reseed,
    Run,
    SetArguments,
    WhatIfOptions,
    _whatif_runs as _engine,
)
from crashhunt.analysis._whatif_runs import _from_step, _Runs, future_seed
from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.crashes import wilson
from crashhunt.trial import ALL_AGENTS, KILLED, Failure, Handover, Outcome, Reseeding, TrialResult, TrialSpec


def run(number, *, outcome=Outcome.COLLISION, steps=10, digest=None, excluded=""):
    crashed = outcome is Outcome.COLLISION
    return Run(
        number=number, outcome=outcome, steps=steps, digest=digest or str(number), crashed=crashed, excluded=excluded
    )


def counts(*runs, **changes):
    given = {
        "crash": "c", "interventions": ("something",), "from_step": 3, "code": "snapshot",
        "recorded_outcome": Outcome.COLLISION, "recorded_steps": 9, "asked": len(runs), "each": runs,
    }  # fmt: skip
    return Counts(**{**given, **changes})


def test_counts_leave_excluded_runs_out_of_the_share():
    found = counts(
        run(0, steps=12),
        run(1, steps=8),
        run(2, steps=30),
        run(3, outcome=Outcome.SURVIVED, steps=99),
        run(4, steps=1, excluded="why"),
        run(5, outcome=Outcome.SURVIVED, excluded="why"),
    )
    data = found.to_json()
    assert (data["runs"], data["crashed"], data["survived"], data["excluded"]) == (4, 3, 1, {"why": 2})
    assert (data["share"], data["interval"]) == (0.75, list(wilson(3, 4)))
    assert data["outcomes"] == {"collision": 3, "survived": 1}
    assert (data["earliest_crash_step"], data["median_crash_step"]) == (8, 12)
    assert [each["number"] for each in data["each"]] == [0, 1, 2, 3, 4, 5]
    lines = found.lines()
    assert lines[0].startswith("c: 3 of 4 runs crashed (75 %; 95 % interval: ")
    assert "  excluded: 2 runs, why" in lines


def test_equal_runs_have_no_interval():
    found = counts(run(0, digest="same"), run(1, digest="same"))
    assert (found.share, found.interval, found.different) == (1.0, None, 1)
    assert "  all runs are bit-identical" in found.lines()


def test_no_run_that_counts_has_no_share():
    data = counts(run(0, excluded="why")).to_json()
    assert (data["runs"], data["share"], data["interval"], data["median_crash_step"]) == (0, None, None, None)


def test_stopped_runs_count_up_to_the_first_unfinished_number():
    runs = _Runs(_Rerun(TrialSpec(0, 1, {}, {}, 9), None), None, None, WhatIfOptions(), 9)
    for number in (0, 3, 1, 5):  # crashed runs are short, so later numbers end before earlier ones
        runs.found[number] = run(number)
    assert [each.number for each in runs.counted] == [0, 1]
    assert counts(*runs.counted, asked=9, interrupted="stopped").lines()[-1] == (
        "  interrupted: 2 of 9 runs count, those before the first unfinished run"
    )


@pytest.mark.parametrize(
    ("result", "recorded", "why"),
    [
        ({}, [1, 2, 3, 4], ""),
        ({}, [1, 2, 3, 9], ""),  # after the step, where the change begins
        ({}, [1, 9, 3, 4], "it differs from the recording: step 1"),
        ({}, [1, 2], "it ended at step 2, before step 3"),
        ({}, None, "it left no recording"),
        ({"outcome": Outcome.SURVIVED}, [1, 2, 3, 4], ""),
        ({"outcome": Outcome.HANG}, [1, 2, 3, 4], "hang is no outcome that this hunt counts"),
        (
            {"outcome": Outcome.INVALID, "failure": Failure(KILLED, "killed from outside 3 times", exit_code=-9)},
            None, "its process was killed from outside: killed from outside 3 times",
        ),
    ],
)  # fmt: skip
def test_runs_that_are_killed_or_differ_before_the_step_do_not_count(monkeypatch, result, recorded, why):
    def differ(one, other):
        return next((f"step {place}" for place, (a, b) in enumerate(zip(one, other, strict=True)) if a != b), None)

    monkeypatch.setattr(_engine, "up_to", lambda recording, step: recording.numbers[:step])
    monkeypatch.setattr(_engine, "first_divergence", differ)
    spec = TrialSpec(0, 1, {}, {}, 9)
    rerun = SimpleNamespace(
        spec=spec, recorded=SimpleNamespace(numbers=[1, 2, 3, 4]),
        worker=SimpleNamespace(crash_on=(Outcome.COLLISION,)),
    )  # fmt: skip
    recording = recorded and SimpleNamespace(numbers=recorded, steps=len(recorded))
    ended = TrialResult(spec, **{"outcome": Outcome.COLLISION, "steps": 4, **result})
    reruns = SimpleNamespace(run=lambda specs: [SimpleNamespace(place=0, result=ended, recording=recording)])
    runs = _Runs(rerun, reruns, 3, WhatIfOptions(), 1)
    runs.run_alike()
    (found,) = runs.counted
    assert (found.excluded, found.crashed) == (why, ended.outcome is Outcome.COLLISION)


class Futures:
    """Runs futures without a simulator: a function of the seed and of the number of earlier runs gives the digest."""

    def __init__(self, digest):
        self.digest, self.asked = digest, []

    def run(self, specs):
        for place, spec in reversed([*enumerate(specs)]):  # they need not end in order
            self.asked.append(spec.reseeding)
            ended = TrialResult(spec, Outcome.COLLISION, steps=4, digest=str(self.digest(spec.reseeding.seed)))
            yield SimpleNamespace(place=place, result=ended, recording=None)


def futures(digest, times):
    backend = SimpleNamespace(title="The toy")
    worker = SimpleNamespace(crash_on=(Outcome.COLLISION,), scenario=SimpleNamespace(backend=backend))
    reruns, told = Futures(digest), []
    options = WhatIfOptions(watch=lambda *now: told.append(now))
    runs = _Runs(_Rerun(TrialSpec(0, 7, {}, {}, 9), worker), reruns, None, options, times)
    return runs, reruns, told


@pytest.mark.parametrize("times", [1, 4, 6])
def test_each_future_has_its_own_seed_and_the_first_runs_twice(times):
    runs, reruns, told = futures(lambda seed: seed, times)
    runs.run_futures(3)
    assert [(one.number, one.digest) for one in runs.counted] == [(n, str(future_seed(7, n))) for n in range(times)]
    assert {one.excluded for one in runs.counted} == {""}
    assert {one.after for one in reruns.asked} == {3}
    seeds = [future_seed(7, number) for number in (*range(max(4, times)), 0)]
    assert sorted(one.seed for one in reruns.asked) == sorted(seeds)
    assert told == [(done, times) for done in range(1, times + 1)]


def test_futures_that_are_all_equal_are_refused_after_twenty():
    runs, reruns, _ = futures(lambda seed: "same", 50)
    with pytest.raises(UsageError, match="20 futures with different seeds are bit-identical: The toy draws no") as said:
        runs.run_futures(3)
    assert "after step 3 that changes the run" in said.value.message
    assert len(reruns.asked) == 21
    rare = {future_seed(7, 11)}
    runs, reruns, _ = futures(lambda seed: seed in rare, 50)  # chance may be rare
    runs.run_futures(3)
    assert len(runs.counted) == 50
    assert len(reruns.asked) == 51


def test_futures_of_a_simulator_that_repeats_none_are_refused():
    runs, reruns, _ = futures(lambda seed: len(reruns.asked), 50)
    with pytest.raises(UsageError, match="The toy ran the same future twice with different results"):
        runs.run_futures(3)
    assert len(reruns.asked) == 5


@pytest.mark.parametrize(("digest", "entered"), [("d", ("a", "b", "ego")), ("another", ())])
def test_actors_are_excluded_from_those_that_entered_the_same_trial(digest, entered):
    recorded = TrialSpec(0, 7, {}, {}, 9)
    worker = SimpleNamespace(scenario=SimpleNamespace(agents={"ego": None}))
    rerun = SimpleNamespace(spec=recorded, worker=worker, bundle=SimpleNamespace(result=SimpleNamespace(digest="d")))
    asked = []

    def run(specs):
        asked.extend(specs)
        return [SimpleNamespace(result=SimpleNamespace(digest=digest), entered=("a", "b", "ego"))]

    runs = _Runs(rerun, SimpleNamespace(run=run), None, WhatIfOptions(), 1)
    if not entered:
        with pytest.raises(UsageError, match="--leave-out 'a': there is no such actor"):
            runs.leave_out([LeaveOut(actors=("a",))], recorded)
    else:
        runs.leave_out([LeaveOut(actors=("a",)), LeaveOut(actors=("b",))], recorded)
        assert runs._spec.only == ("ego",)
    assert [one.only for one in asked] == [(ALL_AGENTS,)]


def test_run_that_cannot_be_set_up_is_an_error():
    spec = TrialSpec(0, 1, {}, {}, 9)
    ended = TrialResult(spec, Outcome.INVALID, steps=0, failure=Failure("invalid", "no map"))
    reruns = SimpleNamespace(run=lambda specs: [SimpleNamespace(place=0, result=ended, recording=None)])
    runs = _Runs(_Rerun(spec, None), reruns, None, WhatIfOptions(), 1)
    with pytest.raises(UsageError, match="the run cannot be set up: no map"):
        runs.run_alike()


def test_recorded_prefix_ends_where_the_first_change_begins():
    assert _from_step([Reseed(from_step=7), Overrule(from_step=5)]) == 5
    assert _from_step([Reseed(from_step=7), SetArguments(changes={})]) is None
    assert _from_step([LeaveOut(actors=("a",))]) is None
    assert _from_step([]) is None


def test_excluded_actors_must_have_entered():
    assert LeaveOut(actors=("b",)).taking_part(("a", "b", "c"), {"c"}) == ("a", "c")
    with pytest.raises(UsageError, match="--leave-out 'd': there is no such actor"):
        LeaveOut(actors=("d",)).taking_part(("a", "b"), ())
    with pytest.raises(UsageError, match="--leave-out 'b': agents always take part") as refused:
        LeaveOut(actors=("b",)).taking_part(("a", "b"), {"b"})
    assert refused.value.fix == "give a"


def test_overrule_writes_the_manoeuvre_into_the_specification():
    scenario = SimpleNamespace(agents={"ego": None})
    spec = TrialSpec(0, 1, {}, {}, 9)
    for manoeuvre, said in {"brake": ("brake", ""), "left": ("left", ""), "keep_speed": ("brake", "speed")}.items():
        rerun = _Rerun(spec, SimpleNamespace(scenario=scenario))
        overruled = Overrule(from_step=4, manoeuvre=manoeuvre).applied(rerun).spec.overruled
        assert (overruled.agent, overruled.after, overruled.manoeuvre, overruled.keeps) == ("ego", 4, *said)
    with pytest.raises(UsageError, match="manoeuvre is 'fly'"):
        Overrule(from_step=4, manoeuvre="fly").applied(_Rerun(spec, None))


@dataclass
class _Rerun:
    spec: TrialSpec
    worker: object


def test_seeds_of_futures_are_repeatable_and_different():
    seeds = [future_seed(5, number) for number in range(500)]
    assert seeds == [future_seed(5, number) for number in range(500)]
    assert len(set(seeds)) == 500
    assert len({*seeds, *(future_seed(6, number) for number in range(500))}) == 1000
    assert all(0 <= seed < 2**31 for seed in seeds)


def test_specification_with_handover_and_reseeding_is_refused_by_versions_that_do_not_know_them():
    spec = TrialSpec(1, 2, {}, {}, 5, handover=Handover("ego", 3, "log.mcap"), reseeding=Reseeding(3, 4))
    data = spec.to_json()
    assert TrialSpec.from_json(data) == spec
    assert data["requires"] == ["handover", "reseeding"]
    with pytest.raises(CrashhuntError, match="has later, which crashhunt"):
        TrialSpec.from_json({**data, "requires": ["handover", "later"]})
