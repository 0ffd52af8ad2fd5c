"""The compiled core: every bit as without it, and out of the way where it cannot be trusted."""

from __future__ import annotations

import itertools
import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from conftest import examples
from hypothesis import given, settings, strategies as some
from sumo_runs import SumoRuns

from crashhunt.agents import KeepLaneWithSpeed
from crashhunt.native import _core, core_for, why_not
from crashhunt.oracles import OffRoad, Overlap, ReportedCollision
from crashhunt.oracles._included_oracles import _within_reach
from crashhunt.recording import BlackBox
from crashhunt.scenario import ObservationSetup, argument_values, load_scenario
from crashhunt.simulators import Kinematics
from crashhunt.sumo import SumoSetup
from crashhunt.trial import CRASHES, TrialSpec
from crashhunt.world import Actor, ApproachMeter, DangerMeter, Roster, Scene, approaches, joined_frame
from crashhunt.world._danger import _Way
from crashhunt.world._tracks import Reach, ways

core = pytest.importorskip("_crashhunt_core", reason="the compiled core is not built")

coordinates = some.floats(-60, 60) | some.sampled_from([0.0, -0.0, 5.0, 1e-9, 9e8])
headings = some.floats(-7, 7) | some.sampled_from([0.0, math.pi / 2, math.pi, 1e6])
sizes = some.floats(0.1, 20)
vehicles = some.tuples(coordinates, coordinates, headings, some.floats(-5, 60), sizes, sizes)
movements = some.tuples(some.floats(-4, 4), some.floats(-4, 4), some.floats(-0.5, 0.5), some.floats(-1, 1))


@some.composite
def two_scenes(draw):
    first = draw(some.lists(vehicles, min_size=1, max_size=8))
    moved = [draw(movements) for _ in first]
    roster = Roster(tuple(Actor(str(row), "passenger", size[4], size[5]) for row, size in enumerate(first)))
    pairs, found = list(zip(first, moved, strict=True)), []
    for share in (0, 1):
        rows = [[place + share * step for place, step in zip(one[:4], by, strict=True)] for one, by in pairs]
        points, angles, speeds = [(x, y) for x, y, *_ in rows], [row[2] for row in rows], [row[3] for row in rows]
        found.append(Scene(100.0 + share / 10, roster, points, angles, speeds, swept=True))
    return found


def columns_of(scene):
    """The numbers of a scene as the core has them."""
    roster = scene.roster
    sizes = core.Vehicles((), roster.lengths, roster.widths, roster.reaches)
    return core.columns(sizes, scene.points, scene.headings, scene.speeds)


def both_ways(scene, call):
    """What comes of a call with the core, and without."""
    scene._neighbors.clear()
    scene.core = core
    for one in filter(None, (scene, scene.previous)):
        one.columns = columns_of(one)
    with_it = call()
    scene._neighbors.clear()
    scene.core = None
    return with_it, call()


@settings(deadline=None, max_examples=examples(60))
@given(two_scenes(), some.integers(1, 10), some.floats(-1e4, 1e4))
def test_an_observation_is_the_same_bit_by_bit(scenes, rows, place):
    kinematics = Kinematics(ObservationSetup(vehicles=rows))
    where = {"distance": place, "from_left": place / 3, "lateral_speed": -place, "lanes": 2}
    for row in range(len(scenes[1].points)):
        ours, theirs = both_ways(scenes[1], lambda row=row: kinematics.observe(scenes[1], row, **where))
        assert ours.tobytes() == theirs.tobytes()
        assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape)


@settings(deadline=None, max_examples=examples(60))
@given(two_scenes())
def test_the_same_are_within_reach(scenes):
    previous, scene = scenes
    scene.follow(previous)
    for row in range(len(scene.points)):
        ours, theirs = both_ways(scene, lambda row=row: _within_reach(scene, previous, row))
        assert ours == theirs


@settings(deadline=None, max_examples=examples(60))
@given(two_scenes(), some.randoms(use_true_random=False), some.integers(0, 3))
def test_the_same_are_within_reach_where_actors_come_and_go(scenes, rng, missing):
    first, scene = scenes
    rows = rng.sample(range(len(first.points)), max(0, len(first.points) - missing))
    roster = Roster(tuple(first.roster.actors[row] for row in rows))
    columns = [[values[row] for row in rows] for values in (first.points, first.headings, first.speeds)]
    previous = Scene(first.time_s, roster, *columns, swept=True)
    scene.follow(previous)
    for row in range(len(scene.points)):
        ours, theirs = both_ways(scene, lambda row=row: _within_reach(scene, previous, row))
        assert ours == theirs


def test_earlier_rows_are_checked():
    pair = lists_of([1.0, 2.0])
    for rows, error in (([0], TypeError), ((0, 1), TypeError), ([0, 2], IndexError), ([0, -2], IndexError)):
        with pytest.raises(error):
            core.within_reach(pair, pair, 0, 0.1, 10.0, rows)
    with pytest.raises(TypeError):
        core.within_reach(pair, pair, 0, 0.1, 10.0, [0, "1"])


def test_a_heading_beyond_north_is_no_turn_around():
    # Seen from SUMO's angles, north is where headings jump by a whole turn; nobody there reaches further for it.
    roster = Roster(tuple(Actor(name, "passenger", 5.0, 2.0) for name in "ab"))
    was = Scene(0.0, roster, [(0.0, 0.0), (0.0, 5.6)], [math.pi / 2] * 2, [0.0, 0.0])
    now = Scene(0.1, roster, [(0.0, 0.0), (0.0, 5.6)], [math.pi / 2 - math.tau] * 2, [0.0, 0.0])
    now.follow(was)
    for row in (0, 1):
        ours, theirs = both_ways(now, lambda row=row: _within_reach(now, was, row))
        assert ours == theirs == []


def test_who_has_got_as_far_away_as_anybody_can_is_within_reach():
    # Back to back: bumpers 12.35 m apart, which is all that length and hard braking allow, and they touched before.
    roster = Roster(tuple(Actor(name, "passenger", 5.0, 2.0) for name in "ab"))
    was = Scene(0.0, roster, [(0.0, 0.0), (8.35, 0.0)], [math.pi, 0.0], [0.0, 0.0])
    now = Scene(0.1, roster, [(0.0, 0.0), (12.35, 0.0)], [math.pi, 0.0], [0.0, 0.0])
    now.follow(was)
    ours, theirs = both_ways(now, lambda: _within_reach(now, was, 0))
    assert ours == theirs == [1]


def test_an_actor_is_within_reach():
    roster = Roster(tuple(Actor(name, "passenger", 5.0, 2.0) for name in "abc"))
    was = Scene(0.0, roster, [(0.0, 0.0), (8.0, 0.0), (90.0, 0.0)], [0.0] * 3, [30.0, 0.0, 0.0])
    now = Scene(0.1, roster, [(3.1, 0.0), (8.0, 0.0), (90.0, 0.0)], [0.0] * 3, [30.0, 0.0, 0.0], core=core)
    was.columns, now.columns = columns_of(was), columns_of(now)
    assert core.within_reach(now.columns, was.columns, 0, 0.1, 10.0, None) == [1]
    assert _within_reach(now, was, 0) == [1]


@settings(deadline=None, max_examples=examples(80))
@given(some.lists(two_scenes(), min_size=1, max_size=3))
def test_the_closest_approach_is_the_same_bit_by_bit(episodes):
    for scene in itertools.chain(*episodes):  # as if many were one: rosters differ
        scene.points[0] = (scene.points[0][0] % 100, scene.points[0][1] % 100)
    agent = "0"
    frames = [joined_frame(one.roster, np.concatenate([one.frame.columns, two.frame.columns]), [None] * 2)
              for one, two in episodes]  # fmt: skip
    ours, theirs = approaches([frame._replace(core=core) for frame in frames], agent), approaches(frames, agent)
    for mine, reference in zip(ours, theirs, strict=True):
        assert mine.tobytes() == reference.tobytes()


def test_of_many_far_away_no_one_is_looked_at():
    near = [(0.0, 0.0), (30.0, 0.0), (400.0, 3.0), (90.0, 60.0)]
    frame = np.array([[*itertools.chain(*near), 0.0, 0.0, 0.0, 0.0, 20.0, 5.0, 20.0, 20.0]] * 2)

    def found(row, *so_far, columns=frame):
        part = (columns, row, [5.0] * 4, [2.0] * 4, [0, 1, 2, 3])
        return core.may_be_near([part], 50.0, 10.0, *(so_far or (math.inf, math.inf, 0.0)), False)

    numbers, places = found(0)
    ahead = [0.0, 0.0, 0.0, 20.0, 2.5, 1.0], [30.0, 0.0, 0.0, 5.0, 2.5, 1.0]
    assert np.frombuffer(numbers).reshape(6, -1).T.tolist() == [*ahead, *ahead]
    assert np.frombuffer(places, np.int64).reshape(2, -1).tolist() == [[0, 0, 1, 1], [0, 0, 2, 2]]
    assert found(0, 1.0, 1.0, 9.0) == (b"", b"")  # it was nearer before
    for nearer in ((27.0, 1.0, 9.0), (1.0, 9.0, 9.0), (1.0, 1.0, 4.0)):
        assert found(0, *nearer) == (numbers, places)
    assert found(2) == found(-1) == (b"", b"")
    assert found(0, columns=frame.astype(np.float32)) is None
    for odd in (4, -2, 2**40):
        assert found(odd) is None


def test_the_one_that_is_near_enough_leaves_out_those_further_away():
    # Outlines 45.6 m and 49.5 m away, and within 50 m it is the one ahead that is nearest, by 49 m at the most.
    frame = np.array([[0.0, 0.0, 51.0, 0.0, 0.0, 54.9, *[0.0] * 3, *[9.0] * 3]])
    part = (frame, 0, [5.0] * 3, [2.0] * 3, [0, 1, 2])
    numbers, _ = core.may_be_near([part], 50.0, 10.0, math.inf, math.inf, 0.0, False)
    assert np.frombuffer(numbers).reshape(6, -1)[:2].T.tolist() == [[0.0, 0.0], [51.0, 0.0]]


def test_scenes_without_the_agent_count_and_others_keep_their_numbers():
    frame = np.array([[0.0, 0.0, 9.0, 0.0, 0.0, 0.0, 5.0, 5.0]] * 2)
    part = (frame, 1, [5.0] * 2, [2.0] * 2, [7, 4])
    for absent in ((frame, -1, *part[2:]), (np.zeros((2, 0)), -1, [], [], [])):
        _, places = core.may_be_near([absent, part, absent], 50.0, 10.0, math.inf, math.inf, 0.0, False)
        assert np.frombuffer(places, np.int64).reshape(2, -1).tolist() == [[2, 2, 3, 3], [0, 0, 2, 2]]
        (_, steps), (_, others) = core.tracks([absent, part, absent], 1, 20.0, 0.0, 0.0, 0.0)
        assert np.frombuffer(steps, np.int64).tolist() == [2, 3]
        assert np.frombuffer(others, np.int64).reshape(2, -1).tolist() == [[0, 1], [7, 7]]
        sizes = core.Vehicles(("a", "b"), [5.0] * 2, [2.0] * 2, [5.1] * 2)
        assert core.tracks([(frame, 1, sizes, None, [7, 4])], 1, 20.0, 0.0, 0.0, 0.0) == core.tracks(
            [part], 1, 20.0, 0.0, 0.0, 0.0
        )
        assert core.may_be_near([(frame, 1, sizes, None, None)], 50.0, 10.0, math.inf, math.inf, 0.0, False) == (
            core.may_be_near([part], 50.0, 10.0, math.inf, math.inf, 0.0, False)
        )


def test_a_part_that_is_not_whole_is_left_to_python():
    whole = [np.zeros((2, 8)), 0, [5.0] * 2, [2.0] * 2, [0, 1]]
    odd = {
        0: [np.zeros(12), np.zeros((2, 8), np.int64), np.zeros((4, 8))[::2]], 1: [-2, 2],
        2: [[5.0], [5.0] * 3], 3: [[2.0], [2.0] * 3, [2.0, 2]], 4: [[0], [0, 1, 2], (0, 1)],
    }  # fmt: skip
    for place, instead in odd.items():
        for one in instead:
            part = (*whole[:place], one, *whole[place + 1 :])
            assert core.may_be_near([part], 50.0, 10.0, math.inf, math.inf, 0.0, False) is None
            assert core.tracks([part], 1, 20.0, 0.0, 0.0, 0.0) is None
    for every in (0, -1):
        assert core.tracks([tuple(whole)], every, 20.0, 0.0, 0.0, 0.0) is None


@settings(deadline=None, max_examples=examples(60))
@given(some.lists(two_scenes(), min_size=1, max_size=4), some.sampled_from([0.1, 0.3, 0.9]))
def test_the_ways_that_were_driven_are_the_same(episodes, step_length_s):
    frames = [joined_frame(one.roster, np.concatenate([one.frame.columns, two.frame.columns]), [None] * 2)
              for one, two in episodes]  # fmt: skip
    for agent in ("0", "3", "nobody"):
        ours = ways([frame._replace(core=core) for frame in frames], agent, 100.0, step_length_s)
        theirs = ways(frames, agent, 100.0, step_length_s)
        assert repr_of(ours) == repr_of(theirs)


def driven(seed, scenes=60, cars=14, step_s=0.1, way=1):
    """An agent on a winding way, those beside it, those who cross it and some who stand about."""
    draw = np.random.default_rng(seed)
    at, turns = np.zeros(2), draw.uniform(-0.04, 0.04, scenes) * draw.integers(0, 2)
    angle, speed = float(draw.uniform(-3.2, 3.2)), float(draw.choice([0.0, 3.0, 12.0, 30.0]))
    own = []
    for turn in turns:
        angle = (angle + turn + math.pi) % math.tau - math.pi  # as SUMO's, they jump somewhere
        at = at + way * speed * step_s * np.array([math.cos(angle), math.sin(angle)])
        own.append((*at, angle, speed))
    middle = np.array(own[scenes // 2][:2])
    rows = [own]
    for _ in range(cars):
        start, heading = (
            middle + draw.normal(0, 25, 2),
            float(draw.choice([angle, angle + math.pi, draw.uniform(-3, 3)])),
        )
        fast = float(draw.choice([0.0, 2.0, 10.0, 20.0]))
        way = np.arange(scenes)[:, None] * fast * step_s * np.array([math.cos(heading), math.sin(heading)])
        rows.append([(*(start + moved), heading, fast) for moved in way])
    sizes = [(float(draw.choice([0.6, 4.5, 12.0])), float(draw.choice([0.6, 1.8, 2.5]))) for _ in rows]
    roster = Roster(tuple(Actor(str(row), "passenger", *size) for row, size in enumerate(sizes)))
    values = np.array(rows).transpose(1, 0, 2)  # scene, actor, value
    columns = np.concatenate([values[:, :, :2].reshape(scenes, -1), values[:, :, 2], values[:, :, 3]], axis=1)
    return [joined_frame(roster, part, [None] * len(part)) for part in np.split(columns, [scenes // 3])]


def test_the_danger_is_the_same_bit_by_bit():
    found, kept, all_of_them = [], 0, 0
    for seed in [*range(16), 22, 43]:
        frames = driven(seed, way=-1 if seed >= 16 else 1)  # the last ones reverse
        ours, theirs = (DangerMeter(["0"], 0.1) for _ in range(2))
        ours.add([frame._replace(core=core) for frame in frames])
        theirs.add(frames)
        assert ours.danger == theirs.danger
        found.append(ours.danger)
        if seed >= 16:
            continue  # the core looks straight on, and is not asked to leave anybody out
        fast = [frame._replace(core=core) for frame in frames]
        _, some_others, _ = ways(fast, "0", 100.0, 0.1, Reach(100.0, 30.0, 10.0))
        track, others, _ = ways(frames, "0", 100.0, 0.1)
        way = _Way(track, flat=True)
        touched = np.isfinite(np.minimum(*way.first_contacts(others)))
        left = set(zip(some_others.sample.tolist(), some_others.who.tolist(), strict=True))
        assert left.issuperset(zip(others.sample[touched].tolist(), others.who[touched].tolist(), strict=True))
        kept, all_of_them = kept + len(left) - int(touched.sum()), all_of_them + len(others.sample)
    assert 0.0 in found
    assert max(found) > 0.2
    assert kept < all_of_them / 20  # of those who are not touched


def test_the_closest_of_many_scenes_is_the_same_bit_by_bit():
    kept, found = 0, []
    for seed in range(100, 100 + examples(50)):
        frames = driven(seed)
        ours, theirs = ApproachMeter(["0"]), ApproachMeter(["0"])
        for frame in frames:  # the second knows of the first
            ours.measure([frame._replace(core=core)])
            theirs.measure([frame])
            assert ours.closest == theirs.closest
        found.append(ours.closest)
        parts = [(frame.columns, 0, frame.roster.lengths, frame.roster.widths, None) for frame in frames]
        numbers, _ = core.may_be_near(parts, 50.0, 10.0, math.inf, math.inf, 0.0, True)
        kept += len(numbers) // 48
    assert any(one.gap_m == 0 for one in found)
    assert any(one.gap_m > 1 and one.time_to_collision_s < 5 for one in found)
    assert any(one.required_deceleration > 1 for one in found)
    assert kept < len(found) * 8  # two rows are the least there can be: one for the agent, one for who is nearest


def repr_of(seen):
    return seen and [[column.tolist() for column in part] for part in seen[:2]] + [seen[2]]


@pytest.mark.nightly
@settings(deadline=None, max_examples=examples(60))
@given(some.lists(two_scenes(), min_size=2, max_size=4))
def test_the_closest_until_then_leaves_out_nothing(episodes):
    ours, theirs = ApproachMeter("0"), ApproachMeter("0")
    for one, two in episodes:
        both = np.concatenate([one.frame.columns, two.frame.columns])
        theirs.measure([joined_frame(one.roster, both, [None] * 2)])
        ours.measure([joined_frame(one.roster, both, [None] * 2, core)])
    assert repr(ours.closest) == repr(theirs.closest)


def test_the_closest_of_a_crowd_is_the_same_where_an_actor_is_wider_than_long():
    sizes = [(1.0, 1.0), (1.0, 1.0), (1.0, 2.0), (1.0, 12.0)]
    roster = Roster(tuple(Actor(str(row), "passenger", *size) for row, size in enumerate(sizes)))
    columns = np.array([[0.0] * 6 + [5.0, 0.0] + [0.0] * 4 + [1.0, 0.0, 0.0, 0.0]])
    ours, theirs = ApproachMeter("0"), ApproachMeter("0")
    ours.measure([joined_frame(roster, columns, [None], core)])
    theirs.measure([joined_frame(roster, columns, [None])])
    assert ours.closest == theirs.closest
    assert ours.closest.gap_m == 0.0


@pytest.mark.parametrize("odd", [math.nan, math.inf, -1e12, 1e155])
@pytest.mark.parametrize("place", ["x", "heading", "speed"])
def test_of_numbers_that_no_traffic_has_comes_what_comes_without(odd, place):
    other = {"x": 5.5, "heading": 0.0, "speed": 3.0}
    roster = Roster(tuple(Actor(name, "passenger", 5.0, 2.0) for name in "ab"))
    before, now = (
        Scene(time_s, roster, [(0.0, 0.0), (x, 0.0)], [0.0, heading], [9.0, speed], swept=True)
        for time_s, (x, heading, speed) in ((0.0, other.values()), (0.1, (other | {place: odd}).values()))
    )
    part = (now.frame.columns, 0, roster.lengths, roster.widths, [0, 1])
    assert core.may_be_near([part], 50.0, 10.0, math.inf, math.inf, 0.0, True) is None
    assert core.tracks([part], 1, 20.0, 0.0, 0.0, 0.0) is None
    now.follow(before)
    kinematics = Kinematics(ObservationSetup(vehicles=3))
    where = {"distance": 1.0, "from_left": 2.0, "lateral_speed": 0.0, "lanes": 2}
    for ask in (lambda: _within_reach(now, before, 0), lambda: kinematics.observe(now, 0, **where).tobytes()):
        ours, theirs = both_ways(now, lambda ask=ask: said(ask))
        assert ours == theirs


def said(ask):
    """What comes of a call, such as an error."""
    try:
        return ask()
    except (OverflowError, ValueError) as error:
        return repr(error)


@settings(deadline=None, max_examples=examples(60))
@given(two_scenes(), some.lists(some.floats(), max_size=3), some.integers(0, 2**40))
def test_the_record_of_a_step_is_the_same(tmp_path_factory, scenes, rewards, step):
    rewards, scene = tuple(rewards), scenes[0]

    def record():
        box = BlackBox(tmp_path_factory.getbasetemp() / "box.bin")
        box.begin(pid=1, trial=0, started=0.0)
        box.prologue(b"", len(rewards))
        box.step(step, scene, rewards)
        written, where = bytes(box.committed()), (bytes(box._map[:64]), box._offset, box._trail[0][1])
        box.close()
        return written, where

    ours, theirs = both_ways(scene, record)
    assert ours == theirs


def lists_of(speeds):
    """Columns in which only speeds differ."""
    sizes = core.Vehicles((), *[[1.0] * len(speeds)] * 3)
    return core.columns(sizes, [(0.0, 0.0)] * len(speeds), [0.0] * len(speeds), speeds)


@given(some.lists(some.tuples(some.floats(-50, 50), some.floats(-50, 50)), max_size=20))
def test_the_least_change(pairs):
    earlier, later = [one for one, _ in pairs], [two for _, two in pairs]
    expected = min((two - one for one, two in pairs), default=0.0)
    assert core.least_change(lists_of(earlier), lists_of(later)) == expected


@given(two_scenes())
def test_what_goes_in_comes_out(scenes):
    found = columns_of(scenes[0])
    assert (found.points, found.headings, found.speeds) == (scenes[0].points, scenes[0].headings, scenes[0].speeds)
    assert [found.speed(row) for row in range(len(found.speeds))] == found.speeds
    for row in (-1, len(found.speeds)):
        with pytest.raises(IndexError):
            found.speed(row)


@pytest.mark.parametrize("odd", [math.nan, 1, None, "1", 10**400])
def test_what_the_core_does_not_know_is_left_to_python(odd):
    points, numbers = [(0.0, 0.0), (9.0, 0.0)], [1.0, 2.0]
    sizes = core.Vehicles((), numbers, numbers, numbers)
    plain = core.columns(sizes, points, numbers, numbers)
    if odd is math.nan:
        strange = core.columns(sizes, [(0.0, 0.0), (odd, 0.0)], numbers, numbers)
        assert core.observe(strange, 0, 4, 1.0, 1.0, 0.0) is None
        assert core.within_reach(strange, plain, 0, 0.1, 10.0, None) is None
        assert core.within_reach(plain, strange, 0, 0.1, 10.0, None) == []
        assert core.least_change(lists_of(numbers), lists_of([1.0, odd])) is None
    else:
        assert core.columns(sizes, [(0.0, 0.0), (odd, 0.0)], numbers, numbers) is None
        assert core.columns(sizes, points, [1.0, odd], numbers) is None
        with pytest.raises(TypeError, match="lists of floats"):
            core.Vehicles((), numbers, numbers, [1.0, odd])
    for rows in ([], numbers[:1], tuple(numbers)):
        assert core.columns(sizes, points, rows, numbers) is None
        assert core.columns(sizes, points, numbers, rows) is None
        for place in range(3):
            with pytest.raises(TypeError, match="as many of each"):
                core.Vehicles((), *[rows if place == other else numbers for other in range(3)])
    alone = core.columns(sizes, points[:1], [1.0], [1.0])  # of two, whose sizes are known
    assert core.observe(alone, 0, 4, 1.0, 1.0, 0.0) is None
    assert core.within_reach(alone, alone, 0, 0.1, 10.0, None) is None
    assert core.within_reach(alone, lists_of([1.0]), 0, 0.1, 10.0, None) is None
    assert core.within_reach(lists_of([1.0]), alone, 0, 0.1, 10.0, None) is None
    assert core.within_reach(plain, lists_of([1.0]), 0, 0.1, 10.0, None) is None
    assert core.least_change(alone, plain) is None
    for row in (-1, 2):
        assert core.observe(plain, row, 4, 1.0, 1.0, 0.0) is None
        assert core.within_reach(plain, plain, row, 0.1, 10.0, None) is None
    for wrong in (None, sizes, [plain]):
        with pytest.raises(TypeError, match="columns"):
            core.least_change(plain, wrong)


def test_what_is_too_large_for_single_precision_is_an_error_as_in_python():
    assert core.observe(lists_of([0.0]), 0, 2, 1e39, 0.0, 0.0) is None
    with pytest.raises(OverflowError):
        struct.pack("<f", 1e39)


def test_it_is_used_only_where_it_is_known(monkeypatch):
    from libsumo import _libsumo

    assert core_for("1.28.0", _libsumo.__file__) is core
    assert core_for("1.28.1", _libsumo.__file__) is None
    assert why_not("1.28.0") == ""
    assert "1.27.0" in why_not("1.27.0")
    assert core_for("1.27.0", "/nowhere") is None
    assert core_for("1.28.0", "/nowhere") is None  # libsumo is elsewhere
    monkeypatch.setattr(_core, "_INTERFACE", -1)
    assert "another version of crashhunt" in why_not("1.28.0")
    monkeypatch.setattr(_core, "_MODULE", "_no_such_core")
    _core._load_module.cache_clear()
    try:
        assert why_not("1.28.0") == "it is not built"
    finally:
        _core._load_module.cache_clear()


class _Lies:
    """A core with one function that says something else."""

    def __init__(self, name, instead):
        setattr(self, name, instead)

    def __getattr__(self, name):
        return getattr(core, name)


def _nearly(observation):
    return observation[:-1] + bytes([observation[-1] ^ 1])


class _Moved:
    def __init__(self, ids, *sizes):
        self._vehicles = core.Vehicles(ids, *sizes)

    def read(self):
        found = self._vehicles.read()
        angles = [*found.headings[:-1], math.nextafter(found.headings[-1], 10.0)]
        return core.columns(self._vehicles, found.points, angles, found.speeds)

    def look(self, *_):
        return None


class _Hasty:
    """Sees that all is as before where somebody has just come."""

    def __init__(self, *given):
        self._vehicles = core.Vehicles(*given)
        self.read = self._vehicles.read

    def look(self, *_):
        return self._vehicles.read()


class _Crowded(_Hasty):
    def look(self, *_):
        return ("ego", "nobody")


def _blind(eyes, squared):
    ids, points = core.in_sight(eyes, squared)
    return ids[:-1], points


LIES = {
    "in_sight": _blind,
    "nothing": None,
    "observe": lambda *given: _nearly(core.observe(*given)),
    "Vehicles": _Moved,
    "Vehicles, seen at once": _Hasty,
    "Vehicles, others than before": _Crowded,
    "is_coming_or_going": lambda: not core.is_coming_or_going(),
    "vehicle_states": lambda vehicles: [
        (lane, aside, 1.0, *rest) for lane, aside, _, *rest in core.vehicle_states(vehicles)
    ],
}


def trials_of(runs):
    """Return a function that runs a trial with the core or without it."""

    def trial(scenario, *, native, steps=60, lie=None, speed=15.0, seed=5, parts=(), agent=None, **arguments):
        chosen = load_scenario(scenario)
        if parts:
            setups = {name: replace(one, observation=parts, action="continuous") for name, one in chosen.agents.items()}
            chosen = replace(chosen, agents=setups)
        simulator = runs.open(chosen.with_table(replace(chosen.table(SumoSetup), native=native)))
        assert (simulator._sight.core is core) == (native is None)
        if lie is not None and LIES[lie] is not None:
            simulator._sight.core = _Lies(lie.partition(",")[0], LIES[lie])
        driver, oracles = agent or KeepLaneWithSpeed(speed), [ReportedCollision(), Overlap(), OffRoad()]
        spec = TrialSpec(0, seed, {}, {**argument_values(chosen), **arguments}, steps)
        result, _ = runs.record(simulator, spec, driver, oracles=oracles, crash_on=CRASHES)
        return replace(result, setup_s=0.0, wall_s=0.0), simulator

    return trial


@pytest.fixture
def run(sumo_runs):
    return trials_of(sumo_runs)


@pytest.fixture(scope="module")
def plain_result(tmp_path_factory):
    """The result of three steps of the scenario `loop` without the core."""
    with SumoRuns(tmp_path_factory.mktemp("plain")) as runs:
        return trials_of(runs)("loop", native=False, steps=3, vehicles=12)[0]


PARTS = ("ego", "actors", "lanes", "route", "route_state", "signals", "right_of_way", "stop_line", "lidar2d")

WRITTEN_AGAIN = (
    "ego",
    "actors",
    "lanes",
    "route",
    "signals",
    "right_of_way",
)  # in most steps, the core needs no Python


class _StopsAndGoes:
    """Stops again and again, with which steps are handed back to Python after they have been observed."""

    def reset(self, seed):
        self.steps, self.received = 0, []

    def act(self, observation):
        self.steps += 1
        self.received.append(
            [(name, one.shape, one.dtype, one.flags.writeable, one.tobytes()) for name, one in observation.items()]
        )
        return (0.0 if self.steps % 50 > 20 else 12.0), 0


@pytest.mark.parametrize(
    ("scenario", "parts"),
    [
        ("intersection", PARTS),
        ("intersection", WRITTEN_AGAIN),
        pytest.param("loop", WRITTEN_AGAIN, marks=pytest.mark.nightly),
        ("motorway", ("actors:rows=3:radius=60", "lanes:lanes=2:points=9:spacing=3.3", "route:points=200", "ego")),
        ("loop-two-agents", ("ego", "actors", "lanes:lanes=30:behind=0")),
        ("intersection", ("ego", "actors:relation=true", "speed_limit")),
        ("loop", ("ego", "actors", "grid:rows=9:columns=9", "history:steps=2")),
        ("motorway", ("ego", "actors", "occlusion")),
    ],
)
def test_parts_of_observations_are_the_same_bit_by_bit(run, scenario, parts):
    agents = _StopsAndGoes(), _StopsAndGoes()
    (ours, simulator), (theirs, _) = (
        run(scenario, native=native, steps=100, parts=parts, agent=agent)
        for native, agent in zip((None, False), agents, strict=True)
    )
    assert simulator._sight.core is core
    assert agents[0].received == agents[1].received
    assert not simulator.notices
    assert ours == theirs
    assert ours.steps > 30
    # An episode with one agent runs its uneventful steps in the core.
    assert (simulator.at_once is not None) == (scenario != "loop-two-agents")
    assert simulator.at_once is None or simulator.at_once.core.step > 30


@pytest.mark.parametrize("scenario", ["loop", "loop-two-agents"])
def test_a_trial_is_the_same_bit_by_bit(run, scenario):
    steps = 250 if scenario == "loop" else 120
    (ours, simulator), (theirs, _) = (run(scenario, native=native, steps=steps) for native in (None, False))
    assert simulator._sight.core is core
    assert not simulator.notices
    assert ours == theirs
    assert ours.steps > 30


@pytest.mark.parametrize("lie", LIES)
def test_a_core_that_is_wrong_is_found_out_before_the_first_step(run, plain_result, lie):
    result, simulator = run("loop", native=None, steps=3, lie=lie, vehicles=12)
    assert (simulator._sight.core is None) == (LIES[lie] is not None)
    assert len(simulator.notices) == (LIES[lie] is not None)
    assert result == plain_result


def test_a_vehicle_that_has_left_is_refused_as_by_libsumo(run):
    import libsumo

    _, simulator = run("loop", native=None, steps=3)
    simulator.reset(seed=1, options={"arguments": argument_values(load_scenario("loop"))})
    try:
        nothing = [], [], []
        assert core.Vehicles(("nobody",), *nothing).read() is None
        assert core.Vehicles(("nobody",), *nothing).look(core.Vehicles((), *nothing), 0.0) is None
        assert core.Vehicles((), *nothing).read().points == []
        eyes = core.Vehicles(("nobody", "ego"), *nothing)
        assert core.is_coming_or_going()
        assert core.Vehicles((), *nothing).look(eyes, 0.0) is None
        while core.is_coming_or_going():
            libsumo.simulationStep()
        everybody = core.Vehicles((), *nothing).look(eyes, math.inf)
        assert everybody == libsumo.vehicle.getIDList()
        assert core.Vehicles((), *nothing).look(eyes, 0.0).points == []
        assert len(core.Vehicles(everybody, *nothing).look(eyes, math.inf).points) == len(everybody)
        ids, (point,) = core.in_sight(eyes, 1e-9)
        assert (ids, point) == (("ego",), libsumo.vehicle.getPosition("ego"))
        assert set(core.in_sight(eyes, math.inf)[0]) == set(libsumo.vehicle.getIDList())
        libsumo.vehicle.add("ü", libsumo.vehicle.getRouteID("ego"))
        assert core.Vehicles(("ü",), *nothing).read().points == [libsumo.vehicle.getPosition("ü")]
        with pytest.raises(TypeError, match="no vehicles of the core"):
            core.in_sight("ego", 1.0)
        with pytest.raises(libsumo.TraCIException):
            libsumo.vehicle.getSpeed("nobody")
    finally:
        simulator.close()
