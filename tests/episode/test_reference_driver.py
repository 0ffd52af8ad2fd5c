"""The reference driver on a straight road of its own, where every gap can be computed by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from conftest import examples
from gymnasium import spaces
from hypothesis import given, settings, strategies as st
from onlookers import Always

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.episode import overruled_agent
from crashhunt.simulators import MetaAction, SpeedAndLaneChange, action_form
from crashhunt.trial import Overruled
from crashhunt.world import Crossing, Neighbor, Side, Surroundings

DT, ACCELERATION, BRAKING = 0.1, 2.6, 4.5


class Road:
    """A lane with a vehicle ahead; the agent's speed follows its action within the limits of its vehicle."""

    step_length_s = DT

    def __init__(self, gap=40.0, speed=20.0, leader=20.0, form=None, brakes=BRAKING, **more):
        self.brakes = brakes
        self.gap, self.speed, self.leader, self.more = gap, speed, leader, more
        self.actions = {"ego": form or SpeedAndLaneChange()}

    def surroundings(self, agent):
        ahead = Neighbor(actor="lead", gap_m=self.gap, speed_mps=self.leader, braking_mps2=self.brakes)
        named = {"ahead": (ahead,)} | self.more
        return Surroundings(speed_mps=self.speed, acceleration_mps2=ACCELERATION, braking_mps2=BRAKING, **named)

    def drive(self, action, leader_rate):
        target, _ = action
        self.speed = max(0.0, min(max(target, self.speed - BRAKING * DT), self.speed + ACCELERATION * DT))
        self.leader = max(0.0, self.leader + leader_rate * DT)
        self.gap += (self.leader - self.speed) * DT


def driver(road, faculty, action=(35.0, 0), after=0):
    made = overruled_agent(Always(action), road, Overruled("ego", after, reference=faculty))
    made.reset(0)
    return made


@settings(max_examples=examples(60), deadline=None)
@given(
    st.floats(0.0, 30.0), st.floats(0.0, 30.0), st.lists(st.floats(-BRAKING, 2.0), min_size=5, max_size=12), st.data()
)
def test_a_reckless_agent_never_hits_a_leader_that_brakes_as_hard_as_it_can(speed, leader, rates, data):
    gap = data.draw(st.floats(0.0, 60.0))
    road = Road(gap + 1.0 + max(0.0, speed * speed - leader * leader) / (2 * BRAKING) + speed, speed, leader)
    made = driver(road, "longitudinal")
    for rate in rates:
        for _ in range(10):
            road.drive(made.act(None), rate)
            assert road.gap > 0
    for _ in range(100):
        road.drive(made.act(None), -BRAKING)
    assert road.gap > 0


def test_a_leader_with_weak_brakes_is_not_driven_into():
    """RSS compares stopping distances: a truck that stops slowly would allow a fast car to come as near as it likes."""
    road = Road(60.0, 23.0, 17.0, brakes=3.0)
    made = driver(road, "longitudinal")
    for _ in range(600):
        road.drive(made.act(None), 0.0)
        assert road.gap > 5.0


def test_without_its_faculty_it_reports_and_changes_nothing():
    for faculty in ("none", "lateral"):
        road = Road(30.0, 25.0, 15.0)
        made = driver(road, faculty)
        for _ in range(60):
            action = made.act(None)
            assert action == (35.0, 0)
            road.drive(action, 0.0)
        assert road.gap < 0
        (response,) = made.responses
        assert (response["faculty"], response["actor"], response["first"]) == ("longitudinal", "lead", 0)
        assert response["last"] == 59
        assert response["speed_mps"] > response["safe"]


def test_it_takes_over_after_its_step():
    road = Road(30.0, 25.0, 15.0)
    made = driver(road, "longitudinal", after=3)
    assert [made.act(None)[0] == 35.0 for _ in range(5)] == [True, True, True, False, False]
    assert made.responses[0]["first"] == 3


@pytest.mark.parametrize(
    ("side", "kind"),
    [
        (Side(exists=False), "no lane left"),
        (Side(exists=True, ahead=Neighbor(actor="x", gap_m=5.0, speed_mps=15.0, braking_mps2=4.5)), "ahead left"),
        (
            Side(
                exists=True,
                behind=Neighbor(actor="x", gap_m=5.0, speed_mps=28.0, braking_mps2=4.5, acceleration_mps2=2.0),
            ),
            "behind left",
        ),
        (Side(exists=True, ahead=Neighbor(actor="x", gap_m=-2.0, speed_mps=20.0, braking_mps2=4.5)), "alongside left"),
        (Side(exists=True, ahead=Neighbor(actor="x", gap_m=200.0, speed_mps=15.0, braking_mps2=4.5)), None),
        (Side(exists=True), None),
    ],
)
def test_it_refuses_a_lane_change_into_a_gap_that_is_not_safe(side, kind):
    road = Road(300.0, 20.0, 20.0, sides={1: side, -1: Side(exists=True)})
    made = driver(road, "lateral", (20.0, 1))
    assert made.act(None) == (20.0, 1 if kind is None else 0)
    assert [one["kind"] for one in made.responses] == ([] if kind is None else [kind])
    assert driver(road, "longitudinal", (20.0, 1)).act(None)[1] == 1
    assert driver(road, "lateral", (20.0, -1)).act(None) == (20.0, -1)


@pytest.mark.parametrize(("word", "side"), [("LANE_LEFT", 1), ("LANE_RIGHT", -1)])
def test_refused_meta_action_of_either_side_is_idle(word, side):
    form = MetaAction(("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER"))
    number = form.space.meanings.index(word)
    for unsafe, expected in ((side, "IDLE"), (-side, word)):
        road = Road(300.0, form=form, sides={unsafe: Side(exists=False), -unsafe: Side(exists=True)})
        assert form.space.meanings[driver(road, "lateral", number).act(None)] == expected


def test_each_vehicle_of_an_unsafe_gap_is_noted():
    """The collision partner need not be the vehicle with the least safe gap."""
    ahead = Neighbor(actor="near", gap_m=-2.0, speed_mps=27.0, braking_mps2=BRAKING)
    behind = Neighbor(actor="fast", gap_m=5.0, speed_mps=30.0, braking_mps2=BRAKING)
    road = Road(sides={1: Side(exists=True, ahead=ahead, behind=behind)})
    made = driver(road, "lateral", (20.0, 1))
    assert made.act(None) == (20.0, 0)
    noted = {(one["kind"], one["actor"]) for one in made.responses if one["faculty"] == "lateral"}
    assert noted == {("alongside left", "near"), ("behind left", "fast")}


def crossing(*, right_of_way, distance=30.0, other=30.0, speed=12.0, **more):
    return Crossing(
        actor="cross", distance_m=distance, exit_m=distance + 8, actor_distance_m=other, actor_exit_m=other + 8,
        speed_mps=speed, braking_mps2=4.5, has_right_of_way=right_of_way, **more,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("one", "stops"),
    [
        (crossing(right_of_way=True), True),
        (crossing(right_of_way=False), False),  # it can still yield: 16 m to stop
        (crossing(right_of_way=False, other=10.0, distance=10.0), True),  # it cannot any more
        (crossing(right_of_way=True, other=200.0), False),  # far away
        (crossing(right_of_way=True, other=20.0, speed=0.0), False),  # it waits
        (crossing(right_of_way=True, distance=-1.0), False),  # the agent is inside, and clears the area
    ],
)
def test_it_yields_to_an_actor_that_has_right_of_way_or_cannot_stop(one, stops):
    road = Road(300.0, 14.0, 20.0, crossing=(one,), ahead=())
    made = driver(road, "none", (14.0, 0))
    made.act(None)
    kinds = [response["kind"] for response in made.responses]
    assert kinds == (["crossing"] if stops else [])


def test_meta_actions_become_slower_or_idle():
    form = MetaAction()
    slower, idle, faster = (form.space.meanings.index(word) for word in ("SLOWER", "IDLE", "FASTER"))
    assert driver(Road(10.0, 25.0, 15.0, form), "longitudinal", faster).act(None) == slower
    left, right = (form.space.meanings.index(f"LANE_{side}") for side in ("LEFT", "RIGHT"))
    for there, free, taken in ((1, right, left), (-1, left, right)):
        gap = Road(300.0, 25.0, 25.0, form, sides={there: Side(exists=False)})
        assert driver(gap, "lateral", taken).act(None) == idle
        assert driver(gap, "lateral", free).act(None) == free
    assert driver(gap, "longitudinal", faster).act(None) == faster


class Steered(Road):
    """A road whose agent accelerates and steers: its action is its speed after the step, and its lane change."""

    def __init__(self, *given, **more):
        super().__init__(*given, form=action_form(spaces.Box(-90.0, 90.0, (2,))), **more)

    def is_steered(self, agent):
        return agent == "ego"

    def motion_of(self, agent, action):
        assert agent == "ego"
        return SimpleNamespace(speed_mps=float(action[0]), lane_change=int(action[1]))

    def action_with(self, agent, action, *, speed_mps, keeps_lane):
        assert (agent, float(action[0])) == ("ego", 28.0)
        return speed_mps, keeps_lane


@pytest.mark.parametrize(
    ("faculty", "speeds", "lanes"),
    [("none", False, False), ("longitudinal", True, False), ("lateral", False, True), ("both", True, True)],
)
def test_steering_agent_gets_another_speed_or_is_kept_in_its_lane(faculty, speeds, lanes):
    near, far = (Steered(gap, 25.0, 15.0, sides={1: Side(exists=False), -1: Side(exists=True)}) for gap in (5.0, 900.0))
    left, right = (np.array([28.0, change]) for change in (1.0, -1.0))

    def corrected(road, action):
        made = driver(road, faculty, action)
        found = made.act(None)
        return (None, False) if found is action else found, [one["faculty"] for one in made.responses]

    (speed, kept), responses = corrected(near, left)
    assert (speed is not None, kept) == (speeds, lanes)
    assert speed is None or speed < 15.0
    assert sorted(responses) == ["lateral", "longitudinal"]
    (speed, kept), responses = corrected(near, right)
    assert (speed is not None, kept) == (speeds, False)
    assert responses == ["longitudinal"]
    assert corrected(far, left) == ((None, lanes), ["lateral"])
    assert corrected(far, right) == ((None, False), [])


def test_steering_agent_is_corrected_from_its_step_on_and_reported_once():
    road = Steered(5.0, 25.0, 15.0, sides={1: Side(exists=False), -1: Side(exists=False)})
    action = np.array([28.0, 1.0])
    made = driver(road, "both", action, after=2)
    assert [made.act(None) is action for _ in range(4)] == [True, True, False, False]
    assert {(one["faculty"], one["first"], one["last"]) for one in made.responses} == {
        ("lateral", 2, 3),
        ("longitudinal", 2, 3),
    }


def test_a_simulator_that_knows_no_surroundings_is_refused():
    class Blind:
        step_length_s = DT

        def __init__(self):
            self.actions = {"ego": SpeedAndLaneChange()}

    with pytest.raises(InvalidEpisodeError, match="the simulator reports no surroundings"):
        driver(Blind(), "none")
