"""What is tried to make a crash smaller, and in which order."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
from hypothesis import given, strategies as st

from crashhunt.analysis import _minimization_candidates as _stages, fewest
from crashhunt.analysis._delta_debugging import plainest
from crashhunt.analysis._minimization_candidates import Minimizer, RemainingActors
from crashhunt.base.errors import CrashhuntError
from crashhunt.trial import ALL_AGENTS, Disturbance, Escape, TrialSpec
from crashhunt.trial_reruns import OutOfTimeError, StoppedError
from crashhunt.world import Actor, Roster, Scene


def first(good, seen):
    """Try candidates, and count them."""

    def tried(candidates):
        for place, candidate in enumerate(candidates):
            seen.append(candidate)
            if good(candidate):
                return place
        return None

    return tried


@given(st.integers(0, 60), st.data())
def test_exactly_what_it_takes_is_left(count, data):
    needed = {number for number in range(count) if data.draw(st.booleans())}
    seen = []
    found = fewest(range(count), first(lambda some: needed <= set(some), seen))
    assert set(found) == needed
    assert list(found) == sorted(found)
    assert len(seen) <= 4 * (len(needed) + 1) * (count.bit_length() + len(needed) + 2)


def test_parts_are_halves_again_after_one_that_suffices_and_as_small_after_one_that_does_not():
    """Delta debugging as of Zeller and Hildebrandt (2002): these sizes keep the number of trials small."""
    sizes = []

    def tried(candidates):
        sizes.append([len(one) for one in candidates])
        return next((place for place, one in enumerate(candidates) if {3, 12} <= set(one)), None)

    assert fewest(range(16), tried) == (3, 12)
    assert sizes[:5] == [[0], [8, 8], [4] * 4 + [12] * 4, [4] * 3 + [8] * 3, [4, 4]]


@pytest.mark.parametrize(
    ("value", "default", "plainer"),
    [
        (17.2345, 15.0, [15.0, 20.0, 17.0, 17.2, 17.23]),
        (17.2345, None, [20.0, 17.0, 17.2, 17.23]),
        (20.0, None, []),
        (15.0, 15.0, []),
        (37, 20, [20, 40]),
        (True, False, [False]),
        ("firm", "gentle", ["gentle"]),
        ("firm", None, []),
        (float("nan"), None, []),
        (3.0, 1, [1.0]),
        (3, 1.0, []),
        (True, 1, []),
    ],
)
def test_values_become_plainer(value, default, plainer):
    assert plainest(value, default) == plainer
    assert list(map(type, plainest(value, default))) == list(map(type, plainer))


OTHERS = tuple("abcdefgh")


RERUN = SimpleNamespace(
    spec=TrialSpec(0, 1, {"ego": {}}, {}, 300),
    defaults={},
    recorded=SimpleNamespace(agents=("ego",), prologue=SimpleNamespace(step_length_s=0.1)),
    bundle=SimpleNamespace(
        confirmed=True, driver="ego", result=SimpleNamespace(collision=SimpleNamespace(other="a"), event=None)
    ),
)


@dataclass(frozen=True)
class Script:
    """Who is moved, and who drives."""

    names: tuple[str, ...]
    agents: tuple[str, ...]

    def only(self, names):
        return replace(self, names=tuple(name for name in self.names if name in names))


class Scripting:
    """Parts of a crash of 100 steps."""

    whole, steps = RemainingActors(("ego",), OTHERS), 100

    def spec(self, part):
        return TrialSpec(0, 1, {"ego": {}}, {}, 110, script=Script(part.others, part.agents))

    def begins(self, agents):
        return []


class Runs:
    """In traffic it takes these three, and where others are moved it takes all.

    Args:
        scripted: how many runs in which others are moved there is time for.
    """

    def __init__(self, scripted):
        self.most_steps, self.left, self.lengths = 100, scripted, []
        self.found_steps = 100

    def entered(self, spec):
        return OTHERS

    def first(self, specs, *, again=False):
        for place, spec in enumerate(specs):
            if spec.script is None:
                self.lengths.append(self.most_steps)
            elif not self.left:
                raise OutOfTimeError
            else:
                self.left -= 1
            present = OTHERS if spec.only is None else spec.only
            if spec.script.names == OTHERS if spec.script else {*"abc"} <= {*present}:
                return place
        return None


@pytest.mark.parametrize("scripted", [0, 1, 8, 10, 10**6])
def test_time_that_runs_out_while_others_are_moved_takes_nothing_away(monkeypatch, scripted):
    monkeypatch.setattr(_stages, "_nearest", lambda recording, agent: list(OTHERS[:6]))
    monkeypatch.setattr(_stages, "can_be_scripted", lambda rerun: False)
    monkeypatch.setattr(_stages.Minimizer, "steps_cut", 0)
    search = _stages.Minimizer(RERUN, Runs(scripted), "either")
    search._scripting = Scripting()
    assert search.run(lambda: False)[0] in ("time", "done")
    assert search.best == replace(RERUN.spec, only=("a", "b", "c"))
    assert search.smaller[-1] == search.best


@pytest.mark.parametrize(
    ("steps", "escape", "begins"),
    [
        (49, None, [39, 29, 19, 9]),
        (49, 25, [25, 19, 9]),
        (49, 0, []),
        (450, None, [440, 430, 420, 410, 390, 370, 330, 250, 50]),
    ],
)
def test_it_begins_while_the_agent_can_still_avoid_it(steps, escape, begins):
    ego = Actor("ego", "passenger", 5.0, 1.8)
    scenes = [
        Scene(step / 10, Roster((ego,)), [(float(step), 0.0)], [0.0], [10.0], lanes=("road_0",))
        for step in range(steps + 1)
    ]
    rerun = SimpleNamespace(
        spec=TrialSpec(0, 1, {"ego": {}}, {}, 300),
        bundle=SimpleNamespace(
            result=SimpleNamespace(escape=None if escape is None else Escape(escape, escape + 1, 8.0, ""))
        ),
        recorded=SimpleNamespace(
            agents=("ego",), steps=steps, prologue=SimpleNamespace(step_length_s=0.1), scenes=lambda: scenes
        ),
    )
    assert _stages.Scripting(rerun).begins(("ego",)) == begins


BRAKE, STOP = Disturbance(20, "ahead", "brake", 4.0, 2.0, "ego"), Disturbance(30, "ahead", "stop", 1.0, 2.0, "ego")
LATE = Disturbance(40, "", "late_action", 0.3, 2.0, "ego")
NAMED = ("ego", *OTHERS)


def scene(time_s, names=NAMED, apart=10.0):
    """The first of some actors at the origin, and each after it further away."""
    points = [(apart * place, 0.0) for place in range(len(names))]
    roster = Roster(tuple(Actor(name, "passenger", 5.0, 1.8) for name in names))
    return Scene(time_s, roster, points, [0.0] * len(names), [10.0] * len(names))


class Recorded:
    """A recording of a crash.

    Args:
        scenes: of which it is made.
        agents: who drives.
    """

    prologue = SimpleNamespace(step_length_s=0.1)

    def __init__(self, scenes, agents=("ego",)):
        self._scenes, self.agents = scenes, agents
        self.actors = scenes[-1].roster.actors

    def scenes(self):
        return self._scenes

    def scene(self, number):
        return self._scenes[number]


def crash(*, confirmed=True, names=NAMED, other="c", agents=("ego",), event=None, defaults=None, **spec):
    """A crash with everything that a search asks of it; nothing can be scripted."""
    given = {"arguments": {name: {"speed": 17.2345} for name in agents}, "scenario_arguments": {"demand": 37}, **spec}
    hit = SimpleNamespace(other=other) if event is None else None
    scenario = SimpleNamespace(backend=SimpleNamespace(plays_paths=False, title="A toy"), agents=dict.fromkeys(agents))
    return SimpleNamespace(
        spec=TrialSpec(0, 1, max_steps=300, **given),
        defaults=defaults or {("ego", "speed"): 15.0},
        recorded=Recorded([scene(10.0, names[:-1]), scene(12.0, names)], agents),
        bundle=SimpleNamespace(
            confirmed=confirmed, driver="ego", result=SimpleNamespace(collision=hit, event=event)
        ),
        worker=SimpleNamespace(scenario=scenario),
    )  # fmt: skip


class Takes:
    """Runs of candidates that crash where a function of the specification says so.

    Args:
        crashes: says it; may raise.
        entered: the others that take part in the crash.
    """

    def __init__(self, crashes=lambda spec: True, entered=OTHERS):
        self.most_steps, self.tried, self.again = 100, [], []
        self.found_steps = 100
        self._crashes, self._entered = crashes, entered

    def entered(self, spec):
        assert spec.only == (ALL_AGENTS,)
        return self._entered

    def first(self, specs, *, again=False):
        for place, spec in enumerate(specs):
            self.tried.append((self.most_steps, spec))
            self.again.append(again)
            if self._crashes(spec):
                return place
        return None


@pytest.mark.parametrize(("confirmed", "tries"), [(True, 3), (False, 10), (None, 3)])
def test_a_crash_that_does_not_come_again_is_given_up_after_some_runs(confirmed, tries):
    rerun, runs = crash(confirmed=confirmed), Takes(lambda spec: False)
    search = Minimizer(rerun, runs, "traffic")
    assert search.run(lambda: False) == ("done", f"it did not come again in {tries} runs")
    assert (search.reproduced, search.smaller, search.best) == (False, [], rerun.spec)
    assert runs.tried == [(100, rerun.spec)] * tries
    assert all(runs.again)


def test_a_crash_that_comes_again_late_is_made_smaller():
    left = [False, False, True]
    runs = Takes(lambda spec: left.pop(0) if left else False)
    search = Minimizer(crash(), runs, "traffic")
    assert search.run(lambda: False) == ("done", "")
    assert search.reproduced
    assert runs.again[:3] == [True, True, True]
    assert not any(runs.again[3:])


@pytest.mark.parametrize(
    ("error", "stopped", "ended", "says"),
    [
        (StoppedError(), True, "interrupted", ""),
        (StoppedError(), False, "budget", "--budget"),
        (OutOfTimeError(), True, "interrupted", ""),
        (OutOfTimeError(), False, "time", "--for"),
        (CrashhuntError("a worker died"), False, "error", "a worker died"),
    ],
)
def test_why_a_search_ended_is_reported_and_the_best_is_kept(error, stopped, ended, says):
    rerun = crash()

    def crashes(spec):
        if spec not in (rerun.spec, plain):
            raise error
        return True

    plain = replace(rerun.spec, arguments={"ego": {"speed": 15.0}})
    search = Minimizer(rerun, Takes(crashes), "traffic")
    found, words = search.run(lambda: stopped)
    assert found == ended
    assert says in words
    assert bool(says) == bool(words)
    assert search.best == plain
    assert search.smaller == [plain]


def test_an_error_before_the_crash_has_come_again_is_raised():
    def fails(spec):
        raise CrashhuntError("a worker died")

    with pytest.raises(CrashhuntError, match="a worker died"):
        Minimizer(crash(), Takes(fails), "traffic").run(lambda: False)


def test_a_form_that_the_simulator_does_not_have_is_reported():
    rerun = crash()
    search = Minimizer(rerun, Takes(), "scripted")
    ended, words = search.run(lambda: False)
    assert ended == "done"
    assert words.startswith("A toy cannot move others along recorded ways")
    assert search.smaller == []
    rerun.worker.scenario.backend.title = ""
    assert Minimizer(rerun, Takes(), "scripted").run(lambda: False)[1].startswith("its simulator cannot")


def test_traffic_loses_others_disturbances_and_odd_values_that_it_does_not_take():
    rerun = crash(disturbances=(BRAKE, STOP, LATE))

    def crashes(spec):
        present = OTHERS if spec.only is None else spec.only
        fast = spec.arguments["ego"]["speed"] > 16
        return {*"bf"} <= {*present} and fast and STOP in spec.disturbances

    search = Minimizer(rerun, Takes(crashes), "traffic")
    assert search.run(lambda: False) == ("done", "")
    assert search.notes == []
    best = search.best
    assert best == search.smaller[-1]
    assert (best.only, best.disturbances) == (("b", "f"), (STOP,))
    assert (best.arguments, best.scenario_arguments) == ({"ego": {"speed": 20.0}}, {"demand": 40})
    assert search.changed() == {"demand": (37, 40), "ego.speed": (17.2345, 20.0)}
    assert search.removed() == ("a", "c", "d", "e", "g", "h", BRAKE.words, LATE.words)
    assert search.actors(None) == (9, 9)
    assert search.actors(Recorded([scene(0.0, ("ego", "b"))])) == (9, 2)
    assert search.steps_cut == 0


def test_who_is_likely_is_tried_first_and_short_trials_before_long_ones():
    runs = Takes(lambda spec: spec.only is None or {*"bf"} <= {*spec.only})
    search = Minimizer(crash(arguments={"ego": {}}, scenario_arguments={}), runs, "traffic")
    assert search.run(lambda: False) == ("done", "")
    likely = [(), ("c",), ("a", "b"), *((name,) for name in "abdefgh"), tuple("abcdef")]
    first = [(steps, spec.only) for steps, spec in runs.tried[1:] if spec.only is not None]
    assert first[: len(likely)] == [(100, group) for group in likely]  # the nearest six are enough
    assert search.best.only == ("b", "f")

    runs = Takes(lambda spec: spec.only is None or {*"bh"} <= {*spec.only})
    search = Minimizer(crash(arguments={"ego": {}}, scenario_arguments={}), runs, "traffic")
    assert search.run(lambda: False) == ("done", "")
    lengths = [steps for steps, spec in runs.tried[1:]]
    # 250 steps are twice as long as the crash, and 5 s.
    assert lengths[: 3 * len(likely)] == [100] * len(likely) + [250] * len(likely) + [300] * len(likely)
    assert {*lengths[3 * len(likely) :]} == {250}
    assert search.best.only == ("b", "h")


def test_with_another_form_at_hand_only_a_few_are_tried_in_traffic(monkeypatch):
    monkeypatch.setattr(_stages, "can_be_scripted", lambda rerun: True)
    monkeypatch.setattr(_stages, "Scripting", lambda rerun: None)
    names = ("ego", *(f"n{number}" for number in range(12)))
    runs = Takes(lambda spec: spec.only is None, entered=names[1:])
    search = Minimizer(crash(names=names, other="n9"), runs, "either")
    search._scripting = object()
    search._fewer_others()
    groups = [spec.only for steps, spec in runs.tried if steps == 100]
    near = names[1:]
    assert groups == [(), ("n9",), near[:2], *((name,) for name in near[:6]), near[:6]]
    assert [steps for steps, _ in runs.tried] == [100] * len(groups) + [250] * len(groups)


@pytest.mark.parametrize(
    ("agents", "form"), [(("ego", "a"), "either"), (("ego",), "scripted")], ids=["two agents", "only scripts asked for"]
)
def test_script_is_tried_however_few_the_traffic_takes(agents, form):
    search = Minimizer(crash(agents=agents), Takes(), form)
    search.best = replace(search.best, only=("c",))
    assert search._wants_script()


@pytest.mark.parametrize("kept", [None, ("c",), ("c", "d", "e")])
def test_traffic_is_scripted_where_it_takes_many(kept, monkeypatch):
    monkeypatch.setattr(_stages, "can_be_scripted", lambda rerun: False)
    search = Minimizer(crash(), Takes(), "either")
    search.best = replace(search.best, only=kept)
    assert search._wants_script() is (kept != ("c",))
    search.best = replace(search.best, only=("c", "d"))
    assert not search._wants_script()  # three are few
    search.best = replace(search.best, only=())
    assert search._wants_script()  # alone, its beginning can be cut off


def test_where_no_one_can_be_excluded_that_is_reported():
    search = Minimizer(crash(), Takes(entered=()), "traffic")
    assert search.run(lambda: False) == ("done", "")
    assert len(search.notes) == 1
    assert search.notes[0].startswith("all others stay")
    assert search.best.only is None
    assert search.removed() == ()
    alone = Minimizer(crash(names=("a", "ego"), agents=("a", "ego")), Takes(entered=()), "traffic")
    assert alone.run(lambda: False)[0] == "done"
    assert alone.notes == []  # there is nobody else
    assert (alone.agents(None), alone.agents(Recorded([scene(12.0, ("ego", "b"))]))) == ((2, 2), (2, 1))


def test_the_others_of_a_crash_are_those_of_the_collision_or_of_the_event():
    assert Minimizer(crash(other="c"), Takes(), "traffic")._others_of_the_crash() == ["c"]
    assert Minimizer(crash(other=""), Takes(), "traffic")._others_of_the_crash() == []
    event = SimpleNamespace(others=("d", "", "b"))
    rerun = crash(event=event)
    assert Minimizer(rerun, Takes(), "traffic")._others_of_the_crash() == ["d", "b"]
    rerun.bundle.result.event = None
    assert Minimizer(rerun, Takes(), "traffic")._others_of_the_crash() == []


@dataclass(frozen=True)
class Moved:
    """A script that begins at some time."""

    time_s: float
    names: tuple[str, ...]
    agents: tuple[SimpleNamespace, ...]


def test_of_a_script_the_steps_that_are_cut_off_and_who_is_gone_are_reported():
    search = Minimizer(crash(disturbances=(BRAKE, STOP, LATE, replace(LATE, step=50))), Takes(), "traffic")
    script = Moved(12.0, ("b",), (SimpleNamespace(actor=Actor("ego", "passenger", 5.0, 1.8)),))
    search.best = replace(search.best, script=script, disturbances=(replace(LATE, step=20),))
    assert search.steps_cut == 20
    gone = replace(LATE, step=50)  # what befell the others is in their ways
    assert search.removed() == ("a", "c", "d", "e", "f", "g", "h", gone.words)


@pytest.mark.parametrize(
    ("names", "agents", "only", "begins_s", "smaller"),
    [
        (("b",), ("ego",), ("b", "c"), 10.0, True),
        (("b", "c"), ("ego",), ("b", "c"), 12.0, False),
        (("b", "c", "d"), ("ego",), ("b", "c"), 10.0, False),
        (("b", "a"), ("ego",), ("b", "c"), 10.0, True),  # two agents drove before, and one of them is moved now
        ((), ("ego",), (), 12.0, True),
        ((), ("ego",), (), 10.0, False),
        (("b",), ("ego",), None, 10.0, True),
    ],
)
def test_a_script_is_smaller_with_fewer_actors_or_agents_or_steps(names, agents, only, begins_s, smaller):
    driving = ("ego", "a") if "a" in names else ("ego",)
    search = Minimizer(crash(agents=driving), Takes(), "either")
    than = replace(search.best, only=only)
    actors = tuple(SimpleNamespace(actor=Actor(name, "passenger", 5.0, 1.8)) for name in agents)
    search.best = replace(than, script=Moved(begins_s, names, actors))
    assert search._is_smaller(than) is smaller
    search.best = than
    assert search._is_smaller(than)


class TwoDrive(Scripting):
    """Two agents drive, and three others are there."""

    whole = RemainingActors(("ego", "a"), ("b", "c", "d"))


def test_an_agent_that_need_not_drive_is_moved():
    def crashes(spec):
        return spec.script is None or ({*"ac"} <= {*spec.script.names, *spec.script.agents})

    rerun = crash(agents=("ego", "a"), other="c")
    search = Minimizer(rerun, Takes(crashes), "traffic")
    assert search._fewest_moved(TwoDrive()) == RemainingActors(("ego",), ("a", "c"))
    rerun.bundle.driver = "nobody"
    assert Minimizer(rerun, Takes(crashes), "traffic")._fewest_moved(TwoDrive()) == RemainingActors(
        ("ego", "a"), ("c",)
    )
    never = Minimizer(rerun, Takes(lambda spec: spec.script is None), "traffic")
    assert never._fewest_moved(TwoDrive()) is None


class FromLaterOn(Scripting):
    """A trial that can also begin at one of two later steps."""

    def begins(self, agents):
        return [90, 60]

    def spec(self, part):
        return replace(super().spec(part), max_steps=part.begin or 1)


@pytest.mark.parametrize(
    ("others", "others_from_step_60"), [("abcd", "ah"), ("abcd", "gh"), ("gh", "g")], ids=["near", "far", "one"]
)
def test_fewer_are_enough_where_it_begins_later(others, others_from_step_60):
    """In traffic, no actor can be left out."""

    def crashes(spec):
        if spec.script is None:
            return spec.only is None
        needed = others_from_step_60 if spec.max_steps == 60 else others
        return {*needed} <= {*spec.script.names} and spec.max_steps != 90

    search = Minimizer(crash(arguments={"ego": {}}, scenario_arguments={}), Takes(crashes), "either")
    search._scripting = FromLaterOn()
    assert search.run(lambda: False)[0] == "done"
    assert (set(search.best.script.names), search.best.max_steps) == ({*others_from_step_60}, 60)


def test_where_it_begins_later_pairs_with_which_it_crashed_are_tried_first():
    runs = Takes(lambda spec: False)
    search = Minimizer(crash(other="c"), runs, "traffic")
    search._fewer_from_later_on(FromLaterOn(), RemainingActors(("ego",), ("a", "b", "c", "d"), 60))
    tried = [(spec.max_steps, spec.script.names) for _, spec in runs.tried]
    groups = [(), ("c",), *(("c", name) for name in "abdefgh")]
    assert tried[: 3 * len(groups)] == [(step, group) for step in (60, 90, 1) for group in groups]
    assert tried[3 * len(groups) :] == [(60, tuple("abcd")), (90, OTHERS), (1, OTHERS)]


def test_the_nearest_are_those_of_the_last_scene_in_every_direction():
    roster = Roster(tuple(Actor(name, "passenger", 5.0, 1.8) for name in ("a", "ego", "b", "c", "d")))
    points = [(10.0, 14.0), (10.0, 10.0), (7.0, 10.0), (10.0, 9.0), (12.0, 10.0)]
    last = Scene(1.0, roster, points, [0.0] * 5, [0.0] * 5)
    recording = Recorded([scene(0.0), last])
    assert _stages._nearest(recording, "ego") == ["c", "d", "b", "a"]
    assert _stages._nearest(recording, "e") == []  # it was there before, and is gone
    assert _stages._nearest(SimpleNamespace(scenes=list), "ego") == []


class Many(Scripting):
    """Thirty others, and three steps with which it could begin."""

    whole, steps = RemainingActors(("ego",), tuple(f"n{number}" for number in range(30))), 100

    def begins(self, agents):
        return [90, 60]

    def spec(self, part):
        return replace(super().spec(part), max_steps=part.begin or 1)


def test_pairs_are_tried_with_so_many_that_were_near_and_no_more():
    runs = Takes(lambda spec: False)
    search = Minimizer(crash(names=("ego", *Many.whole.others), other="n29"), runs, "traffic")
    search._fewer_from_later_on(Many(), RemainingActors(("ego",), Many.whole.others[:5], 60))
    pairs = {spec.script.names for _, spec in runs.tried if len(spec.script.names) == 2}
    assert pairs == {("n29", f"n{number}") for number in range(24)}


def test_with_few_left_no_other_beginning_is_tried():
    """From step 60 on it takes two others in a crowd of all, but not with the other one of the crash alone."""

    def crashes(spec):
        return spec.max_steps == 60 and {"n3", "n5"} <= {*spec.script.names}

    runs = Takes(crashes)
    search = Minimizer(crash(names=("ego", *Many.whole.others), other="n29"), runs, "traffic")
    search._fewer_from_later_on(Many(), RemainingActors(("ego",), Many.whole.others[:9], 60))
    assert (search.best.script.names, search.best.max_steps) == (("n3", "n5"), 60)
    assert not any(spec.max_steps != 60 and len(spec.script.names) > 2 for _, spec in runs.tried)


def test_where_no_script_does_it_the_traffic_is_looked_through_after_all():
    runs = Takes(lambda spec: spec.script is None and (spec.only is None or {*"bh"} <= {*spec.only}))
    search = Minimizer(crash(arguments={"ego": {}}, scenario_arguments={}), runs, "either")
    search._scripting = Scripting()
    assert search.run(lambda: False) == ("done", "")
    assert any(spec.script for _, spec in runs.tried)
    assert search.best.only == ("b", "h")
    asked = Minimizer(
        crash(arguments={"ego": {}}, scenario_arguments={}), Takes(lambda spec: not spec.script), "scripted"
    )
    asked._scripting = Scripting()
    assert asked.run(lambda: False) == ("done", "")
    assert asked.best.only is None  # only scripts were asked for


def test_a_script_may_take_a_second_longer_than_what_was_recorded():
    ego = Actor("ego", "passenger", 5.0, 1.8)
    scenes = [
        Scene(step / 10, Roster((ego,)), [(float(step), 0.0)], [0.0], [10.0], lanes=("road_0",)) for step in range(50)
    ]
    rerun = SimpleNamespace(
        spec=TrialSpec(0, 1, {"ego": {"speed": 3}}, {}, 300, only=("a",), disturbances=(BRAKE, LATE)),
        bundle=SimpleNamespace(result=SimpleNamespace(escape=None)),
        recorded=Recorded(scenes),
    )
    rerun.recorded.steps = 49
    scripting = _stages.Scripting(rerun)
    spec = scripting.spec(RemainingActors(("ego",), ()))
    assert (scripting.steps, spec.max_steps, spec.only) == (49, 59, None)
    assert spec.disturbances == (LATE,)
    later = scripting.spec(RemainingActors(("ego",), (), begin=30))
    assert later.max_steps == 29
    assert later.disturbances == (replace(LATE, step=10),)
    assert scripting.spec(RemainingActors(("ego",), (), begin=40)).disturbances == ()
    rerun.recorded.prologue = SimpleNamespace(step_length_s=2.5)
    assert _stages.Scripting(rerun).spec(RemainingActors(("ego",), ())).max_steps == 50  # a step at least


class Lasting(Takes):
    """Runs of candidates that crash after as many steps as a function of the specification says, or never."""

    def first(self, specs, *, again=False):
        for place, spec in enumerate(specs):
            self.tried.append((self.most_steps, spec))
            steps = self._crashes(spec)
            if steps is not None and steps <= min(self.most_steps, spec.max_steps):
                self.found_steps = steps
                return place
        return None


def test_plainer_arguments_never_make_the_crash_longer():
    def steps(spec):
        few = spec.only is not None and len(spec.only) == 1
        slow = spec.arguments["ego"]["speed"] != 17.2345  # every other value takes longer
        return (60 if few else 100) + (15 if slow else 0) if spec.only is None or "c" in spec.only else None

    search = Minimizer(crash(), Lasting(steps), "traffic")
    assert search.run(lambda: False) == ("done", "")
    assert search.best.only == ("c",)
    assert search.best.arguments == {"ego": {"speed": 17.2345}}  # 75 steps are less than 100 and more than 60
    assert search.best.scenario_arguments == {"demand": 40}
    assert search._steps == 60


@pytest.mark.parametrize("scripted_steps", [40, 130])
def test_few_actors_with_which_the_crash_takes_longer_are_scripted_from_later_on(monkeypatch, scripted_steps):
    def steps(spec):
        if spec.script is not None:
            return scripted_steps if spec.script.names == ("b",) and spec.max_steps == 60 else None
        return 100 if spec.only is None else 180 if "b" in spec.only else None

    monkeypatch.setattr(_stages, "_nearest", lambda recording, agent: list(OTHERS))
    monkeypatch.setattr(_stages, "can_be_scripted", lambda rerun: False)
    search = Minimizer(crash(arguments={"ego": {}}, scenario_arguments={}), Lasting(steps), "either")
    search._scripting = FromLaterOn()
    assert search.run(lambda: False)[0] == "done"
    # A script may take as many steps as the crash that is known, and not as many as one in traffic.
    assert {most for most, spec in search._runs.tried if spec.script is not None and spec.max_steps == 60} == {100}
    if scripted_steps == 40:
        assert (search.best.script.names, search._steps) == (("b",), 40)
    else:
        assert (search.best.only, search._steps) == (("b",), 180)  # longer, as an actor less is worth more


def test_the_default_of_the_agents_own_code_is_tried_before_that_of_the_scenario():
    runs = Takes()
    search = Minimizer(crash(), runs, "traffic", {("ego", "speed"): 5})
    search._plainer_arguments()
    first_tried = runs.tried[0][1].arguments["ego"]["speed"]
    assert (first_tried, type(first_tried)) == (5.0, float)
    assert search.best.arguments["ego"]["speed"] == 5.0
