"""The verdict of a crash page is built from the contact and from runs, and says nothing that they do not show."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from crashhunt.crashes import (
    Attempt,
    DriverRun,
    Fault,
    Judgement,
    LaneMap,
    Omission,
    Preventability,
    Reference,
    ReferenceRun,
)
from crashhunt.crashes._contact_record import record_in
from crashhunt.report._crash_text import _cells, _number_of_action
from crashhunt.report._headline import describe_contact, last_avoidable, verdict_of
from crashhunt.report._judgement_words import about_drivers, about_reference
from crashhunt.trial import Collision, Escape
from crashhunt.world import Actor, Roster, Scene

DT = 0.1
BOTH = Roster((Actor("ego", "car", 5.0, 2.0), Actor("x", "car", 5.0, 2.0)))


def contact(poses, *, turn=0.0):
    """Return the record of a contact.

    Args:
        poses: returns x, y, heading and speed of ego and of the other at a time in s; the last scene is at 0 s.
        turn: by which the whole map is turned, in rad.
    """
    c, s = math.cos(turn), math.sin(turn)
    scenes = []
    for step in range(-40, 1):
        found = poses(step * DT)
        points = [(c * x - s * y, s * x + c * y) for x, y, *_ in found]
        scenes.append(Scene(4.0 + step * DT, BOTH, points, [one[2] + turn for one in found], [one[3] for one in found]))
    hit = Collision(
        agent="ego", role="collider", collider="ego", victim="x", collider_speed=1.0, victim_speed=1.0, x=0.0, y=0.0
    )
    record = record_in(scenes, hit)
    assert record is not None
    return record


def jump(side, ahead_m, *, own=10.0, its=20.0, mover=0):
    """One of the two is in the next lane until its last step, and then in that of the other."""

    def poses(time_s):
        found = [[ahead_m + own * time_s, 0.0, 0.0, own], [its * time_s, 0.0, 0.0, its]]
        found[mover][1] = side * 3.2 if time_s < -DT / 2 else 0.0
        return found

    return poses


@pytest.mark.parametrize("turn", [0.0, 2.1])
@pytest.mark.parametrize(
    ("poses", "words"),
    [
        (jump(-1, 4.0), "ego changed to the left lane into x; x was alongside"),
        (jump(1, 4.0), "ego changed to the right lane into x; x was alongside"),
        (jump(-1, 4.9), "ego changed to the left lane into x; the gap was 0.9 m"),
        (jump(-1, 4.0, mover=1), "x changed to the left lane into ego; ego was alongside"),
        (
            lambda time_s: [(20 * time_s, 0.0, 0.0, 20.0), (4.9 + 12 * time_s, 0.0, 0.0, 12.0)],
            "ego drove into the back of x at 20.0 m/s against 12.0 m/s",
        ),
        (
            lambda time_s: [(4.9 + 12 * time_s, 0.0, 0.0, 12.0), (20 * time_s, 0.0, 0.0, 20.0)],
            "x drove into the back of ego at 20.0 m/s against 12.0 m/s",
        ),
        (
            lambda time_s: [(10 * time_s, 0.0, 0.0, 10.0), (-0.1 - 10 * time_s, 0.0, math.pi, 10.0)],
            "ego and x collided head-on",
        ),
        (
            lambda time_s: [(10 * time_s, 0.0, 0.0, 10.0), (0.9, 2.0 + time_s, math.pi / 2, 1.0)],
            "ego drove into x, which came from the right",
        ),
        (
            lambda time_s: [(0.9, 2.0 + time_s, math.pi / 2, 1.0), (10 * time_s, 0.0, 0.0, 10.0)],
            "x, which came from the left, drove into ego",
        ),
        (
            lambda time_s: [(10 * time_s, 0.0, 0.0, 10.0), (-0.1, 0.0, math.pi, 0.0)],
            "ego drove into x, which stood still",
        ),
        (
            lambda time_s: [(-0.1, 0.0, math.pi, 0.0), (10 * time_s, 0.0, 0.0, 10.0)],
            "x drove into ego, which stood still",
        ),
        (
            lambda time_s: [(10 * time_s, 0.0, 0.0, 10.0), (3.4, 0.0, math.pi / 2, 0.0)],
            "ego drove into x, which stood still",
        ),
    ],
)
def test_contact_in_one_clause(poses, words, turn):
    assert describe_contact(contact(poses, turn=turn)) == words


@pytest.mark.parametrize("turn", [0.0, 2.1])
@pytest.mark.parametrize(("side", "word"), [(-1, "left"), (1, "right")])
def test_gradual_lane_change_reports_its_side_and_the_gap_at_that_time(side, word, turn):
    """The ego needs 1.5 s for 3.2 m; the faster vehicle behind in the target lane then drives into its back."""

    def poses(time_s):
        aside = side * 3.2 * (1.0 - min(1.0, max(0.0, (time_s + 2.5) / 1.5)))
        return [(4.9 + 12 * time_s, aside, 0.0, 12.0), (20 * time_s, 0.0, 0.0, 20.0)]

    c, s = math.cos(turn), math.sin(turn)

    def line(y):
        return np.array([(c * x - s * y, s * x + c * y) for x in (-200.0, 0.0, 200.0)])

    lanes = LaneMap([(line(y - 1.6), line(y + 1.6)) for y in (-3.2, 0.0, 3.2)], (0.0, 0.0))
    record = replace(contact(poses, turn=turn), lanes=lanes)
    since = record.changed_s("ego")
    assert 1.0 <= since <= 2.5
    gap_m = 4.9 - 12 * since + 20 * since - 5.0
    assert describe_contact(record) == (
        f"ego changed to the {word} lane {since:.1f} s before, and x drove into the back of ego at 20.0 m/s against "
        f"12.0 m/s; the gap was {gap_m / 20.0:.1f} s ({gap_m:.1f} m)"
    )


def on_three_lanes(record):
    borders = [(np.array([(-200.0, y - 1.6), (200.0, y - 1.6)]), np.array([(-200.0, y + 1.6), (200.0, y + 1.6)]))
               for y in (-3.2, 0.0, 3.2)]  # fmt: skip
    return replace(record, lanes=LaneMap(borders, (0.0, 0.0)))


@pytest.mark.parametrize(("side", "word"), [(-1, "left"), (1, "right")])
def test_lane_change_under_way_at_the_contact_is_not_called_complete(side, word):
    """The ego drifts for 2 s, and its centre is still in its own lane when it touches the vehicle alongside."""

    def poses(time_s):
        return [(12 * time_s, side * (1.99 - 0.8 * max(-2.0, time_s)), 0.0, 12.0), (12 * time_s, 0.0, 0.0, 12.0)]

    record = on_three_lanes(contact(poses))
    assert describe_contact(record).startswith(f"ego was changing to the {word} lane and touched the side of x")


def test_verdict_names_the_lane_changes_of_both_into_one_lane():
    """The ego drifts to the right, and x is in the lane on its right from 0.2 s before the contact on."""

    def poses(time_s):
        x_aside = 0.0 if time_s > -0.25 else -3.2
        return [(20 * time_s, 1.0 - 0.8 * max(-2.0, time_s), 0.0, 20.0), (4.9 + 12 * time_s, x_aside, 0.0, 12.0)]

    record = on_three_lanes(contact(poses))
    assert describe_contact(record) == (
        "ego changed to the right lane 0.7 s before, x changed to the left lane 0.2 s before, and ego drove into the "
        "back of x at 20.0 m/s against 12.0 m/s"
    )


def story(judgement=None, escape=None, poses=None):
    record = contact(poses or (lambda time_s: [(20 * time_s, 0.0, 0.0, 20.0), (4.9 + 12 * time_s, 0.0, 0.0, 12.0)]))
    result = SimpleNamespace(escape=escape, summary="ego drove into x at step 40")
    return SimpleNamespace(
        nearest=None,
        contact=record,
        judgement=judgement,
        bundle=SimpleNamespace(result=result),
        agent="ego",
        other="x",
        encounter=None,
        fault=Fault("ego"),
        recording=SimpleNamespace(ago=lambda step: f"{(40 - step) * DT:.1f} s before"),
    )


TOUCHED = "ego drove into the back of x at 20.0 m/s against 12.0 m/s"


def attempt(avoided, changed=()):
    endings = {step: "avoided" if step <= avoided else "hit" for step in range(40)}
    return Attempt(manoeuvre="brake", end=40, endings=endings, changed=changed)


def omitted(**more):
    given = {
        "faculty": "longitudinal", "kind": "vehicle", "actor": "x", "step": 20, "instead": "sped up", "speed_mps": 20.0,
        "actor_speed_mps": 12.0, "gap_m": 9.0, "safe": 14.0,
    }  # fmt: skip
    run = ReferenceRun(faculty="longitudinal", step=20, ending="none")
    return Judgement(reference=Reference(omission=Omission(**given | more), runs=(run,)))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, f"{TOUCHED}."),
        (
            {"escape": Escape(30, 31)},
            f"{TOUCHED}; if ego brakes 1.0 s before, this crash does not happen.",
        ),
        ({"escape": Escape(why_not="the run differed")}, f"{TOUCHED}."),
        ({"escape": Escape(None, 0)}, f"{TOUCHED}."),
        (
            {"judgement": Judgement((attempt(25),))},
            f"{TOUCHED}; if ego brakes 1.5 s before, this crash does not happen.",
        ),
        (
            {"judgement": Judgement((attempt(25, changed=("ego does not change lanes",)),))},
            f"{TOUCHED}; if ego brakes 1.5 s before and does not change lanes, this crash does not happen.",
        ),
        (
            {"judgement": Judgement((attempt(-1),))},
            f"{TOUCHED}; no run avoids it: the trial starts in an unavoidable situation.",
        ),
        (
            {"judgement": Judgement((Attempt("brake", 40, dict.fromkeys(range(40), "other")),))},
            f"{TOUCHED}; no run ends without a crash.",
        ),
        ({"judgement": Judgement((), why_not="interrupted")}, f"{TOUCHED}."),
        (
            {"judgement": omitted()},
            f"{TOUCHED}; ego did not brake and sped up; with a reference driver this crash does not happen.",
        ),
        (
            {"judgement": omitted(instead="kept its speed", kept_s=2.04)},
            (
                f"{TOUCHED}; ego did not brake and kept its speed for the last 2.0 s; "
                "with a reference driver this crash does not happen."
            ),
        ),
        (
            {"judgement": omitted(instead="kept its speed", kept_s=0.2)},
            f"{TOUCHED}; ego did not brake; with a reference driver this crash does not happen.",
        ),
        ({"judgement": omitted(actor="y")}, f"{TOUCHED}."),  # about another actor than the page
        (
            {"judgement": omitted(kind="red light", actor="")},
            f"{TOUCHED}; ego did not stop for a red light; with a reference driver this crash does not happen.",
        ),
    ],
)
def test_verdict_reports_only_what_was_run(given, words):
    assert verdict_of(story(**given)) == words


@pytest.mark.parametrize(("given", "found"), [
    ({}, None),
    ({"escape": Escape(30, 31, 6.5)}, (30, "brakes", 6.5)),
    ({"escape": Escape(30, 31, 6.5, changed=("ego does not change lanes",))}, (30, "brakes", None)),
    ({"escape": Escape(None, 0)}, None),
    ({"escape": Escape(30), "judgement": Judgement((replace(attempt(25), deceleration=4.5),))}, (25, "brakes", 4.5)),
    ({"judgement": Judgement((replace(attempt(25), manoeuvre="left", deceleration=4.5),))},
     (25, "changes to the lane on the left and brakes", None)),
    ({"escape": Escape(30, 31), "judgement": Judgement((attempt(-1),))}, None),
])  # fmt: skip
def test_last_step_that_avoids_a_crash_has_its_manoeuvre_and_deceleration(given, found):
    assert last_avoidable(story(**given)) == found


def test_braking_is_no_answer_where_the_agent_changed_lanes():
    """An earlier version has not recorded that the run drops the lane change as well."""
    found = verdict_of(story(escape=Escape(39), poses=jump(-1, 4.0)))
    assert found == "ego changed to the left lane into x; x was alongside."
    found = verdict_of(story(escape=Escape(39, changed=("ego does not change lanes",)), poses=jump(-1, 4.0)))
    words = "if ego brakes 0.1 s before and does not change lanes, this crash does not happen"
    assert found == f"ego changed to the left lane into x; x was alongside; {words}."


def test_contact_that_the_outlines_contradict_is_not_described():
    apart = story(poses=lambda time_s: [(20 * time_s, 0.0, 0.0, 20.0), (6.4 + 12 * time_s, 0.0, 0.0, 12.0)])
    apart.contact = replace(apart.contact, reported=replace(apart.contact.reported, collider="x"))
    assert verdict_of(apart) == f"{apart.bundle.result.summary}."


def test_lane_change_of_the_reference_runs_gives_the_gap():
    found = omitted(instead="changed lanes", kind="behind left", faculty="lateral", gap_m=6.0, actor_speed_mps=20.0)
    words = "ego changed to the left lane into x; the gap was {} (6.0 m); with a reference driver this crash does not "
    words += "happen."
    assert verdict_of(story(judgement=found, poses=jump(-1, 4.9))) == words.format("0.3 s")
    ahead = omitted(instead="changed lanes", kind="ahead left", faculty="lateral", gap_m=6.0, speed_mps=10.0)
    assert verdict_of(story(judgement=ahead, poses=jump(-1, 4.9))) == words.format("0.6 s")  # ego is behind


def test_road_departure_names_the_missing_lane():
    found = omitted(instead="changed lanes", kind="no lane left", faculty="lateral", actor="")
    left = story(judgement=found)
    left.contact, left.other, left.bundle.result.summary = None, "", "ego left the road at step 13"
    assert verdict_of(left) == (
        "ego left the road at step 13; ego changed to the left, where it has no lane; with a reference driver this "
        "crash does not happen."
    )


@pytest.mark.parametrize(("gap_m", "shown"), [(0.0, "-"), (1e-9, "-"), (0.06, "52.1")])
def test_needed_braking_is_shown_while_a_gap_is(gap_m, shown):
    moment = SimpleNamespace(
        other_speed=3.0, gap_m=gap_m, closing_speed=2.5, time_to_collision_s=0.0, required_deceleration=52.1
    )
    assert _cells(moment)[-1] == shown
    moment.time_to_collision_s, moment.required_deceleration = math.inf, 0.0  # before a bend, for example
    assert _cells(moment)[-2:] == ["-", "-"]


@pytest.mark.parametrize(
    ("name", "value", "shown"),
    [
        ("x", 100345.67, "100345.7"), ("acceleration", -1.2e-8, "0"), ("acceleration", -1.25, "-1.25"),
        ("target_speed", 15.0, "15"), ("torque", 1.2e-8, "1.2e-8"), ("y", -0.04, "0.0"),
    ],
)  # fmt: skip
def test_numbers_of_an_action_are_shown_as_precisely_as_they_matter(name, value, shown):
    assert _number_of_action(name, value) == shown


@pytest.mark.parametrize(
    ("fault", "verb"), [("ego", "yield"), ("both", "yield"), ("the other", "brake"), ("nobody can tell", "brake")]
)
def test_agent_failed_to_yield_only_where_a_rule_blames_it(fault, verb):
    judgement = omitted(kind="crossing")
    found = story(judgement=judgement)
    found.fault = Fault(fault)
    assert f"; ego did not {verb} and sped up; with a reference driver" in verdict_of(found)
    blamed = fault in ("ego", "both")
    (cause, *_) = about_reference(judgement.reference, str, "ego", had_to_yield=blamed)
    assert cause.startswith(f"Cause: ego did not {verb} {'to' if blamed else 'for'} x ")


@pytest.mark.parametrize(
    ("prevented", "words"),
    [
        (None, "Whether a competent driver would have prevented it is not known (FSM: no answer because it failed)."),
        (False, "Preventable by a competent driver (FSM: no)."),
        (True, "Preventable by a competent driver (FSM: yes, by 2.0 m)."),
    ],
)
def test_a_crash_is_called_preventable_only_if_a_model_has_an_answer(prevented, words):
    run = DriverRun(
        model="fsm", prevented=prevented, why_not="" if prevented is not None else "it failed", margin_m=2.0
    )
    assert about_drivers(Preventability(runs=(run,)), str, "ego", "car") == [words]
