"""What the oracles say of a scene: who, how fast, where, and whom they leave out."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scenes import scene

from crashhunt.oracles import (
    Finding,
    OffRoad,
    OffRoute,
    Overlap,
    RedLight,
    ReportedCollision,
    Teleport,
    TrafficEvents,
    WrongWay,
    merge_findings,
)
from crashhunt.trial import Collision, Outcome
from crashhunt.world import Actor, Contact, Event, Roster, Scene, first_contact


def hits(oracle, *scenes, agents=("ego",)):
    if len(scenes) > 1:
        scenes[-1].follow(scenes[-2])
    return [finding.collision for finding in oracle.check(scenes[-1], agents)]


def facts(hit):
    return hit.agent, hit.role, hit.collider, hit.victim, hit.collider_speed, hit.victim_speed


REAR_END = ("ego", 0, 0, 0, 5), ("other", -4, 0, 0, 12)


def test_speeds_are_those_of_collider_and_victim_the_one_that_is_asked_about():
    (hit,) = hits(Overlap(), scene(*REAR_END, time_s=3.0, lanes=("a_0", "a_1")))
    assert facts(hit) == ("ego", "victim", "other", "ego", 12, 5)
    assert (hit.seen_by, hit.kind, hit.lane, hit.x, hit.y, hit.time_s) == (("overlap",), "overlap", "a_0", 0, 0, 3)
    (hit,) = hits(Overlap(), scene(*REAR_END), agents=["other"])
    assert facts(hit) == ("other", "collider", "other", "ego", 12, 5)
    assert (hit.x, hit.lane) == (-4, "")
    two = hits(Overlap(), scene(*REAR_END), agents=["gone", "ego", "other"])
    assert [hit.agent for hit in two] == ["ego", "other"]
    assert hits(Overlap(), scene(("ego", 0, 0, 0, 1), ("other", 5, 0, 0, 1))) == []  # bumper to bumper


def test_the_lane_is_what_the_simulator_states_of_the_agent():
    view = scene(*REAR_END)
    view.agent_lanes = {"ego": "b_2"}
    (hit,) = hits(Overlap(), view)
    assert hit.lane == "b_2"
    # It touches the other after 3 m, and jumps to the next lane at the end of the step.
    before, after = (
        scene(("ego", 0, 0, 0, 10), ("other", 8, 0, 0, 0)),
        scene(("ego", 10, 3.2, 0, 10), ("other", 8, 0, 0, 0)),
    )
    before.agent_lanes, after.agent_lanes, after.time_s, after.swept = {"ego": "b_0"}, {"ego": "b_1"}, 1.0, True
    (hit,) = hits(Overlap(), before, after)
    assert (hit.lane, hit.x, hit.y) == ("b_0", pytest.approx(3), 0)
    (hit,) = hits(OffRoad(), scene(*REAR_END, off_road=("other", "gone", "ego"), lanes=("a_0", "a_1"), time_s=2.0))
    assert facts(hit)[:5] == ("ego", "alone", "ego", "", 5)
    assert (hit.kind, hit.lane, hit.seen_by, hit.time_s) == ("off_road", "a_0", ("off_road",), 2)
    (hit,) = hits(OffRoad(), scene(*REAR_END, off_road=("gone",)), agents=["gone"])
    assert math.isnan(hit.x)
    assert math.isnan(hit.y)
    assert math.isnan(hit.collider_speed)
    assert hit.lane == ""


def test_a_report_is_believed_where_the_outlines_do_not_say():
    reported = Contact("ego", "other", "junction", "", 7.0, 3.0)
    view = scene(("ego", 0, 0, 0, 5), ("other", 20, 0, 0, 1), contacts=(reported,), lanes=("a_0", "a_1"), time_s=4.0)
    for swept in (False, True):  # they are 15 m apart
        view.swept = swept
        (hit,) = hits(ReportedCollision(), view)
        assert facts(hit) == ("ego", "collider", "ego", "other", 7, 3)
        assert (hit.kind, hit.lane, hit.seen_by, hit.x, hit.time_s) == ("junction", "a_0", ("reported",), 0, 4)
    (hit,) = hits(ReportedCollision(), view, agents=["other"])
    assert facts(hit) == ("other", "victim", "ego", "other", 7, 3)
    assert (hit.lane, hit.x) == ("a_1", 20)
    assert hits(ReportedCollision(), view, agents=["third"]) == []
    assert [hit.agent for hit in hits(ReportedCollision(), view, agents=["other", "ego"])] == ["other"]  # once
    view.contacts = (Contact("ego", "", "fell", "b_0", 7.0, math.nan), reported)
    alone, hit = hits(ReportedCollision(), view)
    assert (alone.role, alone.lane, alone.collider, alone.victim) == ("alone", "a_0", "ego", "")
    assert hit.role == "collider"


def test_the_outlines_say_who_of_a_report_drove_into_which():
    reported = Contact("ego", "other", "collision", "c_0", 7.0, 3.0)
    before = scene(("ego", 0, 0, 0, 5), ("other", -7, 0, 0, 12), time_s=1.0)
    after = scene(("ego", 5, 0, 0, 5), ("other", 5, 0, 0, 12), time_s=2.0, contacts=(reported,), swept=True)
    (hit,) = hits(ReportedCollision(), before, after)
    assert facts(hit) == ("ego", "victim", "other", "ego", 12, 5)
    assert hit.time_s == pytest.approx(1 + 2 / 7)
    assert (hit.kind, hit.lane, hit.seen_by) == ("collision", "c_0", ("reported",))
    (hit,) = hits(ReportedCollision(), before, after, agents=["other"])
    assert facts(hit) == ("other", "collider", "other", "ego", 12, 5)
    after.swept = False
    assert facts(hits(ReportedCollision(), before, after)[0]) == ("ego", "collider", "ego", "other", 7, 3)
    after.swept = True
    after.contacts = (Contact("ego", "gone", "collision", "", 7.0, 3.0),)
    assert facts(hits(ReportedCollision(), before, after)[0]) == ("ego", "collider", "ego", "gone", 7, 3)


def test_the_nearest_comes_first():
    (first, second) = hits(Overlap(), scene(("ego", 0, 0, 0, 1), ("a", 4.5, 0, 0, 1), ("b", 3, 1, 0, 1)))
    assert (first.victim, second.victim) == ("b", "a")


def test_a_bent_one_is_looked_at_with_all_its_parts():
    """Its front is 30 m away, and its back blocks the street."""
    spine = ((40.0, 30.0, 0.0), (40.0, 2.0, 0.0), (40.0, -1.0, 0.0))
    roster = Roster((Actor("ego", "passenger", 5.0, 2.0), Actor("tram", "tram", 31.0, 2.5)))

    def at(x, time_s):
        return Scene(
            time_s, roster, [(x, 0.0), (40.0, 30.0)], [0.0, math.pi / 2], [20.0, 0.0], spines={1: spine}, swept=True
        )

    assert hits(Overlap(), at(10.0, 0.0), at(30.0, 1.0)) == []
    (hit,) = hits(Overlap(), at(22.0, 0.0), at(42.0, 1.0))
    assert (hit.collider, hit.victim) == ("ego", "tram")
    assert hit.time_s == pytest.approx(16.75 / 20)
    (hit,) = hits(Overlap(), at(40.0, 0.0))
    assert hit.time_s == 0


def test_events_are_those_of_the_agents():
    view = scene(*REAR_END)
    view.events = (Event("red_light", "other", "x"), Event("teleport", "ego", "y"))
    (finding,) = TrafficEvents().check(view, ["ego"])
    assert (finding.outcome, finding.event.what, finding.collision) == (Outcome.TELEPORT, "y", None)
    assert len(TrafficEvents().check(view, ["ego", "other"])) == 2


@pytest.mark.parametrize(
    ("oracle", "kind"),
    [(RedLight, "red_light"), (Teleport, "teleport"), (WrongWay, "wrong_way"), (OffRoute, "off_route")],
)
def test_the_one_that_looks_for_one_kind_of_event_sees_that_of_the_agents_only(oracle, kind):
    view = scene(*REAR_END)
    other = "teleport" if kind != "teleport" else "red_light"
    view.events = (Event(kind, "other", "theirs"), Event(other, "ego", "another"), Event(kind, "ego", "ours"))
    (finding,) = oracle().check(view, ["ego"])
    assert (finding.outcome, finding.event.what) == (Outcome(kind), "ours")
    assert len(oracle().check(view, ["other", "ego"])) == 2
    assert oracle().check(view, ["third"]) == []


def test_findings_of_others_are_not_credited():
    one = Finding(Outcome.COLLISION, Collision("ego", "collider", "ego", "a", ("reported",)))
    same = Finding(Outcome.COLLISION, Collision("ego", "victim", "a", "ego", ("overlap",)))
    another = Finding(Outcome.COLLISION, Collision("ego", "collider", "ego", "b", ("third",)))
    event = Finding(Outcome.RED_LIGHT, event=Event("red_light", "ego", "x"))
    merged = merge_findings([one, event, another, same])
    assert (merged.outcome, merged.collision.seen_by, merged.collision.role) == (
        Outcome.COLLISION, ("overlap", "reported"), "collider",
    )  # fmt: skip
    assert merge_findings([event, one]) is event


def test_the_one_that_is_excluded_has_not_touched():
    """Against looking at everybody: fast and slow, in bends, aside, just entered, and in steps of any length."""
    random = np.random.default_rng(11)
    found = 0
    for number in range(300):
        seconds, fresh = float(random.choice([0.1, 0.5, 1.0])), number % 3
        rows, after = [], []
        for who in range(6):
            x, y = random.uniform(-22, 22, 2)
            heading, speed, turn = random.uniform(-4, 4), random.uniform(0, 30), random.choice([0.0, 0.0, 0.5, -0.9])
            drift = random.choice([0.0, 0.0, 2.0, -3.2])
            ahead = heading + turn / 2
            way = speed * seconds * 1.1
            rows.append((f"v{who}", x, y, heading, speed))
            x, y = (
                x + way * math.cos(ahead) - drift * math.sin(ahead),
                y + way * math.sin(ahead) + drift * math.cos(ahead),
            )
            after.append((f"v{who}", x, y, heading + turn, max(0.0, speed - 8 * seconds)))
        before = scene(*rows[fresh:], time_s=5.0)
        present = scene(*(after if fresh != 1 else after[::-1]), time_s=5.0 + seconds, swept=True)
        if fresh == 0:
            present.roster = before.roster
        present.follow(before)
        row = present.roster.index["v3"]
        others = [actor.id for actor in present.roster.actors if actor.id != "v3"]
        expected = {
            other for other in others if first_contact(before, present, row, present.roster.index[other]) is not None
        }
        assert {
            hit.victim if hit.role == "collider" else hit.collider for hit in hits(Overlap(), present, agents=["v3"])
        } == expected
        found += len(expected)
    assert found > 60


@pytest.mark.parametrize("name", ["agent", "other"])
def test_jump_out_of_a_parking_space_is_no_path(name):
    """The other vehicle drives through the space, which lies on its lane; the parked one jumps to its own lane."""

    def scene(time_s, parked, agent, other):
        actors = [Actor(one, "car", 5.0, 1.8, parked=parked and one == name) for one in ("agent", "other")]
        rows = (agent, other) if name == "agent" else (other, agent)
        return Scene(time_s, Roster(tuple(actors)), rows, [0.0, 0.0], [6.0, 10.0], swept=True)

    before = scene(0.0, True, (100.0, -4.8), (90.0, -4.8))
    after = scene(1.0, False, (100.6, -1.6), (101.0, -4.8))
    after.follow(before)
    assert Overlap().check(before, ["agent"]) == Overlap().check(after, ["agent"]) == []
    driven = scene(1.0, False, (100.6, -4.8), (101.0, -4.8))
    driven.follow(scene(0.0, True, (100.0, -4.8), (90.0, -4.8)))
    assert Overlap().check(driven, ["agent"])
