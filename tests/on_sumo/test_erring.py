"""Vehicles of SUMO that err: who is meant, what they do, within what they can do, and that they recover."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import libsumo
import numpy as np
import pytest
from onlookers import Steady, Watch

from crashhunt.disturbances import disturber_of
from crashhunt.episode import Episode
from crashhunt.scenario import AgentSetup, argument_values, load_scenario
from crashhunt.sumo import SumoSimulator
from crashhunt.trial import Disturbance, TrialSpec

NET = Path(__file__).with_name("signal.net.xml")
ROUTES = """<routes>
<vType id="car" sigma="0" speedDev="0" maxSpeed="8" lcKeepRight="0" lcSpeedGain="0"/>
<vType id="fast" sigma="0" speedDev="0" lcKeepRight="0" lcSpeedGain="0"/>
<route id="across" edges="west east"/><route id="up" edges="south north"/><route id="back" edges="-east -west"/>
{traffic}
</routes>"""
AHEAD, BEHIND = (
    f'<vehicle id="{name}" type="car" route="across" depart="0" departPos="{pos}" departLane="0" departSpeed="8"/>'
    for name, pos in (("lead", 60), ("follow", 10))
)
LEFT = '<vehicle id="left" type="car" route="across" depart="0" departPos="{}" departLane="1" departSpeed="8"/>'


@pytest.fixture
def drive(sumo_runs):
    """Starts an episode on a street with a signal; returns it and who watches."""
    ego = AgentSetup(route="across", type="fast", depart_lane="0", depart_pos="35", depart_speed="8")

    def begin(*disturbances, traffic=AHEAD + BEHIND, steps=400, dt=0.1, agent=None, driven=(), strength=None):
        agents = {"ego": ego, **dict.fromkeys(driven, AgentSetup(existing=True))}
        routes = ROUTES.format(traffic=traffic)
        simulator = sumo_runs.written(NET, routes, step_length_s=dt, warmup_s=1.0, agents=agents)
        watch = Watch()
        spec = TrialSpec(0, 1, {}, strength or {}, steps, disturbances=disturbances)
        given = {"simulator": simulator, "make_agent": lambda *_: agent or Steady(), "observers": (watch,)}
        episode = sumo_runs.enter_context(Episode(spec, **given))
        episode.start()
        assert episode.result is None, episode.result.failure
        return episode, watch

    return begin


def planned(step, what, who="ahead", strong=3.0, long=1.0):
    return Disturbance(step, who, what, strong, long, "ego")


def advance(episode, steps):
    for _ in range(steps):
        if episode.step() is not None:
            break
    return episode.result


def drives_by_itself(name):
    """As SUMO has it: nothing is commanded, and no check is off."""
    modes = libsumo.vehicle.getSpeedMode(name), libsumo.vehicle.getLaneChangeMode(name)
    own = libsumo.vehicle.getSpeedWithoutTraCI(name) == libsumo.vehicle.getSpeed(name)
    return own and modes == (31, 1621) and libsumo.vehicle.getSpeedFactor(name) == 1.0


def test_braking_follows_a_signal_within_the_limit_of_the_vehicle_type(drive):
    strength = {"brake@6": "signal:constant:3:1.5", "brake@6[0]": 1.0, "brake@6[1]": 9.0, "brake@6[2]": 0.0}
    episode, watch = drive(planned(6, "brake", strong=9.0, long=1.5), strength=strength)
    advance(episode, 20)
    assert np.diff(watch.speeds("lead"))[5:20] / 0.1 == pytest.approx([-1.0] * 5 + [-4.5] * 5 + [0.0] * 5)
    (told,) = watch.told
    assert (told.how_strong, told.strengths[5:10]) == (4.5, (9.0,) * 5)
    advance(episode, 1)
    assert drives_by_itself("lead")


def test_the_one_that_is_ahead_brakes_and_drives_on_by_itself(drive):
    episode, watch = drive(planned(6, "brake"))
    advance(episode, 5)
    assert drives_by_itself("lead")
    advance(episode, 10)
    speeds = watch.speeds("lead")
    assert np.allclose(np.diff(speeds)[5:15] / 0.1, -3.0)
    assert watch.told == [replace(planned(6, "brake"), vehicle="lead")]
    advance(episode, 1)
    assert drives_by_itself("lead")
    assert watch.speeds("lead")[-1] > speeds[-1]


def test_a_dawdler_that_had_to_wait_continues_as_slowly_as_before_and_no_slower(drive):
    front = AHEAD.replace('"lead"', '"front"').replace('"60"', '"75"')
    episode, watch = drive(planned(3, "dawdle", strong=0.5, long=18.0), traffic=front + AHEAD, agent=Steady(0.0))
    advance(episode, 4)
    wanted = watch.speeds("lead")[2] / 2
    libsumo.vehicle.setSpeed("front", 0.0)
    advance(episode, 80)
    assert watch.told[0].vehicle == "lead"
    assert watch.speeds("lead")[-1] < 0.1
    libsumo.vehicle.setSpeed("front", -1.0)
    advance(episode, 60)
    assert watch.speeds("lead")[-1] == pytest.approx(wanted)


@pytest.mark.parametrize(("at", "who"), [(45, "left ahead"), (27, "left"), (10, "left behind")])
def test_places_are_along_the_lanes(drive, at, who):
    episode, watch = drive(planned(2, "cut_in", who, 0.0, 3.0), traffic=AHEAD + LEFT.format(at))
    advance(episode, 4)
    assert watch.told[0].vehicle == "left"
    others = [place for place in ("left ahead", "left", "left behind", "right", "right ahead") if place != who]
    assert [episode.simulator.resolve_target(planned(2, "cut_in", place)) for place in others] == [""] * 4


def test_an_actor_cuts_in_and_brakes_and_continues_as_it_likes(drive):
    episode, watch = drive(planned(2, "cut_in", "left ahead", 3.0, 2.0), traffic=LEFT.format(40))
    advance(episode, 6)
    assert libsumo.vehicle.getLaneID("left") == "west_0"
    assert watch.told[0].words == "left cuts in on ego within 2 s and brakes with 3 m/s²"
    advance(episode, 10)
    assert min(np.diff(watch.speeds("left")) / 0.1) == pytest.approx(-3.0)
    advance(episode, 7)
    assert drives_by_itself("left")


def test_no_one_cuts_in_into_the_side_of_an_actor(drive):
    episode, watch = drive(planned(2, "cut_in", "left", 0.0, 1.0), traffic=LEFT.format(27))
    advance(episode, 12)
    assert watch.told[0].vehicle == "left"
    assert all(not scene.contacts for scene in watch.scenes)
    assert libsumo.vehicle.getLaneID("left") == "west_1"


def test_who_leaves_while_it_deviates_is_let_go(drive):
    short = AHEAD.replace('departPos="60"', 'departPos="120"') + '<vehicle id="last" type="car" route="up" depart="9"/>'
    episode, watch = drive(planned(2, "dawdle", strong=0.2, long=60.0), traffic=short, agent=Steady(6.0))
    advance(episode, 400)
    assert watch.told[0].vehicle == "lead"
    assert episode.result.failure is None


def test_who_is_not_seen_is_excluded_of_the_observation_and_nothing_else_changes(drive):
    seen = []
    for disturbances in ((), (planned(3, "unseen", "behind", 1.0, 1.0),)):
        episode, watch = drive(*disturbances)
        shown = []
        for _ in range(16):
            shown.append(episode.observations["ego"].copy())
            episode.step()
        seen.append((shown, watch.speeds("lead"), watch.speeds("follow")))
        assert [one.vehicle for one in watch.told] == ["follow"] * len(disturbances)
    (plain, *others), (hidden, *same) = seen
    assert others == same
    counts = [int(observation[:, 0].sum()) for observation in hidden]
    assert counts == [3] * 3 + [2] * 10 + [3] * 3
    assert all((a == b).all() for a, b in zip(plain[:3] + plain[13:], hidden[:3] + hidden[13:], strict=True))


RATES = {
    "unseen": 0.3,
    "brake": 0.6,
    "stop": 0.1,
    "dawdle": 0.2,
    "speed": 0.4,
    "cut_in": 0.6,
    "ignore_priority": 0.3,
    "late_merge": 0.4,
}


@pytest.mark.parametrize("name", ["merge", "intersection"])
def test_in_dense_traffic_everybody_stays_within_its_type(tmp_path, name):
    scenario = load_scenario(name)
    simulator = SumoSimulator(scenario, tmp_path)
    assert set(simulator.disturbing_kinds) == set(scenario.backend.disturbances)
    count = 0
    disturber = disturber_of(RATES, agents=tuple(scenario.agents), step_length_s=0.1)
    for seed in range(3):
        watch, limits = Watch(), {}
        drawn = disturber.draw(seed, 300)
        spec = TrialSpec(0, seed, {}, argument_values(scenario), 300, disturbances=drawn)
        with Episode(spec, simulator=simulator, make_agent=lambda *_: Steady(10.0), observers=(watch,)) as episode:
            episode.start()
            while episode.result is None:
                for vehicle in libsumo.vehicle.getIDList():
                    if vehicle not in limits:
                        brakes = libsumo.vehicle.getDecel(vehicle), libsumo.vehicle.getEmergencyDecel(vehicle)
                        limits[vehicle] = max(brakes), libsumo.vehicle.getAccel(vehicle)
                episode.step()
            assert episode.result.failure is None, episode.result.failure
        there = [one for one in watch.told if one.vehicle]
        count += len(there)
        assert not {one.vehicle for one in there} & scenario.agents.keys()
        for before, after in zip(watch.scenes, watch.scenes[1:], strict=False):
            for actor, speed in zip(after.roster.actors, after.speeds, strict=True):
                row = before.roster.index.get(actor.id)
                if row is not None and actor.id in limits and actor.id not in scenario.agents:
                    change = (speed - before.speeds[row]) / 0.1
                    hardest, fastest = limits[actor.id]
                    assert -hardest - 1e-6 <= change <= fastest + 1e-6, (actor.id, after.time_s)
    simulator.close()
    assert count > 4


def test_an_actor_ignores_the_red_light(drive):
    """The street is green first; who comes from the south has red until it ignores that."""
    crossing = '<vehicle id="cross" type="car" route="up" depart="0" departPos="50" departSpeed="8"/>'
    where = []
    for disturbances in ((), (planned(80, "ignore_priority", "right ahead", 1.0, 8.0),)):
        episode, watch = drive(*disturbances, traffic=crossing, steps=200)
        advance(episode, 120)
        where.append(libsumo.vehicle.getRoadID("cross") if "cross" in libsumo.vehicle.getIDList() else "gone")
        assert [one.vehicle for one in watch.told] == ["cross"] * len(disturbances)
    assert where[0] == "south"
    assert where[1] in ("north", "gone")


def held(step, what, vehicle, long=99.0):
    return Disturbance(step, "itself", what, 0.0, long, "ego", vehicle)


SLOW = """<vType id="slow" sigma="0" maxSpeed="2"/><vType id="eager" sigma="0" speedDev="0" lcSpeedGain="{}"/>
<vehicle id="eager" type="eager" route="across" depart="0" departPos="60" departLane="0" departSpeed="8"/>
<vehicle id="slow" type="slow" route="across" depart="0" departPos="{}" departLane="0" departSpeed="2"/>"""


def test_who_is_held_to_its_speed_heeds_no_one_and_then_drives_by_itself_again(drive):
    speeds = []
    for disturbances in ((), (held(6, "keep_speed", "eager", 2.0),)):
        episode, watch = drive(*disturbances, traffic=SLOW.format(0, 90))
        advance(episode, 27)
        speeds.append(np.array(watch.speeds("eager")))
    assert (speeds[1][:6] == speeds[0][:6]).all()
    assert min(speeds[0][6:26]) < speeds[0][5] - 1.0
    assert (speeds[1][5:26] == speeds[1][5]).all()
    assert speeds[1][26] < speeds[1][5] - 0.1
    assert drives_by_itself("eager")


def test_who_is_held_in_its_lane_does_not_change_it(drive):
    lanes = []
    for disturbances in ((), (held(2, "keep_lane", "eager"),)):
        episode, _ = drive(*disturbances, traffic=SLOW.format(5, 120))
        advance(episode, 45)
        lanes.append(libsumo.vehicle.getLaneIndex("eager"))
    assert lanes == [1, 0]


def test_who_is_taken_off_the_road_is_gone_from_that_step_on(drive):
    episode, watch = drive(held(6, "gone", "lead"), held(9, "gone", "nobody"))
    advance(episode, 12)
    there = ["lead" in scene.roster.index for scene in watch.scenes]
    assert there == [True] * 6 + [False] * 7
    assert all(len(scene.points) == len(scene.roster.actors) for scene in watch.scenes)
    assert [one.vehicle for one in watch.told] == ["lead", ""]
    assert "follow" in watch.scenes[-1].roster.index
