"""What actors did before a crash that may have caused it, and which actors are examined."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from crashhunt.analysis import _causes, _omissions
from crashhunt.analysis._causes import Manoeuvre, find_why, lanes_around_crash, manoeuvres_of, relevant_actors
from crashhunt.base.errors import CrashhuntError, RecorderError
from crashhunt.crashes import INTERRUPTED, Factor, LaneMap, LeftOut, Why
from crashhunt.trial import Choice, Collision, Constant, Disturbance, Outcome, Overruled, Range, TrialSpec
from crashhunt.trial_reruns import StoppedError
from crashhunt.world import Actor, Roster, Scene

DT = 0.1


def recording(ways, count, *, agents=("ego",)):
    """Scenes of actors, each from a function of the time that returns x, y and speed, or None where it is away."""
    scenes = []
    for step in range(count):
        there = {name: found for name, way in ways.items() if (found := way(step * DT)) is not None}
        roster = Roster(tuple(Actor(name, "car", 5.0, 2.0) for name in there))
        points = [(x, y) for x, y, _ in there.values()]
        scenes.append(Scene(step * DT, roster, points, [0.0] * len(there), [speed for *_, speed in there.values()]))
    return SimpleNamespace(
        scenes=lambda: scenes,
        all_steps=[SimpleNamespace(step=step, scene=scene) for step, scene in enumerate(scenes)],
        prologue=SimpleNamespace(step_length_s=DT),
        agents=agents,
        scene=scenes.__getitem__,
    )


def speeds(*parts):
    """A speed that changes by so many m/s² for so many s, part after part; it begins at 20 m/s."""

    def way(time_s):
        speed = 20.0
        for acceleration, seconds in parts:
            took = min(max(time_s, 0.0), seconds)
            speed, time_s = speed + acceleration * took, time_s - seconds
        return 0.0, 0.0, speed

    return way


def found(*parts, count=120, end=110):
    return [
        (one.what, one.step, round(one.speed, 3))
        for one in manoeuvres_of(recording({"x": speeds(*parts)}, count), "x", (), end)
    ]


@pytest.mark.parametrize(
    ("parts", "manoeuvres"),
    [
        ([], []),
        ([(0, 5), (-3, 1)], [("braked", 50, 20.0)]),
        ([(0, 5), (-1.4, 3)], []),  # it drives along
        ([(0, 5), (1.2, 2)], [("sped up", 50, 20.0)]),
        ([(0, 5), (0.9, 3)], []),
        ([(0, 5), (-3, 0.2)], []),  # 0.6 m/s make no difference
        ([(0, 5), (-0.5, 0.5), (-3, 1)], [("braked", 50, 20.0)]),  # soft at first
        ([(0, 2), (-3, 1), (0, 2), (-3, 1)], [("braked", 50, 17.0)]),  # the last one
        ([(0, 2), (-3, 1), (0, 0.3), (-3, 1)], [("braked", 20, 20.0)]),  # a short pause does not end it
        ([(0, 2), (-3, 1), (0, 2), (-3, 0.2)], [("braked", 20, 20.0)]),  # the last one makes no difference
        ([(0, 2), (3, 1), (0, 2), (-3, 1)], [("braked", 50, 23.0), ("sped up", 20, 20.0)]),
    ],
    ids=str,
)
def test_last_manoeuvre_of_each_type_begins_where_the_speed_begins_to_change(parts, manoeuvres):
    assert found(*parts) == manoeuvres


def test_only_the_ten_seconds_before_the_crash_count():
    assert found((0, 1), (-3, 1), count=150, end=120) == []
    assert found((0, 2.1), (-3, 1), count=150, end=120) == [("braked", 21, 20.0)]
    assert found((0, 5), (-3, 1), end=50) == []  # the collision itself changes speeds
    assert found((0, 5), (-3, 1), end=1) == []
    manoeuvre = manoeuvres_of(recording({"x": speeds((0, 5), (-3, 1))}, 120), "x", (), 110)[0]
    assert manoeuvre == Manoeuvre(actor="x", what="braked", step=50, speed=20.0)


@pytest.mark.parametrize(
    ("asides", "began"),
    [
        ([0.0] * 11 + [0.17 * k for k in range(1, 11)], 10),
        ([0.0] * 20 + [3.2], 19),  # at once, with the collision
        ([1.592] * 20 + [1.601], 19),  # it has drifted to the border, and crosses it with the collision
        ([0.0] * 21, None),
    ],
    ids=str,
)
def test_agent_changed_lanes_from_the_scene_in_which_it_began_to_move_there(asides, began):
    borders = [[(x, y - 1.6) for x in (0, 200)] for y in (0.0, 3.2, 6.4)]
    lanes = LaneMap([*itertools.pairwise(map(np.array, borders))], (100, 0))
    way = {"ego": lambda time_s: (80 + 10 * time_s, asides[round(time_s / DT)], 10.0)}
    changed = [] if began is None else [Manoeuvre("ego", "changed lanes", began, 10.0)]
    assert manoeuvres_of(recording(way, 21), "ego", lanes, 20) == changed
    other = manoeuvres_of(recording(way, 21, agents=("x",)), "ego", lanes, 20)
    assert other == (changed if began == 10 else [])  # of another vehicle, the scene after the collision does not count


@pytest.mark.parametrize(("hit", "near"), [((500.0, 0.0), True), ((0.0, 0.0), False), (None, True)])
def test_lanes_are_those_around_the_collision_or_else_where_the_agent_was_last(monkeypatch, hit, near):
    lane = [np.array([(x, y) for x in (480.0, 520.0)]) for y in (-1.6, 1.6)]
    monkeypatch.setattr(_causes, "read_lanes", lambda log: [lane])
    collision = None if hit is None else SimpleNamespace(x=hit[0], y=hit[1])
    bundle = SimpleNamespace(result=SimpleNamespace(collision=collision), driver="ego", path=Path("bundle"))
    ways = {"ego": lambda time_s: (460 + 20 * time_s, 0.0, 20.0) if time_s < 2.05 else None, "other": stands(0.0)}
    assert bool(lanes_around_crash(SimpleNamespace(bundle=bundle, recorded=recording(ways, 30)))) is near


class Twice:
    """A search for causes with two candidates, of which the second is suppressed within the episode."""

    steps = 50

    def __init__(self, rerun):
        self.candidates = [
            _causes._Candidate(Factor("seed", "seed", "drawn"), [(number, f"seed {number}") for number in range(3)]),
            _causes._Candidate(Factor("other", "car", "braked", 4), [(4, "held")], inside=True),
        ]

    def asked(self):
        return self.candidates

    def ending(self, asked, place, ended):
        return LeftOut(asked.runs[place][0], "none")


@pytest.mark.parametrize(
    ("most", "fails", "left", "runs", "factors", "why_not"),
    [
        (9, {}, 0, ["seed 0", "seed 1", "seed 2", "held"], {"seed": [0, 1, 2], "car": [4]}, ""),
        (3, {}, 1, ["seed 0", "seed 1", "held"], {"seed": [0, 1], "car": [4]}, ""),  # in turns
        (9, {"held": CrashhuntError("no holds")}, 0, ["seed 0", "seed 1", "seed 2"], {"seed": [0, 1, 2]}, "no holds"),
        (9, {"seed 1": StoppedError()}, 0, ["seed 0"], {"seed": [0]}, INTERRUPTED),
        (9, {"seed 1": CrashhuntError("x")}, None, ["seed 0"], None, "x"),
        (9, {"held": RecorderError("full")}, None, ["seed 0", "seed 1", "seed 2"], None, "full"),
    ],
)
def test_causes_are_searched_within_the_limit_and_errors_end_no_more_than_they_must(
    monkeypatch, most, fails, left, runs, factors, why_not
):
    monkeypatch.setattr(_causes, "_Search", Twice)
    ran, told = [], []

    def run(specs, *, recorded):
        for place, spec in enumerate(specs):
            if spec in fails:
                raise fails[spec]
            ran.append(spec)
            assert recorded is (spec == "held")
            yield SimpleNamespace(place=place, result=SimpleNamespace(digest="as recorded"))

    def why(digest):
        bundle = SimpleNamespace(result=SimpleNamespace(digest=digest))
        return find_why(
            SimpleNamespace(spec="same", bundle=bundle),
            SimpleNamespace(run=run),
            most=most,
            tell=lambda: told.append(ran[-1]),
        )

    if factors is None:
        with pytest.raises(CrashhuntError, match=why_not):
            why("as recorded")
    else:
        found = why("as recorded")
        assert {one.name: [run.given for run in one.runs] for one in found.factors} == factors
        assert (found.steps, found.left, found.why_not) == (50, left, why_not)
    assert (ran, told) == (["same", *runs], runs)
    assert why("another") == Why(steps=50, left=4, why_not="the trial was not the same when it was run again")


def stands(x, y=0.0, *, since=0.0, until=99.0):
    return lambda time_s: (x, y, 0.0) if since <= time_s <= until else None


def test_collision_partner_is_examined_first_and_then_the_nearest():
    found = recording(
        {
            "ego": stands(0.0), "learner": stands(1.0), "far": stands(61.0), "b": stands(20.0), "a": stands(0.0, -20.0),
            "near": stands(10.0), "early": stands(5.0, until=2.0), "hit": stands(50.0),
        }, 100, agents=("ego", "learner"),
    )  # fmt: skip
    assert relevant_actors(found, "ego", "hit", 9) == ["hit", "near", "a", "b"]
    assert relevant_actors(found, "ego", "", 2) == ["near", "a"]
    assert relevant_actors(found, "ego", "gone", 1) == ["gone"]
    assert relevant_actors(recording({}, 0), "ego", "", 9) == []


def test_each_run_lacks_one_candidate_from_just_before_it_began(monkeypatch):
    planned = Disturbance(30, "ahead", "brake", 3.0, 1.0, "ego"), Disturbance(35, "behind", "speed", 0.5, 1.0, "ego")
    spec = TrialSpec(7, 11, {"ego": {"speed": 20.0, "mode": "a"}}, {"cars": 5}, 300, disturbances=planned)
    result = SimpleNamespace(
        steps=80, collision=SimpleNamespace(other="x", x=0.0, y=0.0),
        disturbances=[replace(planned[0], vehicle="x"), planned[1]],  # no vehicle was behind
    )  # fmt: skip
    space = {
        ("ego", "speed"): Range(5.0, 25.0), ("ego", "mode"): Choice(("a", "b", "c")), ("ego", "gap"): Range(1.0, 2.0),
        ("", "cars"): Range(1, 9, integer=True), ("ego", "seconds"): Constant(3),
    }  # fmt: skip
    monkeypatch.setattr(_causes, "read_settings", lambda path: SimpleNamespace(space=space))
    monkeypatch.setattr(_causes, "lanes_around_crash", lambda rerun: ())
    ways = {
        "ego": speeds((0, 5), (-3, 1)), "x": speeds((0, 2), (3, 1)), "y": stands(9.0, until=4.05), "z": stands(30.0),
    }  # fmt: skip
    search = _causes._Search(SimpleNamespace(
        bundle=SimpleNamespace(result=result, driver="ego", hunt=Path("hunt")), recorded=recording(ways, 81), spec=spec,
        defaults={("ego", "speed"): 12.0, ("", "cars"): 5},
    ))  # fmt: skip
    found = {(one.factor.kind, one.factor.name, one.factor.what): one for one in search.asked()}
    assert [*found] == [
        ("disturbance", "x", "brake"), ("agent", "ego", "braked"), ("other", "x", "sped up"),
        ("argument", "ego.speed", "default"), ("argument", "ego.speed", "drawn"), ("argument", "ego.mode", "drawn"),
        ("argument", "cars", "drawn"), ("seed", "seed", "drawn"), ("other", "x", "there"), ("other", "y", "there"),
        ("other", "z", "there"),
    ]  # fmt: skip
    assert search.steps == 210  # twice as long, and 5 s
    inside, whole = replace(spec, max_steps=130), replace(spec, max_steps=210)

    def held(what, name, *steps):
        hold = [Disturbance(n + 1, "itself", what, 0.0, (130 - n) * DT, "ego", name) for n in steps]
        return [(n, replace(inside, disturbances=(*planned, one))) for n, one in zip(steps, hold, strict=True)]

    expected = {
        "disturbance": [(29, replace(inside, disturbances=planned[1:]))],
        "agent": [(n, replace(inside, overruled=Overruled("ego", n, keeps="speed"))) for n in (50, 45, 40)],
        ("x", "sped up"): held("keep_speed", "x", 20, 15, 10),
        ("x", "there"): held("gone", "x", 50, 40, 30),
        ("y", "there"): held("gone", "y", 40, 30),  # it had left 3 s before the collision
        ("ego.speed", "default"): [(12.0, replace(whole, arguments={"ego": {"speed": 12.0, "mode": "a"}}))],
    }
    for (kind, *name), one in found.items():
        assert one.runs == expected.get(kind, expected.get(tuple(name), one.runs)), (kind, *name)
        assert (one.inside, one.held) == (kind not in ("argument", "seed"), "x" if name == ["x", "sped up"] else "")
    begun = {name: (one.factor.step, one.factor.was) for (_, *name, what), one in found.items() for name in [what]}
    assert begun["braked"] == (50, 20.0)
    assert begun["sped up"] == (20, 20.0)
    assert begun["there"] == (80, None)
    modes, cars = found["argument", "ego.mode", "drawn"], found["argument", "cars", "drawn"]
    assert sorted(modes.runs, key=str) == [
        (mode, replace(whole, arguments={"ego": {"speed": 20.0, "mode": mode}})) for mode in "bc"
    ]  # fmt: skip
    assert cars.runs == [(n, replace(whole, scenario_arguments={"cars": n})) for n, _ in cars.runs]
    assert {n for n, _ in cars.runs} <= {1, 2, 3, 4, 6, 7, 8, 9}
    assert len({n for n, _ in cars.runs}) == len(cars.runs) > 2
    assert len(found["argument", "ego.speed", "drawn"].runs) == 8
    seeds = found["seed", "seed", "drawn"].runs
    assert seeds == [(seed, replace(whole, seed=seed)) for seed, _ in seeds]
    assert len({seed for seed, _ in seeds} - {11}) == 8


COLLISION = Outcome.COLLISION, ("ego", "x"), ""


@pytest.mark.parametrize(
    ("crash", "run", "ending"),
    [
        (COLLISION, (Outcome.SURVIVED, None, ""), "none"),
        (COLLISION, (Outcome.FINISHED, None, ""), "none"),
        (COLLISION, COLLISION, "same"),
        (COLLISION, (Outcome.COLLISION, ("x", "ego"), ""), "same"),
        (COLLISION, (Outcome.COLLISION, ("ego", "y"), ""), "other"),
        (COLLISION, (Outcome.COLLISION, ("second", "y"), ""), "unclear"),  # of another agent
        (COLLISION, (Outcome.OFF_ROAD, ("second", ""), ""), "unclear"),
        (COLLISION, (Outcome.OFF_ROAD, None, ""), "other"),
        (COLLISION, (Outcome.AGENT_ERROR, None, "KeyError"), "other"),
        *((COLLISION, (outcome, None, ""), "unclear") for outcome in _causes.INCONCLUSIVE_OUTCOMES),
        ((Outcome.OFF_ROAD, None, ""), (Outcome.OFF_ROAD, None, ""), "same"),
        ((Outcome.OFF_ROAD, None, ""), COLLISION, "other"),
        ((Outcome.AGENT_ERROR, None, "KeyError"), (Outcome.AGENT_ERROR, None, "KeyError"), "same"),
    ],
)
def test_run_ends_in_the_same_crash_if_the_same_actors_collide_or_the_same_fails(monkeypatch, crash, run, ending):
    """Of a software fault, `causes` also compare its place; an omission has no candidate without an actor there."""

    def result(outcome, pair, failure):
        hit = None if pair is None else Collision(pair[0], "collider", *pair)
        return SimpleNamespace(outcome=outcome, collision=hit, failure=failure)

    monkeypatch.setattr(_causes, "signature_of_fault", lambda result: result.failure)
    for module in (_causes, _omissions):
        search = object.__new__(module._Search)
        search._result, search._recording, search._agent = result(*crash), None, "ego"
        ended = SimpleNamespace(place=0, result=result(*run), recording=None)
        if module is _omissions:
            assert search._ending(ended.result) == ending
        else:
            asked = _causes._Candidate(Factor("seed", "seed", "drawn"), [(5, "spec")])
            assert search.ending(asked, 0, ended) == LeftOut(5, ending)
    if run[2]:  # at another place
        search = object.__new__(_causes._Search)
        search._result = result(crash[0], None, "another")
        assert search._is_same(result(*run)) is False
