"""Which trials a hunt runs: the same whenever it was killed, and the sampler is told the same."""

from __future__ import annotations

import random
import shutil
import sqlite3
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from climber import Climber
from conftest import examples
from hypothesis import given, settings as how, strategies as st

from crashhunt.disturbances import FIRST_STEP
from crashhunt.errors import HuntDirectoryError, PluginError
from crashhunt.hunts import Trials, _next_trials, spec_of
from crashhunt.hunts._hunt_setup import settings_again, settings_of_workers
from crashhunt.ledger import Ledger
from crashhunt.plans import AgentSettings, ArgumentSpec, HuntSettings, RunSettings, read_settings
from crashhunt.samplers import NamedSampler, RandomSampler, Sampler
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.trial import Forcing, Outcome, TrialResult
from crashhunt.world import ClosestApproach

TRIALS = 60
HUNTS = sorted((Path(__file__).parents[1] / "e2e" / "frozen").glob("*/hunt"))


def settings(sampler="climber:Climber", *, parallel=2, deterministic=False, trials=TRIALS, argument="gap_m"):
    return HuntSettings(
        scenario="toy",
        scenario_digest="a",
        trials=trials,
        max_steps=9,
        seed=3,
        sampler=sampler,
        agents={"ego": AgentSettings(agent="keep-lane", arguments={"speed": ArgumentSpec(spec="1:9", kind="float")})},
        scenario_arguments={argument: ArgumentSpec(spec="20.0:30.0", kind="float")},
        run=RunSettings(parallel=parallel, deterministic=deterministic),
    )


def ended(spec):
    """How a trial ends, which follows from what it is."""
    speed, gap = spec.arguments["ego"]["speed"], spec.scenario_arguments["gap_m"]
    outcome = Outcome.INVALID if spec.seed % 11 == 0 else Outcome.SURVIVED
    return TrialResult(
        spec, outcome, steps=spec.seed % 9, wall_s=0.1, closest=ClosestApproach(gap / speed, gap, 1.0), danger=gap / 31
    )


class Killed(BaseException):
    """The process of a hunt is gone."""

    ledger: Ledger


@contextmanager
def opened(path):
    """Open the ledger of a hunt. One that is killed leaves it open, until its files have been copied as they are."""
    ledger = Ledger(path, writable=True)
    try:
        yield ledger
    except Killed as killed:
        killed.ledger = ledger
        raise
    except BaseException:
        ledger.close()
        raise
    ledger.close()


def hunt(path, chosen, chance, *, kill_after=10**9, lag=None, slow=frozenset(), log=None, **more):
    """What a hunt does with its trials, which end in any order, until it is killed; return how many were open then."""
    with opened(path) as ledger:
        finished = ledger.finished()
        capacity = 2 * chosen.run.parallel
        sampler = NamedSampler(chosen.sampler, chosen.space, points=chosen.points)
        trials = Trials(chosen, sampler, ledger, finished, lag=lag or capacity, **more)
        running = []
        while True:
            for spec in trials.take(capacity - len(running)):
                running.append(spec)
                if log is not None:
                    log.append(spec)
            if kill_after <= 0:
                raise Killed
            kill_after -= 1
            if not running:
                break
            ready = [spec for spec in running if spec.number not in slow] or running
            spec = chance.choice(ready)
            running.remove(spec)
            result = ended(spec)
            trials.ended(result)
            ledger.record(result, snapshot="")


def killed_again_and_again(folder, chosen, chance, kills, *, lag=None, power=False, slow=frozenset()):
    """Run a hunt that is killed so often; return everything that was started, run by run."""
    path, started = folder / "0" / "ledger.sqlite", []
    path.parent.mkdir()
    for number, kill in enumerate([*kills, 10**9], start=1):
        log = []
        started.append(log)
        try:
            hunt(path, chosen, chance, kill_after=kill, lag=lag, slow=slow, log=log)
        except Killed as killed:
            # The files as they are now, under another name: whoever had them open plays no part any more.
            shutil.copytree(path.parent, folder / str(number))
            killed.ledger.close()
            path = folder / str(number) / "ledger.sqlite"
            path.with_name("ledger.sqlite-shm").unlink(missing_ok=True)
            log_file = path.with_name("ledger.sqlite-wal")
            if power and log_file.exists():  # of what was written last, some never came to the disk
                size = log_file.stat().st_size
                with log_file.open("r+b") as file:
                    file.truncate(chance.randrange(size + 1))
    return path, started


def specs(path):
    with closing(Ledger(path)) as ledger:
        return [result.spec for result in ledger.results()]


KILLS = st.lists(st.integers(0, 40), max_size=4)


@how(max_examples=examples(10))
@given(st.integers(0, 2**32), KILLS, st.integers(1, 8))
def test_hunt_whose_sampler_ends_it_runs_the_same_trials_however_often_it_is_killed(
    tmp_path_factory, seed, kills, parallel
):
    folder = tmp_path_factory.mktemp("hunt")
    chosen = replace(settings("boundary", trials=1000), points=10, crash_on=(Outcome.INVALID,))
    hunt(folder / "whole.sqlite", chosen, random.Random(1))
    path, _ = killed_again_and_again(
        folder, replace(chosen, run=RunSettings(parallel=parallel)), random.Random(seed), kills
    )
    assert specs(path) == specs(folder / "whole.sqlite")
    assert 16 < len(specs(path)) <= 100


@how(max_examples=examples(25))
@given(st.integers(0, 2**32), KILLS, st.integers(1, 8), st.booleans())
def test_a_deterministic_hunt_runs_the_same_trials_however_often_it_is_killed(
    tmp_path_factory, seed, kills, parallel, power
):
    folder = tmp_path_factory.mktemp("hunt")
    hunt(folder / "whole.sqlite", settings(deterministic=True), random.Random(1), lag=16)
    chosen = settings(deterministic=True, parallel=parallel)
    path, _ = killed_again_and_again(folder, chosen, random.Random(seed), kills, lag=16, power=power)
    assert specs(path) == specs(folder / "whole.sqlite")
    assert any(spec.parent for spec in specs(path))


@how(max_examples=examples(25))
@given(st.integers(0, 2**32), KILLS, st.integers(1, 8))
def test_what_a_killed_hunt_had_started_is_what_runs_after(tmp_path_factory, seed, kills, parallel):
    folder = tmp_path_factory.mktemp("hunt")
    path, started = killed_again_and_again(folder, settings(parallel=parallel), random.Random(seed), kills)
    ran = {spec.number: spec for spec in specs(path)}
    assert sorted(ran) == list(range(TRIALS))
    for run in started:
        assert all(ran[spec.number] == spec for spec in run)
    # Whoever reads the ledger knows what was told when: one that is told that proposes all of it again.
    with closing(Ledger(path)) as ledger:
        sampler: Sampler = Climber(settings().space)
        for turn in ledger.turns():
            for number in turn.told:
                sampler.tell(ledger.result(number))
            assert turn.spec.origin.split()[1] == str(sampler._told)
            assert turn.spec == ran[turn.spec.number]


def test_each_trial_is_drawn_from_its_number_and_the_seed_of_the_hunt():
    chosen = settings("random")
    sampler = NamedSampler(chosen.sampler, chosen.space, points=chosen.points)
    specs = [spec_of(number, chosen, sampler) for number in range(3)]
    # The same for ever: a hunt that is gone on with, or repeated, has the trials that it had.
    assert [spec.seed for spec in specs] == [1359935555, 1529200838, 1894986895]
    assert [spec.arguments["ego"]["speed"] for spec in specs] == pytest.approx([8.196639, 5.231068, 8.460145])
    other = replace(chosen, seed=4)
    assert spec_of(0, other, sampler).seed not in [spec.seed for spec in specs]


@pytest.mark.parametrize("name", ["random", "climber:Climber"])
@pytest.mark.parametrize("of_changes", [False, True])
def test_hunt_of_parts_gives_trials_digests_of_changes(name, of_changes, tmp_path):
    chosen = settings(name)
    with closing(Ledger(tmp_path / "l.sqlite", writable=True)) as ledger:
        sampler = NamedSampler(chosen.sampler, chosen.space, points=chosen.points)
        trials = Trials(chosen, sampler, ledger, set(), lag=2, digest_of_changes=of_changes)
        assert {spec.digest_of_changes for spec in trials.take(2)} == {of_changes}


@pytest.mark.parametrize("place", HUNTS, ids=[place.parent.name for place in HUNTS])
def test_trials_of_a_hunt_of_an_older_version_are_drawn_as_they_were(place, tmp_path):
    shutil.copytree(place, tmp_path / "h")
    chosen = read_settings(tmp_path / "h" / "hunt.toml")
    sampler = NamedSampler(chosen.sampler, chosen.space, points=chosen.points)
    with closing(Ledger(tmp_path / "h" / "ledger.sqlite")) as ledger:
        recorded = [result.spec for result in ledger.results()]
        assert [spec_of(spec.number, chosen, sampler) for spec in recorded] == recorded
        more = replace(chosen, trials=len(recorded) + 2)
        rest = Trials(more, sampler, ledger, ledger.finished(), lag=2).take(9)
        assert list(rest) == [spec_of(len(recorded) + number, more, sampler) for number in range(2)]


def test_with_one_worker_nothing_depends_on_time(tmp_path):
    """Which runs one trial after the other, whether the next is asked for at once or two at a time."""

    class First:
        choice = staticmethod(lambda ready: ready[0])

    path = tmp_path / "ledger.sqlite"
    hunt(path, settings(parallel=1), First())
    with closing(Ledger(path)) as ledger:
        turns = list(ledger.turns())
    assert [turn.told for turn in turns] == [(n - 2,) if n > 1 else () for n in range(TRIALS)]


def test_a_trial_that_hangs_keeps_no_one_from_learning(tmp_path):
    path, slow = tmp_path / "ledger.sqlite", frozenset({7})
    hunt(path, settings(parallel=2), random.Random(1), slow=slow)
    with closing(Ledger(path)) as ledger:
        turns = list(ledger.turns())
    told = [number for turn in turns for number in turn.told]
    assert len(told) > TRIALS - 8
    assert 7 not in told  # it ended last
    assert {8, 20, 40} <= set(told)
    # A deterministic one waits for it.
    log: list = []
    with pytest.raises(Killed) as killed:
        hunt(tmp_path / "other.sqlite", settings(deterministic=True), random.Random(1), lag=8, slow=slow,
             log=log, kill_after=6)  # fmt: skip
    killed.value.ledger.close()
    assert max(spec.number for spec in log) <= 7 + 8


@pytest.mark.parametrize("parallel", [1, 9])
def test_first_results_of_a_deterministic_hunt_arrive_soon_with_any_number_of_workers(tmp_path, parallel):
    path = tmp_path / "ledger.sqlite"
    chosen = settings(deterministic=True, parallel=parallel)
    hunt(path, chosen, random.Random(1), lag=10)
    with closing(Ledger(path)) as ledger:
        turns = list(ledger.turns())
    last = [max((number for turn in turns[: n + 1] for number in turn.told), default=-1) for n in range(TRIALS)]
    assert [n - told for n, told in enumerate(last)][:4] == [1, 2, 3, 4]
    assert [n - told for n, told in enumerate(last)][4:] == [min(4 + n // 8, 10) for n in range(4, TRIALS)]
    assert [turn.spec for turn in turns] == specs(path)


def test_a_hunt_that_began_with_another_version_of_the_sampler_is_refused_before_its_next_proposal(tmp_path):
    path = tmp_path / "ledger.sqlite"
    chosen = settings(trials=20)
    hunt(path, chosen, random.Random(1), begun_with=1)
    hunt(path, chosen, random.Random(1), begun_with=2)  # nothing is left to propose
    with pytest.raises(HuntDirectoryError) as refused:
        hunt(path, settings(trials=21), random.Random(1), begun_with=2)
    assert "began with version 2 of the sampler 'climber:Climber', and this crashhunt has version 1" in str(
        refused.value
    )
    assert "trial 20 " in str(refused.value)
    assert "\n" not in str(refused.value)
    hunt(path, settings(trials=21), random.Random(1))
    assert len(specs(path)) == 21


def test_a_trial_that_is_run_again_is_what_was_proposed(tmp_path):
    path = tmp_path / "ledger.sqlite"
    hunt(path, settings(deterministic=True), random.Random(1), lag=8)
    before = specs(path)
    with closing(Ledger(path, writable=True)) as ledger:
        assert ledger.replace([5, 30]) == 2
    hunt(path, settings(deterministic=True, trials=TRIALS + 9), random.Random(1), lag=8)
    after = specs(path)
    assert after[:TRIALS] == before
    assert len(after) == TRIALS + 9


def test_one_that_does_not_learn_needs_no_row(tmp_path):
    path = tmp_path / "ledger.sqlite"
    hunt(path, settings("random"), random.Random(1))
    with closing(sqlite3.connect(path)) as database:
        assert database.execute("SELECT count(*) FROM proposals").fetchone() == (0,)
        assert database.execute("SELECT count(*) FROM hunt WHERE key = 'origins'").fetchone() == (0,)
    chosen = settings("climber:Old")
    hunt(tmp_path / "old.sqlite", chosen, random.Random(2))
    assert specs(tmp_path / "old.sqlite") == specs(path)  # its arguments, and the seeds of the hunt
    assert not NamedSampler("climber:Old", chosen.space, points=1).independent  # it does not say so
    assert NamedSampler("random", chosen.space, points=1).independent
    assert not NamedSampler("grid", chosen.space, points=1).independent


def test_what_a_later_class_draws_in_another_way_is_not_independent_by_inheritance():
    class Stratified(RandomSampler):
        def ask(self, number, rng):
            return super().ask(number // 2, rng)

    assert RandomSampler({}).independent
    assert not Stratified({}).independent


@pytest.mark.parametrize(
    ("argument", "says"),
    [
        ("unmade", "cannot be made: KeyError: 'nothing to sample'"),
        ("independent", "declares both learns and independent"),
        ("raises", "fails when it is asked for trial 0: ZeroDivisionError: division by zero"),
        ("list", "proposes for trial 0 list, not arguments"),
        ("missing", "proposes for trial 0 no value for missing"),
        ("more", "proposes for trial 0 a value for ego.other"),
        ("infinite", "proposes for trial 0 ego.speed = inf, not a finite number"),
        ("object", "proposes for trial 0 ego.speed = <class 'object'>, not a plain bool, int, float or str"),
        ("seed", "proposes for trial 0 the seed -1, not one from 0 to 2147483647"),
        ("parent", "proposes for trial 0 the parent 'first', not the number of a trial"),
        ("origin", "proposes for trial 0 the origin None, not a word"),
    ],
)
def test_a_sampler_that_is_none_is_one_clear_line(tmp_path, argument, says):
    with pytest.raises(PluginError) as refused:
        hunt(tmp_path / "ledger.sqlite", settings("climber:Bad", argument=argument), random.Random(1))
    assert f"the sampler 'climber:Bad' {says}" in str(refused.value)
    assert argument != "raises" or refused.value.where.partition(", line ")[0].endswith("climber.py")
    assert "\n" not in str(refused.value)
    assert refused.value.fix


@pytest.mark.parametrize(
    ("sampler", "says"), [("builtins:int", "cannot be made: TypeError"), ("builtins:dict", "has no 'learns'")]
)
def test_what_is_no_sampler_is_reported_before_anything_runs(sampler, says):
    with pytest.raises(PluginError, match=says):
        NamedSampler(sampler, settings().space, points=3)


def test_trials_take_turns_in_so_many_traffics():
    chosen = settings("random")
    sampler = NamedSampler("random", chosen.space, points=10)
    alone = [spec_of(number, chosen, sampler) for number in range(9)]
    shared = [spec_of(number, replace(chosen, seeds=3), sampler) for number in range(9)]
    traffic = [(one.seed, one.scenario_arguments["gap_m"]) for one in shared]
    assert traffic == traffic[:3] * 3
    assert len(set(traffic)) == 3
    # A hunt that a later version resumes or repeats has the traffic that it had.
    assert [one.seed for one in shared[:3]] == [1961267201, 58124482, 1084902911]
    assert [one.arguments for one in shared] == [one.arguments for one in alone]
    more = replace(chosen, seeds=3, trials=1000)
    assert shared == [spec_of(number, more, sampler) for number in range(9)]


def test_root_draws_disturbances_of_the_steps_before_its_first_forced_onset():
    chosen = replace(settings("random"), max_steps=500)
    sampler, asked = NamedSampler("random", chosen.space, points=10), []
    disturber = SimpleNamespace(draw=lambda seed, steps: asked.append(steps) or ())
    for steps, forcing in ((500, None), (500, Forcing(0.01)), (FIRST_STEP - 2, Forcing(0.01))):
        spec_of(0, replace(chosen, max_steps=steps), sampler, disturber, forcing)
    assert asked == [500, FIRST_STEP - 1, FIRST_STEP - 2]


def test_workers_do_only_what_the_hunt_asks_for(tmp_path):
    toy = Scenario(simulator="toy", agents={"ego": AgentSetup(agent="keep-lane")})
    snapshot = SimpleNamespace(scenario=toy, code=("code",), argument_files={})
    plain = settings("random")
    plain = replace(plain, run=replace(plain.run, warm_copies=3, timeout_s=7.0), disturb={"brake": 0.1})

    def of_workers(**more):
        return settings_of_workers(replace(plain, **more), snapshot, tmp_path)

    found = of_workers()
    assert (found.warm_copies, found.branch, found.force, found.timeout_s) == (0, (), (), 7.0)
    assert of_workers(seeds=2).warm_copies == 3  # only trials in the same traffic have a warm-up in common
    assert of_workers(branch=2).branch == ("brake",)
    assert of_workers(rare=True).force == ("brake",)
    again = settings_again(replace(plain, seeds=2), snapshot, tmp_path)
    assert (again.warm_copies, again.keep_trials, again.timeout_s) == (0, True, 7.0)


def test_what_another_sampler_proposes_for_the_scenario_stays():
    chosen = settings("grid")
    sampler = NamedSampler("grid", chosen.space, points=4)
    alone = [spec_of(number, chosen, sampler) for number in range(16)]
    shared = [spec_of(number, replace(chosen, seeds=3), sampler) for number in range(16)]
    assert len({one.seed for one in shared}) == 3
    assert [(one.arguments, one.scenario_arguments) for one in shared] == [
        (one.arguments, one.scenario_arguments) for one in alone
    ]


@pytest.mark.parametrize("sampler", ["random", "climber:Climber"])
def test_unanswered_trials_run_first_and_the_sampler_proposes_as_if_they_had_not(tmp_path, sampler):
    chosen, chance = settings(sampler, deterministic=True, trials=20), random.Random(1)
    undisturbed, killed, resumed = (tmp_path / name / "ledger.sqlite" for name in ("undisturbed", "killed", "resumed"))
    for path in (undisturbed, killed):
        path.parent.mkdir()
    hunt(undisturbed, chosen, random.Random(1), lag=4)
    with pytest.raises(Killed) as error:
        hunt(killed, chosen, random.Random(1), lag=4, kill_after=9)
    shutil.copytree(killed.parent, resumed.parent)
    error.value.ledger.close()
    with closing(Ledger(resumed, writable=True)) as ledger, closing(Ledger(undisturbed)) as whole:
        finished = ledger.finished()
        unanswered = [ledger.result(number).spec for number in sorted(finished)[1:4:2]]
        made = NamedSampler(chosen.sampler, chosen.space, points=chosen.points)
        trials = Trials(chosen, made, ledger, finished, lag=4, unanswered=unanswered)
        assert not trials.exhausted
        assert trials.upcoming == min(unanswered[0].number, *set(range(20)) - finished)
        order, running = [], []
        while True:
            running += trials.take(2 - len(running))
            order += [spec for spec in running if spec not in order]
            if not running:
                break
            spec = running.pop(chance.randrange(len(running)))
            trials.ended(ended(spec))
            ledger.record(ended(spec), snapshot="")
        assert trials.exhausted
        assert trials.upcoming is None
        assert order[:2] == unanswered
        assert sorted(spec.number for spec in order[2:]) == sorted(set(range(20)) - finished)
        assert [one.spec for one in ledger.results()] == [one.spec for one in whole.results()]


# The order in which trials are provided, with a sampler that makes up specifications.


@pytest.fixture
def provided(monkeypatch):
    """Makes the trials of a hunt of six; each specification is what was asked for."""
    asked = []

    def spec_of(number, settings, sampler, disturber, forcing=None, **_):
        asked.append((number, sampler, disturber, forcing))
        return SimpleNamespace(number=number, parent=None, origin="")

    monkeypatch.setattr(_next_trials, "spec_of", spec_of)

    def make(finished=(), learns=False, deterministic=False, **options):
        run = SimpleNamespace(deterministic=deterministic)
        planned = SimpleNamespace(most_trials=6, run=run, sampler="s")
        sampler = SimpleNamespace(learns=learns, version=1)
        noted = []
        ledger = SimpleNamespace(note=lambda **facts: noted.append(facts))
        made = Trials(planned, sampler, ledger, set(finished), **{"lag": 4, "disturber": "disturber"} | options)
        return SimpleNamespace(trials=made, asked=asked, noted=noted, sampler=sampler)

    return make


def numbers_of(specs):
    return [spec.number for spec in specs]


def test_trials_that_run_again_come_first_and_take_room(provided):
    again = [SimpleNamespace(number=number, parent=None, origin="") for number in (1, 3)]
    found = provided(finished={0, 1, 2, 3}, unanswered=again)
    trials = found.trials
    assert trials.upcoming == 1
    assert trials.take(0) == []
    assert numbers_of(trials.take(1)) == [1]
    assert (trials.upcoming, trials.exhausted) == (3, False)
    assert numbers_of(trials.take(2)) == [3, 4]
    assert (trials.upcoming, trials.exhausted) == (5, False)
    assert numbers_of(trials.take(9)) == [5]
    assert (trials.upcoming, trials.exhausted) == (None, True)
    assert trials.take(9) == []
    assert found.asked == [(4, found.sampler, "disturber", None), (5, found.sampler, "disturber", None)]
    for number in (1, 3, 4):
        trials.ended(SimpleNamespace(spec=SimpleNamespace(number=number)))
    assert trials._open == {5}
    only = provided(finished=range(6), unanswered=again[:1]).trials
    assert (only.upcoming, only.exhausted) == (1, False)


def test_root_waits_until_the_trials_that_it_learns_from_have_ended(provided):
    forcings = SimpleNamespace(needed=lambda number: 2 if number >= 3 else 0, of=lambda number: f"forcing {number}")
    found = provided(forcings=forcings)
    trials = found.trials
    assert numbers_of(trials.take(9)) == [0, 1, 2]
    assert trials.take(9) == []
    trials.ended(SimpleNamespace(spec=SimpleNamespace(number=1)))
    assert trials.take(9) == []  # trial 0 runs
    trials.ended(SimpleNamespace(spec=SimpleNamespace(number=0)))
    assert numbers_of(trials.take(9)) == [3, 4, 5]  # trial 2 is not needed
    assert [forcing for *_, forcing in found.asked] == [f"forcing {number}" for number in range(6)]


def test_ledger_notes_once_that_trials_have_origins(provided, monkeypatch):
    origins = {1: (None, "climb"), 3: (0, ""), 4: (None, "climb")}

    def spec_of(number, *_, **__):
        parent, origin = origins.get(number, (None, ""))
        return SimpleNamespace(number=number, parent=parent, origin=origin)

    monkeypatch.setattr(_next_trials, "spec_of", spec_of)
    found = provided()
    found.trials.take(1)
    assert found.noted == []
    found.trials.take(2)
    assert found.noted == [{"origins": True}]
    found.trials.take(3)
    assert found.noted == [{"origins": True}]
    other = provided()
    del origins[1], origins[4]
    other.trials.take(3)
    assert other.noted == []
    other.trials.take(2)  # a parent is enough
    assert other.noted == [{"origins": True}]
