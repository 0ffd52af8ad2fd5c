"""What records and measures a trial: which records, in which order, and how often."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest

from crashhunt.episode import Nearness, Observer, Recorder, ready_recorder
from crashhunt.episode._observers import _type_of
from crashhunt.recording import Phase, Tag
from crashhunt.simulators import MetaAction, SpeedAndLaneChange
from crashhunt.trial import Collision, Outcome, TrialResult, TrialSpec
from crashhunt.world import Actor, Contact, Event, Roster, Scene

EGO, OTHER, LATE = (Actor(name, "car", 5.0, 2.0, 1.5) for name in ("ego", "other", "late"))
RESULT = TrialResult(TrialSpec(0, 1, {}, {}, 10), Outcome.SURVIVED)


class Box:
    """Notes what it is told."""

    def __init__(self):
        self.said = []
        self.roster = None

    def step(self, *given):
        self.said.append(("step", *given))
        self.roster = given[1].roster

    def __getattr__(self, name):
        return lambda *given: self.said.append((name, *given))

    def evidence(self):
        return (b"recorded",)

    @property
    def kinds(self):
        return [word[1] if word[0] == "append" else word[0] for word in self.said]


def scene(*actors, roster=None, **more):
    count = len(roster.actors if roster else actors)
    rows = [(20.0 * number, 0.0) for number in range(count)]
    return Scene(0.0, roster or Roster(actors), rows, [0.0] * count, [1.0] * count, **more)


@pytest.fixture
def box():
    return Box()


@pytest.fixture
def recorder(box):
    return Recorder(box, SimpleNamespace(reported_events=("teleport", "red_light")))


def test_who_is_new_is_reported_once_and_who_is_there_when_that_changes(box, recorder):
    first = scene(EGO, OTHER)
    recorder.scene(0, first, (0.0,))
    recorder.scene(1, scene(roster=first.roster), (0.0,))
    recorder.scene(2, scene(OTHER, LATE), (0.0,))
    recorder.scene(3, scene(EGO, LATE), (0.0,))
    assert box.kinds == [Tag.ACTORS, Tag.ROSTER, "step", "step", Tag.ACTORS, Tag.ROSTER, "step", Tag.ROSTER, "step"]
    numbers = [list(memoryview(data).cast("I")) for name, tag, _, data in
               (word for word in box.said if word[0] == "append") if tag == Tag.ROSTER]  # fmt: skip
    assert numbers == [[0, 1], [1, 2], [0, 2]]
    assert [word[1] for word in box.said if word[0] == "step"] == [0, 1, 2, 3]


def test_what_is_seldom_has_records_of_its_own_with_a_zero_for_an_agent(box, recorder):
    hit = Contact("ego", "other", "x", "", 1.0, 2.0)
    spines = {1: ((1.0, 2.0, 0.0), (3.0, 4.0, 0.0))}
    full = scene(EGO, OTHER, lanes=("a_0", "a_1"), contacts=(hit,), heights=[0.0, 0.0, 1.0, 0.0], spines=spines)
    full.events = (Event("teleport", "ego", "gone"), Event("teleport", "other", "gone"))
    recorder.scene(4, full, (1.5,))
    assert box.kinds == [Tag.ACTORS, Tag.ROSTER, Tag.LANES, Tag.EVENTS, Tag.HEIGHTS, Tag.SPINES, "note", "step"]
    assert {word[2] for word in box.said if word[0] == "append"} == {0}
    assert box.said[2][3] == b"a_0\na_1"
    assert box.said[-1] == ("step", 4, full, (1.5,))
    box.said.clear()
    recorder.scene(5, scene(roster=full.roster, off_road=("ego",)), (0.0,))
    assert box.kinds == [Tag.EVENTS, "step"]
    found = recorder.end(RESULT)
    assert box.said[-1] == ("mark", Phase.DONE)
    assert found.events == {"teleport": 2}
    assert len(found.digest) == 32
    assert recorder.end(replace(RESULT, outcome=Outcome.INVALID)).digest == ""
    # Where nobody looks for events, that none happened says nothing.
    assert Recorder(Box(), SimpleNamespace()).end(RESULT).events is None


@pytest.mark.parametrize("form", [SpeedAndLaneChange, MetaAction])
def test_agent_draws_the_same_actions_with_and_without_a_prepared_recorder(form):
    def drawn(prepared, episodes=1):
        its = form()
        if prepared:
            ready_recorder(SimpleNamespace(actions={"ego": its}))
        for _ in range(episodes):
            kind, shape = _type_of(its)
            found = [its.encode(its.space.sample()).tolist() for _ in range(4)]
        example = its.encode(its.space.sample())
        assert (kind, shape) == (example.dtype.str, example.shape)
        return found

    assert drawn(prepared=True) == drawn(prepared=False) == drawn(prepared=True, episodes=2)


def test_an_observer_that_has_found_nothing_out_leaves_the_result_alone():
    assert Observer().end(RESULT) is RESULT


@pytest.fixture
def nearness():
    calls = []

    def take_frames():
        calls.append(1)
        return []

    found = Nearness(take_frames)
    found.begin(SimpleNamespace(names=("ego",), simulator=SimpleNamespace(step_length_s=0.1)))
    return found, calls


def test_scenes_do_not_pile_up_until_the_end(nearness):
    meter, calls = nearness
    for step in range(1025):
        meter.scene(step, None, ())
    assert 2 <= len(calls) <= 16  # each time takes a moment
    before = len(calls)
    assert meter.closest.gap_m == math.inf
    assert len(calls) == before + 1


def test_the_one_that_has_touched_was_in_the_greatest_danger(nearness):
    meter, _ = nearness
    hit = Collision("ego", "collider", "ego", "other", ("overlap",))
    crashed = replace(RESULT, outcome=Outcome.COLLISION, collision=hit)
    found = meter.end(crashed)
    assert (found.danger, found.closest.gap_m, found.closest.time_to_collision_s) == (1.0, 0.0, 0.0)
    found = meter.end(replace(crashed, collision=replace(hit, seen_by=("reported",))))
    assert found.danger == 1.0
    assert found.closest.gap_m != 0.0
    assert meter.end(RESULT).danger is None  # it was in no scene
    assert meter.end(replace(RESULT, outcome=Outcome.INVALID)).danger is None


def test_a_simulator_may_name_the_danger_where_there_are_no_others():
    named = Nearness(list)
    simulator = SimpleNamespace(step_length_s=0.1, named_danger=None)
    named.begin(SimpleNamespace(names=("ego",), simulator=simulator))
    assert named.end(RESULT).danger is None
    simulator.named_danger = 0.25  # as is known after the first step, and not when it begins
    assert named.end(RESULT).danger == 0.25
    for said, danger in ((math.nan, None), (7.0, 1.0), (-1.0, 0.0)):  # somebody's own, whom nobody has checked
        simulator.named_danger = said
        assert named.end(RESULT).danger == danger
    simulator.named_danger = 0.25
    assert named.end(replace(RESULT, outcome=Outcome.COLLISION)).danger == 1.0
    assert named.end(replace(RESULT, outcome=Outcome.INVALID)).danger is None
