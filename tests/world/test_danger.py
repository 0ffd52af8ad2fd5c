"""The danger of steps and of trials, on ways that can be calculated, and against a search that knows nothing of it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from conftest import examples
from hypothesis import example, given, settings, strategies as st

from crashhunt.world import Actor, DangerMeter, Frame, Roster, dangers, followers_danger, outlines_overlap

LENGTH, WIDTH = 5.0, 2.0


def frame(*ways, names=("ego", "other", "third"), step_s=0.1):
    """Each way is (x, y, heading) of a front at each step."""
    arrays = [np.array(way, float) for way in ways]
    roster = Roster(tuple(Actor(name, "car", LENGTH, WIDTH) for name, _ in zip(names, arrays, strict=False)))
    places = np.stack([array[:, :2] for array in arrays], axis=1).reshape(len(arrays[0]), -1)
    headings = np.stack([array[:, 2] for array in arrays], axis=1)
    moved = [np.hypot(*np.gradient(array[:, :2], step_s, axis=0).T) for array in arrays]
    return Frame(roster, np.hstack((places, headings, np.stack(moved, axis=1))))


def straight(x, y, heading, speed, steps=100, step_s=0.1):
    far = speed * step_s * np.arange(steps)
    return np.stack((x + far * math.cos(heading), y + far * math.sin(heading), np.full(steps, heading)), axis=1)


def round_a_bend(radius, speed, steps=100, *, start=0.0, way=1):
    """To the left of a circle's middle for 1, against that for -1."""
    angle = start + way * speed * 0.1 / radius * np.arange(steps)
    return np.stack((radius * np.cos(angle), radius * np.sin(angle), angle + way * math.pi / 2), axis=1)


def level(*ways, agents=("ego",), step_s=0.1):
    return dangers([frame(*ways, step_s=step_s)], agents, step_s)


def test_in_a_queue_it_is_the_time_gap():
    steps, most = level(straight(0, 0, 0, 10), straight(15, 0, 0, 10))  # 10 m between them, at 10 m/s
    assert steps[:60] == pytest.approx(math.exp(-1 / 1.2), abs=0.02)
    assert (most.agent, most.other) == ("ego", "other")
    assert level(straight(0, 0, 0, 10), straight(25, 0, 0, 10))[0].max() == pytest.approx(math.exp(-2 / 1.2), abs=0.02)
    above = np.tile((0.0, 6.0, 0.0, 0.0), (100, 1))  # on a bridge above a road at height 0
    queue = frame(straight(0, 0, 0, 10), straight(15, 0, 0, 10))
    assert dangers([queue._replace(heights=above)], ["ego"], 0.1)[0].max() == 0.0


def test_who_closes_in_from_behind_is_a_danger_of_its_own():
    """10 m between them, at 10 m/s: as many s as the one behind is behind."""
    frames = [frame(straight(15, 0, 0, 10), straight(0, 0, 0, 10), straight(40, 0, 0, 10))]
    steps, most, total = followers_danger(frames, "ego", 0.1)
    assert steps[:60] == pytest.approx(math.exp(-1 / 1.2), abs=0.02)
    assert (most.agent, most.other) == ("ego", "other")
    meter = DangerMeter(["other"], 0.1)  # whose danger it is, to the one ahead of it
    meter.add(frames)
    assert total == pytest.approx(meter.danger, rel=0.03)
    assert followers_danger(frames, "other", 0.1)[2] == 0.0  # nobody is behind it
    faster, _, _ = followers_danger([frame(straight(40, 0, 0, 5), straight(0, 0, 0, 15))], "ego", 0.1)
    assert faster[25] > faster[5] > 0


def test_who_crosses_comes_towards_it_or_is_in_another_lane_does_not_close_in_from_behind():
    crossing = frame(straight(-50, 0, 0, 10), straight(0, -48, math.pi / 2, 10))
    beside = frame(straight(20, 0, 0, 10), straight(0, 3.5, 0, 12))
    oncoming = frame(straight(0, 0, 0, 10), straight(120, 0, math.pi, 10))
    ahead = frame(straight(0, 0, 0, 12), straight(30, 0, 0, 10))
    for one in (crossing, beside, oncoming, ahead):
        steps, most, total = followers_danger([one], "ego", 0.1)
        assert (steps.max(), total, most.other) == (0.0, 0.0, "")


def test_who_cuts_in_ahead_of_an_actor_is_closed_in_on():
    time = 0.1 * np.arange(100)
    aside = 3.5 * np.clip(time - 3, 0, 2) / 2
    cutting = np.stack((20 + 10 * time, aside, np.where((time > 3) & (time < 5), math.atan2(1.75, 10), 0)), axis=1)
    steps, most, _ = followers_danger([frame(cutting, straight(0, 3.5, 0, 12))], "ego", 0.1)
    assert steps[20] == 0.0
    assert steps[55:70].min() > 0.3
    assert most.other == "other"


def test_oncoming_traffic_in_a_bend_is_no_danger():
    steps, _ = level(round_a_bend(50, 12), round_a_bend(54, 12, start=1.5, way=-1))
    assert steps.max() == 0.0
    meets, _ = level(round_a_bend(50, 12), round_a_bend(51, 12, start=3.6, way=-1))  # in the same lane, soon
    assert meets.max() > 0.4


def test_the_one_that_reverses_continues_backwards():
    """Where its way ends, it goes straight back: whoever stands there is as near as if it were ahead."""

    def stop(speed, at):  # 1 m before somebody who stands there, and stays
        way = straight(0, 0, 0, speed)
        way[:, 0] = np.clip(way[:, 0], -30.0, 30.0)
        return level(way, straight(at, 0, 0, 0))

    forwards, _ = stop(5.0, 36.0 + 0.0)
    backwards, most = stop(-5.0, -36.0)
    assert most.other == "other"
    assert forwards.max() > 0.8
    assert backwards == pytest.approx(forwards, abs=0.02)
    away, _ = level(straight(0, 0, 0, -5), straight(20, 0, 0, -5))
    assert away.max() == 0.0  # who is ahead of one who reverses is behind it


def test_no_one_near_is_no_danger_and_no_one_there_is_unknown():
    far = frame(straight(0, 0, 0, 10), straight(0, 300, 0, 10))
    steps, most = dangers([far], ("ego",), 0.1)
    assert (steps.max(), most.danger, most.other) == (0.0, 0.0, "")
    for names, danger in ((("ego",), 0.0), (("nobody",), None), ((), None)):
        meter = DangerMeter(names, 0.1)
        meter.add([far])
        assert meter.danger == danger
    assert DangerMeter(("ego",), 0.1).danger is None


def test_that_of_a_trial_grows_with_time_and_is_that_of_the_agent_in_the_greatest():
    queue = [straight(0, 0, 0, 10, 1000), straight(15, 0, 0, 10, 1000), straight(45, 0, 0, 10, 1000)]

    def danger(steps, agents=("ego",)):
        meter = DangerMeter(agents, 0.1)
        meter.add([frame(*(way[:steps] for way in queue))])
        return meter.danger

    whole = math.exp(-1 / 1.2) * 100
    assert danger(1000) == pytest.approx(whole / (whole + 10), rel=0.02)
    assert 0 < danger(100) < danger(300) < danger(1000) < 1
    assert danger(300, ("ego", "other", "third")) == danger(300)
    assert danger(300, ("other",)) < danger(300)


def test_a_long_episode_is_measured_in_parts_that_add_up(monkeypatch):
    from crashhunt.world import _danger

    whole = frame(straight(0, 0, 0, 8, 2000), straight(20, 0, 0, 8, 2000))
    at_once, in_parts = DangerMeter(("ego",), 0.1), DangerMeter(("ego",), 0.1)
    at_once.add([whole])
    monkeypatch.setattr(_danger, "_WINDOW", 600)
    for first in range(0, 2000, 256):
        in_parts.add([whole._replace(columns=whole.columns[first : first + 256])])
    assert sum(len(part.columns) for part in in_parts._frames) < 1100
    assert in_parts.danger == pytest.approx(at_once.danger, rel=0.02)


@pytest.mark.parametrize("seed", range(12))
def test_towards_an_actor_who_stands_it_is_the_braking_that_it_takes(seed):
    """Of any size, at any angle: the place of the first touch is found by trying, and the rest is calculated.

    The agent stops 5 m before that from one step to the next, so that nothing else is a danger.
    """
    generator = np.random.default_rng(seed)
    speed, dt, count = generator.uniform(5, 15), 0.1, 200
    x, y, heading = generator.uniform(40, 70), generator.uniform(-1.2, 1.2), generator.uniform(-math.pi, math.pi)
    length, width = generator.uniform(0.5, 12), generator.uniform(0.3, 3)
    other = (x, y, heading, length, width)
    touch = next(at for at in np.arange(0, 80, 0.02) if outlines_overlap((at, 0.0, 0.0, LENGTH, WIDTH), other))
    way = straight(0, 0, 0, speed, count)
    way[:, 0] = np.minimum(way[:, 0], touch - 5)
    roster = Roster((Actor("ego", "car", LENGTH, WIDTH), Actor("other", "car", length, width)))
    both = frame(way, np.tile((x, y, heading), (count, 1)))._replace(roster=roster)
    measured, most = dangers([both], ("ego",), dt)
    checked = 0
    for step in range(3, count, 3):
        room = touch - way[step, 0]
        if way[step, 0] != speed * dt * step:
            break
        later = 3 * dt * np.arange(1, 14)  # within 4 s, as often as it is looked at
        needed = 2 * (speed * later - room) / later**2
        needed = np.where(needed * later > speed, speed**2 / (2 * room), needed)
        expected = max(0.0, float(needed.max()))
        assert 12 * measured[step] == pytest.approx(min(expected, 12 * 0.999), abs=0.02 + 0.05 * expected), (step, room)
        checked += expected > 1
    assert checked
    assert most.other == "other"


def test_who_is_meant_is_the_nearest_of_several():
    """The nearest in time; of two that are as near in time, the nearer one in space."""
    row = [straight(x, 0, 0, 10) for x in (0, 35, 20, 50)]
    steps, most = dangers([frame(*row, names=("ego", "second", "first", "third"))], ("ego",), 0.1)
    assert most.other == "first"
    assert steps[:40] == pytest.approx(math.exp(-1.5 / 1.2), abs=0.02)
    assert dangers([frame(*row[::-1], names=("third", "first", "second", "ego"))], ("ego",), 0.1)[1].other == "first"


def test_a_step_has_the_danger_of_the_sample_before_it_and_none_where_the_agent_is_gone():
    gone = frame(straight(0, 0, 0, 10, 40), straight(15, 0, 0, 10, 40))
    rest = frame(straight(55, 0, 0, 10, 40), names=("other",))
    steps, _ = dangers([gone, rest], ("ego",), 0.1)
    assert len(steps) == 80
    assert steps[:38] == pytest.approx(math.exp(-1 / 1.2), abs=0.02)
    assert not steps[40:].any()
    later = frame(straight(0, 0, 0, 10, 40), names=("other",))
    steps, most = dangers([later, gone], ("ego",), 0.1)
    assert not steps[:39].any()
    assert steps[43:75] == pytest.approx(math.exp(-1 / 1.2), abs=0.02)
    assert most.step >= 40


@pytest.mark.parametrize("start", range(-40, -20))
def test_most_critical_moment_of_long_steps_lies_in_the_step_of_its_criticality(start):
    """Between two scenes, the agent is behind an actor that crosses, and ahead of another one that follows it."""
    ways = [straight(0, 0, 0, 8, 9, 1.0), straight(35, start, math.pi / 2, 7, 9, 1.0), straight(-20, 0, 0, 9, 9, 1.0)]
    steps, most = level(*ways, step_s=1.0)
    assert steps[most.step] == most.danger > 0
    behind, closest, _ = followers_danger([frame(*ways, step_s=1.0)], "ego", 1.0)
    assert behind[closest.step] == closest.danger > 0


places = st.floats(-40, 40)
others = st.tuples(places, places, st.floats(-3.1, 3.1), st.floats(2, 20), st.floats(-0.3, 0.3))


@settings(max_examples=examples(40), deadline=None)
@example(bend=0.0, speed=5.0, ways=[(-3.0, 14.0, -1.6875, 11.0, 0.28125)])  # crosses where the way begins
@given(bend=st.floats(-0.03, 0.03), speed=st.floats(4, 14), ways=st.lists(others, min_size=1, max_size=2))
def test_it_is_what_a_search_over_time_shifts_finds(bend, speed, ways):
    """By brute force: the agent is moved along its own way in time until it overlaps the other one.

    Two cars that overlap by a hair's breadth may or may not be seen, so that the answer lies between those for whole
    cars, and for the inner part of cars.
    """
    steps = 60
    angle = bend * speed * 0.1 * np.arange(steps)
    moves = speed * 0.1 * np.stack((np.cos(angle), np.sin(angle)), axis=1)
    ego = np.column_stack((np.cumsum(moves, axis=0), angle))
    theirs = []
    for x, y, heading, pace, turning in ways:
        way = heading + turning * 0.1 * np.arange(steps)
        far = pace * 0.1 * np.stack((np.cos(way), np.sin(way)), axis=1)
        theirs.append(np.column_stack((np.array((x, y)) + np.cumsum(far, axis=0), way)))
    if any(np.hypot(*(ego - other)[:, :2].T).min() < 8 for other in theirs):
        return  # they touch in earnest, or all but
    measured, _ = level(ego, *theirs)
    whole = searched(ego, theirs, LENGTH, WIDTH, same_way=math.pi / 6 - 2 * abs(bend))
    # Behind the agent, its way is examined at places 4 m apart, from the agent to 28 m or to the last of them on the
    # known way. An actor that goes the agent's way is excluded by the place where whole cars touch, within 12 m of
    # where their inner parts do.
    driven = speed * 0.1 * np.arange(steps)
    last = driven - 4.0 * np.minimum(np.floor(driven / 4.0 - 1e-9), 7)
    first = np.ceil(last / (speed * 0.1)).astype(int)
    inner = searched(ego, theirs, 1.0, 0.8, first=first, same_way=math.pi / 6 + 12 * abs(bend))
    found = -1.2 * np.log(np.maximum(measured, 1e-9))
    sampled = np.arange(0, steps, 3)
    # The way ends; nobody knows what is beyond.
    known = found[sampled] < 0.1 * (steps - 1 - sampled) - 0.3
    assert np.all(found[sampled][known] > whole[sampled][known] - 0.15)
    assert np.all(found[sampled] < inner[sampled] + 0.15)


def searched(ego, theirs, length, width, first=None, *, same_way):
    """The least shift in time, in s, with which an overlap comes about at each step.

    Back, the search ends at the step that ``first`` has for each step. It skips actors that go the same way, up to some
    rad.
    """
    steps = len(ego)
    nearest = np.full(steps, np.inf)

    def outline(place):
        x, y, heading = place
        out = (LENGTH - length) / 2
        return x - out * math.cos(heading), y - out * math.sin(heading), heading, length, width

    for other in theirs:
        apart = np.hypot(*(ego[:, None] - other[None])[..., :2].T).T
        for step in range(0, steps, 3):
            earliest = 0 if first is None else min(step, int(first[step]))
            for at in sorted(range(earliest, steps), key=lambda at: abs(at - step)):
                if 0.1 * abs(at - step) >= nearest[step]:
                    break
                follows = at < step and math.cos(ego[at][2] - other[step][2]) >= math.cos(same_way)
                near = apart[at, step] <= 12 and not follows
                if near and outlines_overlap(outline(ego[at]), outline(other[step])):
                    nearest[step] = 0.1 * abs(at - step)
    return nearest
