"""Whose fault a collision was: hand-labelled cases of real hunts, and cases that are made to fit one rule each."""

from __future__ import annotations

import gzip
import json
import math
from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import examples

from crashhunt.crashes import Bundle
from crashhunt.crashes._contact_record import ContactRecord
from crashhunt.crashes._fault import fault_in, fault_of, safe_gap_m
from crashhunt.crashes._lanes import LaneMap
from crashhunt.scenario import load_scenario
from crashhunt.trial import Collision, Outcome, TrialResult, TrialSpec
from crashhunt.world import Actor, Event, Link, RightOfWay, Roster, Scene

CASES = Path(__file__).with_name("fault_cases.json.gz")
"""Of hunts on ten shipped scenarios and in towns, with agents in which defects were planted and others that err: the
last seconds of two actors, the lanes around them, and whose fault a person said it was who saw where they were."""


@cache
def cases():
    return json.loads(gzip.decompress(CASES.read_bytes()))


class Map(LaneMap):
    """A map of lanes that keeps the borders that it was made of, so that it can be rotated."""

    def __init__(self, borders, around):
        super().__init__(borders, around)
        self.borders, self.around = borders, around


def moved(points, angle):
    """Rotate points around the origin, and shift them."""
    c, s = math.cos(angle), math.sin(angle)
    return [(c * x - s * y + 300.0, s * x + c * y - 700.0) for x, y in points]


def rotated(case, angle):
    """Return the same case where the road lies in another direction, which must change no verdict."""
    scenes = []
    for scene in case.scenes:
        points, headings = moved(scene.points, angle), [heading + angle for heading in scene.headings]
        scenes.append(Scene(scene.time_s, scene.roster, points, headings, scene.speeds, lanes=scene.lanes))
    (around,) = moved([case.lanes.around], angle)
    lanes = Map([tuple(np.array(moved(border, angle)) for border in both) for both in case.lanes.borders], around)
    rights = case.right_of_way
    if rights is not None:
        links = tuple(replace(link, shape=tuple(moved(link.shape, angle))) for link in rights.links)
        rights = replace(rights, links=links)
    return replace(case, scenes=scenes, lanes=lanes, right_of_way=rights)


def case_of(data):
    roster = Roster(tuple(Actor(name, "passenger", length, width) for name, length, width in data["actors"]))
    scenes = [
        Scene(time_s, roster, [(row[0], row[1]), (row[4], row[5])], [row[2], row[6]], [row[3], row[7]])
        for time_s, *row in data["rows"]
    ]
    lanes = [Scene(time_s, roster, [(0, 0)] * 2, [0, 0], [0, 0], lanes=both) for time_s, *both in data["lanes"]]
    started = [scene for scene in lanes if scene.time_s < scenes[0].time_s]
    by_time = {scene.time_s: scene.lanes for scene in lanes}
    for scene in scenes:
        scene.lanes = tuple(by_time.get(scene.time_s, ()))
    borders = [(np.array(right), np.array(left)) for right, left in data["borders"]]
    links = tuple(
        Link(junction, source, target, tuple(inside), signalised, tuple(map(tuple, shape)))
        for junction, source, target, inside, signalised, shape in data["links"]
    )
    return ContactRecord(
        data["actors"][0][0],
        data["actors"][1][0],
        [*started, *scenes],
        data["time_s"],
        data["began_s"],
        Map(borders, scenes[-1].points[0]),
        tuple((time_s, Event(kind, agent, what)) for time_s, kind, agent, what in data["events"]),
        RightOfWay(links, frozenset(map(tuple, data["gives_way"]))) if links else None,
        lane=data["lane"],
        swept="highway" not in data["name"] and "roundabout" not in data["name"],
    )


@pytest.mark.parametrize("each", [2, pytest.param(1, marks=pytest.mark.nightly)])
def test_what_is_said_is_what_a_person_states_or_nothing(each):
    said = [(data, fault_in(case_of(data))) for data in cases()[each - 1 :: each]]
    wrong = [
        (data["name"], data["label"], fault.to_json())
        for data, fault in said
        if fault.verdict not in (data["label"], "nobody can tell")
    ]
    assert wrong == []
    # With persons, the rules are silent unless one steps out at the last moment.
    known = [
        (data, fault) for data, fault in said if data["label"] != "nobody can tell" and data["manner"] != "pedestrian"
    ]
    assert len(said) >= 150 / each
    assert sum(fault.verdict == data["label"] for data, fault in known) >= 0.8 * len(known)
    rules = Counter(finding.rule for _, fault in said for finding in fault.findings)
    assert min(rules[name] for name in ("rear end", "lane change", "right of way")) >= 8 / each
    assert min(rules[name] for name in ("steps out", "red light", "standing")) >= 1
    manners = Counter(data["manner"] for data, _ in said)
    assert min(manners.values()) >= 5 // each
    assert manners.keys() == {
        "rear end", "side swipe", "crossing from the left", "crossing from the right", "head-on", "pedestrian",
    }  # fmt: skip


@pytest.mark.parametrize(("angle", "each"), [(0.7, 8), pytest.param(-2.6, 1, marks=pytest.mark.nightly)])
def test_what_is_said_does_not_depend_on_where_the_road_leads(angle, each):
    for case in map(case_of, cases()[::each]):
        said, again = fault_in(case), fault_in(rotated(case, angle))
        assert again.verdict == said.verdict
        assert [finding.rule for finding in again.findings] == [finding.rule for finding in said.findings]


LANES = Map(
    [(np.array([[-200.0, y - 2], [400.0, y - 2]]), np.array([[-200.0, y + 2], [400.0, y + 2]])) for y in (-4, 0, 4)],
    (0.0, 0.0),
)


def drive(ego, other, *, seconds=5.0, dt=0.1, began_s=-20.0, **more):
    """A case from functions of the time before the contact: x, y, heading and speed."""
    roster = Roster((Actor("ego", "passenger", 5.0, 2.0), Actor(more.pop("name", "other"), "passenger", 5.0, 2.0)))
    scenes = []
    for step in range(round(seconds / dt), -1, -1):
        poses = [way(step * dt) for way in (ego, other)]
        scenes.append(
            Scene(-step * dt, roster, [pose[:2] for pose in poses], [pose[2] for pose in poses],
                  [pose[3] for pose in poses])
        )  # fmt: skip
    return ContactRecord("ego", roster.actors[1].id, scenes, 0.0, began_s, more.pop("lanes", LANES), **more)


def straight(speed, at=0.0, y=0.0, *, before=None, since=0.0):
    """Drives along the x axis, where ``before`` in another lane until so many s before the contact."""
    return lambda t: (at - speed * t, y if before is None or t <= since else before, 0.0, speed)


ANGLES = (-2.6, 0.7, 2.2)


def verdict(case):
    """The verdict, which must be the same wherever the road leads; by day it leads elsewhere once."""
    found = fault_in(case).verdict
    assert {fault_in(rotated(case, angle)).verdict for angle in ANGLES[: examples(3)]} == {found}
    return found


def test_vehicle_that_enters_the_road_right_before_a_standing_one_is_not_at_fault():
    def standing(*, entered_s):
        case = drive(lambda t: (5.0, 0.0, 1.2, 0.0), straight(14))
        alone = Roster(case.scenes[0].roster.actors[:1])
        return replace(case, scenes=[
            one if one.time_s >= -entered_s else Scene(one.time_s, alone, one.points[:1], one.headings[:1],
                                                       one.speeds[:1])
            for one in case.scenes
        ])  # fmt: skip

    assert [one.rule for one in fault_in(standing(entered_s=2.0)).findings] == ["standing"]
    assert fault_in(standing(entered_s=2.0)).verdict == "the other"
    assert fault_in(standing(entered_s=0.25)).verdict == "nobody can tell"


def test_who_drives_into_the_back_of_who_was_long_ahead():
    assert verdict(drive(straight(20), straight(10, 5))) == "ego"
    assert verdict(drive(straight(10, 5), straight(20))) == "the other"
    found = fault_in(drive(straight(20), straight(10, 5))).findings[0]
    assert found.rule == "rear end"
    assert "3.5 s before, the gap was 35.0 m, and 84.5 m is safe (RSS)" in found.words
    # Too short to know, not one behind the other, or who was ahead cannot have braked so.
    assert verdict(drive(straight(20), straight(10, 5), seconds=2.0)) == "nobody can tell"
    assert verdict(drive(straight(20), straight(10, 5), began_s=-0.5)) == "nobody can tell"
    assert verdict(drive(straight(20), straight(10, 5, 2.5))) == "nobody can tell"
    wall = drive(straight(20), lambda t: (5 - 20 * max(0.0, t - 1), 0, 0, 20.0 if t > 1 else 0.0))
    assert verdict(wall) == "nobody can tell"
    assert verdict(drive(straight(20), straight(1, 5), name="person 1")) == "nobody can tell"


def test_who_changes_lanes_into_a_gap_that_is_too_short():
    cuts_in = straight(15, 5, before=4.0, since=0.8)
    found = fault_in(drive(straight(25), cuts_in))
    assert (found.verdict, found.findings[0].rule) == ("the other", "lane change")
    assert verdict(drive(cuts_in, straight(25))) == "ego"
    # Who drives behind had the time, or the gap was safe: it is not the lane change.
    assert verdict(drive(straight(25), straight(15, 5, before=4.0, since=2.9))) == "nobody can tell"
    away = straight(15, 5, before=0.0, since=0.1, y=4.0)
    assert verdict(drive(straight(25), away)) != "the other"
    assert verdict(drive(straight(25), cuts_in, lanes=Map([], (0.0, 0.0)))) == "nobody can tell"
    # Into one that stands; one that reverses comes to meet it.
    late = straight(10, before=4.0, since=0.8)
    assert fault_in(drive(late, straight(0, 5))).findings[0].rule == "lane change"
    assert verdict(drive(late, straight(-3, 5))) == "nobody can tell"


def turning_left(after_s, speed=5.0, at=5.0):
    """Drives along the x axis, and turns off to the left so many s before the contact."""

    def where(t):
        turned = max(0.0, after_s - t)
        return at + (speed * -t if t > after_s else -speed * after_s), 4.0 * turned, min(1.2, turned), speed

    return where


def test_who_drives_straight_on_into_who_is_turning_off():
    found = fault_in(drive(straight(12), turning_left(1.2, at=11.0)))
    assert (found.verdict, found.findings[0].rule) == ("ego", "rear end")
    assert "which had been ahead of it until 0.5 s before and was turning" in found.findings[0].words
    assert verdict(drive(turning_left(1.2, at=11.0), straight(12))) == "the other"
    # It has come there only lately, it left long ago, or who drove behind swerved as well.
    assert not turned_off(drive(straight(12), turning_left(1.2, at=11.0), seconds=3.0))
    assert not turned_off(drive(straight(12), turning_left(3.0, at=20.0)))

    def swerves(t):
        return -12 * t, 0.0, 0.3 * max(0.0, 1.0 - t), 12.0

    assert not turned_off(drive(swerves, turning_left(1.2, at=11.0)))
    # Who comes towards it has not been ahead of it.
    assert not turned_off(drive(straight(12), lambda t: (11 + 9 * t, 0, math.pi, 9.0)))


def turned_off(case):
    return any("was turning" in finding.words for finding in fault_in(case).findings)


def walks(since, speed=3.0, ahead=5.0):
    """Stands beside the road, and walks into the way of whoever comes so many s before the contact; 5 m long here."""
    return lambda t: (ahead, -1.5 + speed * max(0.0, since - t), math.pi / 2, speed if t < since else 0.0)


def between(case, lane="road_0"):
    for scene in case.scenes:
        scene.lanes = (lane, lane)
    return case


def test_who_steps_out_so_late_that_no_one_could_have_stopped():
    found = fault_in(between(drive(straight(12), walks(1.2), name="person 1")))
    assert (found.verdict, found.findings[0].rule) == ("the other", "steps out")
    # 0.53 s before, its middle was 2 m from the axis of the car, which is 1 m from its side.
    assert "came onto the road 0.5 s before, 8.5 m ahead of ego, which needs 21.0 m" in found.findings[0].words
    silent = [
        drive(straight(12), walks(1.2)),  # no person
        drive(straight(25), walks(4.5, speed=0.8), name="person 1"),  # it had been on the road for 2 s
        drive(straight(4), walks(1.95), name="person 1"),  # it came far enough ahead to stop
        drive(straight(2.9), walks(1.5, ahead=2.5), name="person 1"),  # who drives so slowly can stop
        drive(straight(12), walks(9.0, speed=0.0, ahead=4.0), name="person 1"),  # it walks nowhere
    ]
    assert not any(finding.rule == "steps out" for case in silent for finding in fault_in(between(case)).findings)
    # At a junction somebody may cross; and who was not seen on a road is nowhere.
    assert verdict(between(drive(straight(12), walks(1.2), name="person 1"), ":c_w0_0")) == "nobody can tell"
    assert verdict(drive(straight(12), walks(1.2), name="person 1")) == "nobody can tell"


def test_who_turns_off_behind_an_actor_has_changed_no_lanes():
    """Where it turns into the way of who stands in the junction, it leaves its lane over the side."""
    cases_by_name = {data["name"]: case_of(data) for data in cases()}
    assert not [
        finding
        for finding in fault_in(cases_by_name["town with priority 51"]).findings
        if finding.rule == "lane change"
    ]


def test_alone_it_is_the_agents_own(tmp_path):
    hit = Collision("ego", "alone", "ego", "", ("off-road",), "off the road", 1.0, 2.0)
    result = TrialResult(TrialSpec(1, 1, {"ego": {}}, {}, max_steps=9), Outcome.OFF_ROAD, 5, collision=hit)
    (finding,) = fault_of(Bundle(tmp_path, result, 1, "abc")).findings
    assert (finding.rule, finding.blames) == ("off the road", "ego")
    failed = replace(result, outcome=Outcome.AGENT_ERROR, collision=None)
    assert fault_of(Bundle(tmp_path, failed, 1, "abc")).verdict == "ego"
    assert fault_of(Bundle(tmp_path, replace(failed, outcome=Outcome.HANG), 1, "abc")).verdict == "nobody can tell"


@pytest.mark.parametrize(
    ("kind", "steps", "expected"),
    [("red_light", 40, "ego"), ("wrong_way", 40, "ego"), ("red_light", 9, "nobody can tell"),
     ("off_route", 40, "nobody can tell"), ("hard_braking", 40, "nobody can tell")],
)  # fmt: skip
def test_an_event_that_breaks_a_rule_is_the_agents_own(tmp_path, kind, steps, expected):
    event = Event(kind, "ego", "ego ran the red light 'c'")
    result = TrialResult(
        TrialSpec(1, 1, {"ego": {}}, {}, max_steps=99), Outcome(kind), steps, event=event, step_length_s=0.1
    )
    assert fault_of(Bundle(tmp_path, result, 1, "abc")).verdict == expected
    saved = Bundle(tmp_path, replace(result, step_length_s=None), 1, "abc")  # as it is read from crash.json
    recording = SimpleNamespace(prologue=SimpleNamespace(step_length_s=0.1))
    assert fault_of(saved, recording).verdict == expected


def crossing(speed):
    return lambda t: (0.0, -speed * t, math.pi / 2, speed)


def test_a_red_light_the_wrong_way_and_who_stands():
    red = Event("red_light", "ego", "ego ran a red light")
    assert verdict(drive(straight(10), crossing(8))) == "nobody can tell"
    assert verdict(drive(straight(10), crossing(8), events=((-3.0, red),))) == "ego"
    assert verdict(drive(straight(10), crossing(8), events=((-9.0, red),))) == "nobody can tell"
    wrong = Event("wrong_way", "ego", "ego drove the wrong way")
    turned = drive(lambda t: (10 + 9 * t, 0, math.pi, 9.0), straight(10), events=((-3.0, wrong),))
    assert verdict(turned) == "ego"
    assert verdict(drive(straight(5), lambda t: (5.0, 0.0, math.pi / 2, 0.0))) == "ego"
    # It has stood for less than stopping takes.
    assert verdict(drive(straight(15), lambda t: (5.0, 0.0, math.pi / 2, 0.0), seconds=3.0)) == "nobody can tell"


def test_a_red_light_is_that_of_the_junction_where_they_meet():
    """At the next one, somebody else may have ignored the light or the priority."""

    def met(lanes, *, speed=10, end="", both=False, lane=":c_1_0"):
        who = ("ego", "other") if both else ("ego",)
        events = tuple((-3.0, Event("red_light", name, f"{name} ran a red light", lane=lane)) for name in who)
        case = drive(straight(speed), crossing(8), events=events)
        for back, on in lanes.items():
            case.scenes[-back].lanes = (on, "s")
        return verdict(replace(case, lane=end))

    assert met({20: ":c_1_0", 10: "ce_0"}) == "ego"
    assert met({20: ":c_1_0", 10: ":d_0_0"}) == "nobody can tell"
    assert met({20: ":c_1_0"}, end=":d_0_0") == "nobody can tell"
    assert met({}, speed=18) == "nobody can tell"  # it has come further than junctions are wide
    assert met({}, lane="") == "ego"
    assert met({}, both=True) == "both"


def test_the_right_of_way_is_that_of_the_map():
    scenario = load_scenario("intersection")
    rights = scenario.backend.right_of_way(scenario)
    place = {(link.source, link.target): number for number, link in enumerate(rights.links)}
    major, minor = place["from-west_0", "to-east_0"], place["from-south_0", "to-north_0"]
    assert (minor, major) in rights.gives_way
    assert (major, minor) not in rights.gives_way
    left = place["from-east_1", "to-south_0"]  # across the oncoming traffic, by way of an internal junction
    assert len(rights.links[left].inside) == 2
    assert (left, major) in rights.gives_way
    assert rights.places(("from-south_0", rights.links[minor].inside[0]), 0.0, 0.0) == (minor,)
    assert rights.places(("from-south_0",), 500.0, 0.0) == ()
    assert not any(link.signalised for link in rights.links)


def test_the_right_of_way_decides_where_lanes_cross_and_no_light_does():
    ways = [
        Link("c", "w", "e", (":c_0",), False, ((-5.0, 0.0), (5.0, 0.0))),
        Link("c", "s", "n", (":c_1",), False, ((0.0, -5.0), (0.0, 5.0))),
    ]

    def said(gives, links, lanes=("w", "s")):
        case = drive(straight(10), crossing(8), right_of_way=RightOfWay(tuple(links), frozenset(gives)))
        case.scenes[-10].lanes = lanes
        return verdict(case)

    assert said({(1, 0)}, ways) == "the other"
    assert said({(0, 1)}, ways) == "ego"
    assert said({(0, 1), (1, 0)}, ways) == "nobody can tell"
    assert said({(1, 0)}, ways, ("", "s")) == "nobody can tell"

    def inside_before(speed):
        rights = RightOfWay(tuple(ways), frozenset({(1, 0)}))
        case = drive(straight(speed), crossing(2), right_of_way=rights)
        case.scenes[-40].lanes, case.scenes[-10].lanes = ("w", ":c_1"), ("w", "s")
        return verdict(case)

    rights = RightOfWay(tuple(ways), frozenset({(1, 0)}))
    for stood_s, expected in ((2.5, "the other"), (3.9, "nobody can tell"), (9.0, "ego")):
        stands = drive(
            straight(14), lambda t, s=stood_s: (0.0, -8 * max(0.0, t - s), math.pi / 2, 8.0 if t > s else 0.0),
            right_of_way=rights,
        )  # fmt: skip
        stands.scenes[-10].lanes = ("w", "s")
        assert verdict(stands) == expected
    # Who starts off while somebody is in the junction has to let it out; who drives along has not.
    assert (inside_before(2.0), inside_before(10.0)) == ("nobody can tell", "the other")
    # A vehicle that reaches over the side of its lane might not be hit inside it.
    lane = Map([(np.array([(-90, -1.6), (90, -1.6)]), np.array([(-90, 1.6), (90, 1.6)]))], (0.0, 0.0))
    silent = "nobody can tell"
    for aside, expected in ((0.4, "the other"), (0.9, silent), (-0.9, silent), (1.7, silent), (-1.7, silent)):
        case = drive(straight(10, y=aside), crossing(8), right_of_way=rights, lanes=lane)
        case.scenes[-10].lanes = ("w", "s")
        assert verdict(case) == expected
    lights = [Link(*(ways[0].junction, "w", "e"), ways[0].inside, signalised=True, shape=ways[0].shape), ways[1]]
    assert said({(1, 0)}, lights) == "nobody can tell"


def test_the_safe_gap_is_that_of_rss():
    assert safe_gap_m(20, 20) == pytest.approx(20 + 1.75 + 23.5**2 / 8 - 20**2 / 16)
    assert safe_gap_m(0, 30) == 0


@pytest.mark.parametrize("angle", ANGLES)
def test_who_meets_the_other_sideways_is_the_same_in_every_direction(angle):
    case = drive(straight(20, 1.0, 0.5), turning_left(1.2, at=11.0))
    for actor in ("ego", "other"):
        assert rotated(case, angle).meets_sideways(actor) == case.meets_sideways(actor)
