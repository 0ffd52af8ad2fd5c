"""Causes that can be counted, the crashes to judge, and how causes are spread to the others."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
from hypothesis import given, strategies as st

from crashhunt.crashes import (
    Cause,
    CauseGroup,
    Division,
    Factor,
    Group,
    Judgement,
    LeftOut,
    Omission,
    Reference,
    ReferenceRun,
    Signature,
    Why,
    cause_of,
    features_of,
    join_causes,
)
from crashhunt.recording import Prologue
from crashhunt.trial import Outcome
from crashhunt.world import Actor, Roster, Scene


def bundle(outcome=Outcome.COLLISION, length=5.0):
    actors = (Actor("ego", "passenger", 5.0, 1.8), Actor("x", "truck", length, 2.4))
    return SimpleNamespace(result=SimpleNamespace(outcome=outcome), recording=lambda: SimpleNamespace(actors=actors))


def omission(**more):
    named = {
        "faculty": "longitudinal",
        "kind": "vehicle",
        "actor": "x",
        "step": 7,
        "instead": "sped up",
        "speed_mps": 9.0,
    }
    return Omission(**named | more)


def factor(kind, what, *endings, name="ego"):
    return Factor(kind, name, what, 7, None, tuple(LeftOut(place, end) for place, end in enumerate(endings)))


@pytest.mark.parametrize(("length", "actor", "words"), [(5.0, "", "a vehicle"), (16.5, "long", "a long vehicle")])
def test_an_omission_wins_over_a_decision_and_names_long_vehicles(length, actor, words):
    why = Why((factor("agent", "sped up", "none", "none"),))
    found = cause_of(bundle(length=length), Judgement(why=why, reference=Reference(omission=omission())))
    assert found == Cause("omission", "vehicle", "sped up", actor)
    assert str(found) == f"omission: does not brake for {words}, and speeds up"


@pytest.mark.parametrize(
    ("what", "instead", "words"),
    [
        ("vehicle", "kept its speed", "does not brake for a vehicle"),
        ("vehicle", "braked too little", "brakes too little for a vehicle"),
        ("red light", "braked too little", "brakes too little to stop for a red light"),
        ("crossing", "sped up", "does not yield, and speeds up"),
    ],
)
def test_words_of_an_omission_do_not_contradict_themselves(what, instead, words):
    assert str(Cause("omission", what, instead)) == f"omission: {words}"


@pytest.mark.parametrize("relation", ["ahead", "behind", "alongside"])
def test_of_a_lane_change_only_the_side_counts(relation):
    change = omission(kind=f"{relation} left", instead="changed lanes", faculty="lateral")
    found = cause_of(bundle(length=16.5), Judgement(reference=Reference(omission=change)))
    assert found == Cause("omission", "gap left", "changed lanes")
    missing = omission(kind="no lane left", instead="changed lanes", faculty="lateral", actor="")
    words = str(cause_of(bundle(), Judgement(reference=Reference(omission=missing))))
    assert words == "omission: changes to the left, where it has no lane"


@pytest.mark.parametrize(
    ("factors", "cause"),
    [
        ([factor("other", "braked", "none", "none"), factor("agent", "sped up", "none", "none")], "decision"),
        ([factor("agent", "sped up", "same", "none"), factor("disturbance", "brake", "none", "none")], "disturbance"),
        ([factor("argument", "default", "none", name="ego.speed")], "argument"),
        ([factor("argument", "default", "none", name="cars")], "unknown"),  # one run, in other traffic
        ([factor("argument", "drawn", "none", "none", name="cars"), factor("seed", "drawn", "none")], "traffic"),
        ([factor("argument", "drawn", "none", "none", name="cars"), factor("seed", "drawn", "other")], "argument"),
        ([factor("other", "there", "none", "none", "none")], "traffic"),
        ([factor("agent", "sped up", "same", "same")], "unknown"),
        ([factor("agent", "sped up", "none", "unclear")], "unknown"),  # a single run is chance
        ([], "unknown"),
    ],
)
def test_only_factors_without_which_no_run_crashes_are_causes(factors, cause):
    judgement = Judgement(why=Why(tuple(factors)), reference=Reference())
    assert cause_of(bundle(), judgement).kind == cause
    assert cause_of(bundle(Outcome.AGENT_ERROR), judgement).kind == "software fault"
    assert cause_of(bundle(), None).kind == "unknown"


def test_what_runs_have_shown_comes_back_from_json():
    run = ReferenceRun(faculty="lateral", step=7, ending="none", changed=("ego does not change lanes",))
    reference = Reference(omission=omission(gap_m=-2.0, safe=9.5), runs=(run,), why_not="x")
    assert Reference.from_json(reference.to_json()) == reference
    assert Reference.from_json(Reference().to_json()) == Reference()


POINTS = st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9)), min_size=1, max_size=20)


def division(points, most, steps=None):
    found = Division(most)
    for number, point in enumerate(points):
        found.add(number, steps[number] if steps else 9, point)
    return found


def chosen_of(found):
    return list(iter(found.choose, None))


@given(POINTS, st.integers(1, 25))
def test_chosen_crashes_are_distinct_and_begin_with_the_shortest(points, most):
    steps = [(place * 7) % 11 for place in range(len(points))]
    found = division(points, most, steps)
    assert found.left == min(most, len(points))
    chosen = chosen_of(found)
    assert len(chosen) == len({*chosen}) == min(most, len(points))
    assert steps[chosen[0]] == min(steps)
    assert found.left == 0


@given(POINTS, st.data())
def test_every_crash_has_the_cause_of_the_nearest_judged_one(points, data):
    places = data.draw(st.sets(st.integers(0, len(points) - 1), min_size=1))
    found = division(points, 30)
    for place in places:
        found.settle(place, Cause("argument", str(place)))
    assert found.judged == places
    for place, cause in found.causes().items():
        away = [sum((a - b) ** 2 for a, b in zip(points[place], points[other], strict=True)) for other in places]
        mine = int(cause.what)
        nearest = sum((a - b) ** 2 for a, b in zip(points[place], points[mine], strict=True))
        assert nearest <= min(away) + 1e-9
        assert mine == place or place not in places


def test_division_is_complete_once_all_chosen_crashes_have_an_answer():
    found = division([(0.0,), (5.0,), (9.0,)], 2)
    first, second = chosen_of(found)
    found.settle(first, Cause("traffic"))
    assert not found.is_complete
    found.postpone(second)  # interrupted: it is chosen again
    assert (found.left, found.choose()) == (1, second)
    found.settle(second, None)  # cannot be run: the nearest judged crash decides
    assert found.is_complete
    assert found.judged == {first}
    assert {*found.causes().values()} == {Cause("traffic")}
    assert {*division([(0.0,)], 2).causes().values()} == {Cause("unknown")}


def test_length_is_no_cause_where_cars_were_hit_as_well():
    found = division([(0.0,), (5.0,), (9.0,)], 3)
    long, car = Cause("omission", "vehicle", "sped up", "long"), Cause("omission", "vehicle", "sped up")
    found.settle(0, long)
    assert found.causes()[1] == long
    found.settle(2, car)
    assert found.causes() == {0: car, 1: car, 2: car}


def features(side, turn=0.0, at=(0.0, 0.0), steps=40, far=(17.0, 3.2)):
    """Return the features of a crash into a truck that moves over from the next lane, on a road somewhere."""
    roster = Roster((Actor("ego", "passenger", 5.0, 1.8), Actor("x", "truck", 9.0, 2.2)))
    c, s = math.cos(turn), math.sin(turn)
    scenes = []
    for number in range(steps):
        way = [(number * 2.0, 0.0), (number * 2.0 + far[0], side * (far[1] if number < steps - 1 else 0.5))]
        points = [(at[0] + x * c - y * s, at[1] + x * s + y * c) for x, y in way]
        scenes.append(Scene(number / 10, roster, points, [turn] * 2, [20.0, 21.0]))
    hit = SimpleNamespace(agent="ego", other="x")
    crash = SimpleNamespace(result=SimpleNamespace(collision=hit))
    recording = SimpleNamespace(
        scenes=lambda: scenes, scene=scenes.__getitem__, prologue=Prologue((), 0.1), actors=roster.actors
    )
    return features_of(crash, recording)


def test_features_are_motions_before_the_crash_in_differences_that_matter():
    """A crash that is not judged has the cause of the nearest one, and the side is a part of the cause."""
    gap_m = math.hypot(17.0 - 9.0, 3.2 - 2.0)
    for side in (1, -1):
        earlier = (20.0 / 5.0, 21.0 / 5.0, gap_m / 5.0, side * 3.2 / 1.5)
        expected = pytest.approx((*earlier * 3, 9.0 / 4.0))
        assert features(side) == expected
        assert features(side, turn=2.5, at=(300.0, -70.0)) == expected  # wherever the road is
        beyond = (20.0 / 5.0, 21.0 / 5.0, 50.0 / 5.0, side * 5.0 / 1.5)
        assert features(side, far=(90.0, 6.0)) == pytest.approx((*beyond * 3, 9.0 / 4.0))
    sudden = features(1, steps=1)  # the crash is all that is recorded
    assert sudden == pytest.approx((*(4.0, 4.2, 8.0 / 5.0, 0.5 / 1.5) * 3, 9.0 / 4.0))


LEFT = Cause("omission", "gap left", "changed lanes")
REAR_END, SWIPE = (Signature(outcome="collision", role="collider", manner=each) for each in ("rear end", "side swipe"))


def group_of(signature, *parts):
    """A crash type, and its crashes by cause, each with the steps of its crashes."""
    made = [
        CauseGroup(cause=cause, members=crashes, judged=crashes[:1])
        for cause, steps in parts
        for crashes in [tuple(SimpleNamespace(path=f"c{n}", result=SimpleNamespace(steps=n)) for n in steps)]
    ]
    return Group(signature, tuple(one for part in made for one in part.members)), made


def join(*typed):
    return join_causes([group for group, _ in typed], [parts for _, parts in typed])


def test_one_defect_is_one_entry_over_all_crash_types():
    found = join(group_of(REAR_END, (LEFT, [9, 7]), (Cause("decision", "braked"), [3])), group_of(SWIPE, (LEFT, [5])))
    assert [(one.cause.kind, one.count, one.shortest.path) for one in found] == [
        ("omission", 3, "c5"), ("decision", 1, "c3")
    ]  # fmt: skip
    assert found[0].to_json() == {
        "cause": LEFT.to_json(), "words": str(LEFT), "count": 3, "shortest": "c5",
        "types": [
            {"words": str(REAR_END), "count": 2, "judged": 1}, {"words": str(SWIPE), "count": 1, "judged": 1}
        ],
    }  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "entries"),
    [("omission", 1), ("decision", 1), ("disturbance", 1), ("argument", 1), ("traffic", 2), ("unknown", 2),
     ("software fault", 2)],
)  # fmt: skip
def test_only_a_cause_that_names_a_defect_joins_crash_types(kind, entries):
    assert len(join(group_of(REAR_END, (Cause(kind), [4])), group_of(SWIPE, (Cause(kind), [5])))) == entries


def test_length_is_no_cause_where_cars_were_hit_in_crashes_of_another_type():
    long, car = (Cause("omission", "vehicle", "sped up", actor) for actor in ("long", ""))
    (both,) = join(group_of(REAR_END, (long, [4])), group_of(SWIPE, (car, [5])))
    assert (both.cause, both.count) == (car, 2)
    assert [one.cause for one in join(group_of(REAR_END, (long, [4])))] == [long]
