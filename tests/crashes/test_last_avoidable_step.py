"""The search for the last escape: which trials it runs, and what it makes of their endings."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from crashhunt.crashes import StepBisection, find_escape, last_avoiding, partner
from crashhunt.crashes._last_avoidable_step import overruled_trial, slowing
from crashhunt.recording import Prologue, StepRecord
from crashhunt.simulators import FullBraking
from crashhunt.trial import Collision, Escape, Outcome, TrialResult, TrialSpec
from crashhunt.world import Actor, Roster, Scene

ROSTER = Roster((Actor("ego", "passenger", 5.0, 2.0), Actor("other", "passenger", 5.0, 2.0)))
DT = 0.5
SPEC = TrialSpec(1, 2, {"ego": {}}, {}, max_steps=100)
HIT = Collision("ego", "collider", "ego", "other", ("overlap",))


class World:
    """The ego drives at 20 m/s at a wall of a car, and may brake; every run is a recording of it.

    Args:
        gap: at the beginning, in m.
        braking: that the ego really has.
        change: what else becomes of a run, from a result and its scenes.
    """

    def __init__(self, gap=90.0, braking=8.0, change=None):
        self.gap, self.braking, self.change = gap, braking, change
        self.runs = []

    def drive(self, after, max_steps):
        x, speed, scenes = 0.0, 20.0, []
        for step in range(max_steps + 1):
            if step:
                if after is not None and step > after:
                    speed = max(0.0, speed - self.braking * DT)
                x += speed * DT
            scenes.append(Scene(step * DT, ROSTER, [(x, 0.0), (self.gap + 5.0, 0.0)], [0.0, 0.0], [speed, 0.0]))
            if x > self.gap:
                return scenes, True
        return scenes, False

    def recording(self, scenes):
        steps = [StepRecord(number, scene) for number, scene in enumerate(scenes)]
        found = SimpleNamespace(all_steps=steps, prologue=Prologue((), DT), steps=len(scenes) - 1)
        found.like = lambda _: found  # it has every actor
        found.scene = lambda step: scenes[step]
        found.scenes = lambda: scenes
        return found

    def crash(self):
        scenes, _ = self.drive(None, 60)
        result = TrialResult(SPEC, Outcome.COLLISION, steps=len(scenes) - 1, collision=HIT)
        return result, self.recording(scenes)

    def run(self, spec):
        self.runs.append(spec.overruled.after)
        self.last = spec
        scenes, hit = self.drive(spec.overruled.after, spec.max_steps)
        result = TrialResult(
            spec, Outcome.COLLISION if hit else Outcome.SURVIVED, steps=len(scenes) - 1, collision=HIT if hit else None
        )
        if self.change is not None:
            result, scenes = self.change(result, scenes)
        return result, self.recording(scenes)

    def escape(self, said=8.0, how="with its brakes"):
        return find_escape(*self.crash(), FullBraking(None, how, said), self.run)

    def truth(self):
        """The last step after which braking helps, tried one by one."""
        end = self.crash()[0].steps
        helps = [after for after in range(end) if not self.drive(after, end + 60)[1]]
        return max(helps, default=None)


@pytest.mark.parametrize("gap", [60.0, 75.0, 90.0, 103.0])
@pytest.mark.parametrize("said", [8.0, 5.0, 12.0, None])
def test_the_answer_is_where_one_more_step_is_too_many(gap, said):
    world = World(gap)
    found = world.escape(said)
    assert found.step == world.truth()
    assert found.too_late == found.step + 1
    assert {found.step, found.too_late} <= set(world.runs)
    assert len(world.runs) == len(set(world.runs)) <= 12
    assert found.braking == pytest.approx(8.0)
    expected = (
        "at 8 m/s², with its brakes," if said == 8.0 else "with its brakes" if said is None else "as hard as it can"
    )
    assert found.how == expected


class LaneChange(World):
    """The ego changes to the other's lane in step 6, in an instant; if it brakes earlier, it stays in its own."""

    def drive(self, after, max_steps):
        scenes, _ = super().drive(after, max_steps)
        for step, scene in enumerate(scenes):
            is_changed = step >= 6 and (after is None or after >= 6)
            scene.points[0] = scene.points[0][0], 0.0 if is_changed else -3.2
            if is_changed and scene.points[0][0] > self.gap:
                return scenes[: step + 1], True
        return scenes, False


@pytest.mark.parametrize(("gap", "changed"), [(60.0, ("ego does not change lanes",)), (110.0, ())])
def test_braking_run_reports_the_lane_change_that_it_drops(gap, changed):
    """With the larger gap, braking after the change suffices."""
    world = LaneChange(gap)
    borders = [
        (np.array([(-50.0, y - 1.6), (200.0, y - 1.6)]), np.array([(-50.0, y + 1.6), (200.0, y + 1.6)]))
        for y in (0.0, -3.2)
    ]
    hit = dataclasses.replace(HIT, x=gap, y=0.0)
    result, recording = world.crash()
    found = find_escape(
        dataclasses.replace(result, collision=hit), recording, FullBraking(None, "", 8.0), world.run, lambda: borders
    )
    assert found.step == world.truth()
    assert found.changed == changed
    assert world.escape().changed == ()  # without a map


def test_brakes_that_never_help_or_always_do():
    none = World(gap=30.0, braking=2.0)  # 100 m to stop
    found = none.escape(said=2.0)
    assert (found.step, found.too_late) == (None, 0)
    assert found.braking == pytest.approx(2.0)
    always = World(gap=25.0, braking=60.0)
    found = always.escape(said=60.0)
    assert found.step == always.truth() == always.crash()[0].steps - 1
    assert found.too_late is None  # after the step of the crash it is too late by itself
    assert World(braking=0.0).escape(said=8.0).braking is None


def test_no_one_asks_what_was_longer_than_ten_seconds_ago():
    world = World(gap=300.0, braking=0.6)  # 333 m to stop, and 15 s to the crash
    found = world.escape(said=0.6)
    assert found.step is None
    assert found.too_late == world.crash()[0].steps - 20 == min(world.runs)


def unclear(change):
    found = World(change=change).escape()
    assert (found.step, found.too_late, found.braking) == (None, None, None)
    return found.why_not


def test_what_the_runs_do_not_say_clearly_is_not_said():
    def ending(**changes):
        return lambda result, scenes: (dataclasses.replace(result, **changes), scenes)

    assert "the run ends before the outcome is clear" in unclear(ending(outcome=Outcome.AGENT_ERROR))
    another = dataclasses.replace(HIT, victim="third")
    assert unclear(ending(outcome=Outcome.COLLISION, collision=another)).endswith("another crash follows")
    assert "outcome is clear" in unclear(ending(outcome=Outcome.COLLISION, collision=None))
    for place in (None, Collision("ego", "alone", "ego")):
        assert unclear(ending(outcome=Outcome.OFF_ROAD, collision=place)).endswith("another crash follows")

    def otherwise(result, scenes):
        scenes[0].points[1] = (1.0, 1.0)
        return result, scenes

    assert unclear(otherwise).endswith("the run deviates before the braking")
    assert unclear(lambda result, scenes: (result, scenes[:2]))

    def still_closing(result, scenes):  # the episode ended before the danger had passed
        return result, scenes[:-18] if result.outcome is Outcome.SURVIVED else scenes

    assert "outcome is clear" in unclear(still_closing)


@pytest.mark.parametrize(("outcome", "hit"), [(Outcome.COLLISION, "third"), (Outcome.OFF_ROAD, "")])
def test_a_run_that_ends_in_the_crash_of_another_agent_is_no_other_crash_of_this_one(outcome, hit):
    elsewhere = Collision("second", "collider" if hit else "alone", "second", hit)

    def crash_of_another(result, scenes):
        if result.outcome is Outcome.SURVIVED:
            result = dataclasses.replace(result, outcome=outcome, collision=elsewhere)
        return result, scenes

    world = World(change=crash_of_another)
    assert world.escape().step == world.truth()  # the ego stands when the run ends

    def too_early(result, scenes):
        result, scenes = crash_of_another(result, scenes)
        return result, scenes[:-18] if result.collision is elsewhere else scenes

    assert "the run ends before the outcome is clear" in unclear(too_early)


def test_danger_is_over_where_one_has_left_or_they_part():
    alone = Roster(ROSTER.actors[:1])
    gone = Roster(ROSTER.actors[1:])

    def without(roster):
        def change(result, scenes):
            if result.outcome is Outcome.SURVIVED:
                end = scenes[-1]
                row = ROSTER.index[roster.actors[0].id]
                scenes[-1] = Scene(end.time_s, roster, [end.points[row]], [0.0], [9.0])
            return result, scenes

        return change

    world = World()
    for roster in (alone, gone):
        assert World(change=without(roster)).escape().step == world.truth()

    def parting(result, scenes):
        if result.outcome is Outcome.SURVIVED:
            scenes[-1].speeds[1] = 30.0
            scenes[-1].speeds[0] = 5.0
        return result, scenes

    def closing(result, scenes):
        if result.outcome is Outcome.SURVIVED:
            scenes[-1].speeds[0] = 5.0
        return result, scenes

    assert World(change=parting).escape().step == world.truth()
    assert World(change=closing).escape().why_not
    finished = World(change=lambda result, scenes: (
        dataclasses.replace(result, outcome=Outcome.FINISHED) if result.outcome is Outcome.SURVIVED else result, scenes
    ))  # fmt: skip
    assert finished.escape().step == world.truth()


def test_other_crashes_have_none():
    world = World()
    result, recording = world.crash()
    braking = FullBraking(None, "", 8.0)
    for changes in (
        {"outcome": Outcome.OFF_ROAD},
        {"collision": None},
        {"collision": dataclasses.replace(HIT, role="alone", victim="")},
    ):
        assert find_escape(dataclasses.replace(result, **changes), recording, braking, world.run) is None
    stranger = dataclasses.replace(HIT, victim="never seen")
    found = find_escape(dataclasses.replace(result, collision=stranger), recording, braking, world.run)
    assert found == Escape(why_not="the recording has the two vehicles together only when they touch")
    found = find_escape(result, recording, None, world.run)
    assert found == Escape(why_not="the simulator does not say how ego brakes")
    assert world.runs == []


def test_vehicle_hit_from_the_side_has_an_answer_and_one_hit_from_behind_the_reason():
    world = World()
    result, recording = world.crash()
    victim = dataclasses.replace(HIT, role="victim", collider="other", victim="ego")
    found = find_escape(dataclasses.replace(result, collision=victim), recording, FullBraking(None, "", 8.0), world.run)
    assert found.step == world.truth()
    for scene in recording.scenes():  # now the other one drives into the standing ego
        scene.points.reverse()
        scene.speeds.reverse()
    world.runs.clear()
    found = find_escape(dataclasses.replace(result, collision=victim), recording, FullBraking(None, "", 8.0), world.run)
    assert found == Escape(why_not="other drove into the back of ego")
    assert world.runs == []


def test_the_partner_is_the_other_one():
    def of(**changes):
        return partner(TrialResult(SPEC, Outcome.COLLISION, collision=dataclasses.replace(HIT, **changes)))

    assert of() == "other"
    assert of(role="victim", collider="other", victim="ego") == "other"
    assert of(role="alone") == ""
    assert partner(TrialResult(SPEC, Outcome.COLLISION)) == ""


def test_who_brakes_better_than_was_said_is_looked_at_up_to_the_last_step():
    for gap in (60.0, 75.0, 90.0, 103.0):
        world = World(gap, braking=14.0)
        assert world.escape(said=1.5).step == world.truth()


def test_run_that_stops_harder_than_any_vehicle_avoids_nothing():
    """SUMO stops a vehicle within one step where its lane does not lead on."""
    found = World(braking=60.0).escape(said=1.5)
    assert found.step is None
    assert "stops harder than any vehicle can" in found.why_not


def test_how_long_it_is_run_and_how_hard_it_braked_by_hand():
    speeds = [10.0, 9.5, 7.5, 7.0, 1.0]
    scenes = [
        Scene(step * DT, ROSTER, [(float(step), 0.0), (50.0, 0.0)], [0.0, 0.0], [speed, 0.0])
        for step, speed in enumerate(speeds)
    ]
    recording = World().recording(scenes)
    crashed = TrialResult(SPEC, Outcome.COLLISION, steps=4, collision=HIT)
    survived = dataclasses.replace(crashed, outcome=Outcome.SURVIVED, collision=None)
    # Not what the collision itself did to the speed.
    assert slowing("ego", 0, crashed, recording) == pytest.approx(2.0 / DT)
    assert slowing("ego", 2, crashed, recording) == pytest.approx(0.5 / DT)
    assert slowing("ego", 2, survived, recording) == pytest.approx(6.0 / DT)
    assert slowing("nobody", 0, survived, recording) == 0.0
    for after, speed in enumerate(speeds):  # the last is nearly standing
        spec = overruled_trial(crashed, recording, after, 4.0)
        assert spec.max_steps == 4 + math.ceil((5.0 + speed / 4.0) / DT)
        assert (spec.overruled.agent, spec.overruled.after, spec.overruled.manoeuvre) == ("ego", after, "brake")


@pytest.mark.parametrize(
    ("last", "given", "order"),
    [
        (12, {}, [[20], [19], [17], [13], [5], [9], [11], [12]]),
        (33, {}, [[20], [30], [35], [32], [33], [34]]),
        (33, {"is_near": True}, [[20], [21], [23], [27], [35], [31], [33], [34]]),
        (12, {"parallel": 3}, [[20, 39], [16, 18, 19], [2, 8], [10, 12, 14], [13]]),
        (-1, {}, [[20], [19], [17], [13], [5], [2]]),
        (39, {"is_near": True}, [[20], [21], [23], [27], [35], [39]]),
    ],
)
def test_bisection_examines_few_steps(last, given, order):
    bisection, endings, found = StepBisection(2, 20, 40, **given), {}, []
    while steps := bisection.next_steps(endings):
        found.append(sorted(steps))
        endings |= {step: "avoided" if step <= last else "hit" for step in steps}
    assert found == order
    assert last_avoiding(endings) == (None if last < 2 else last)
