"""Persons of SUMO who step out onto the road, and vehicles that merge at the very end of their lane."""

from __future__ import annotations

import math
import os
import resource
from collections import Counter
from pathlib import Path

import libsumo
import numpy as np
import pytest
from onlookers import Steady, Watch

from crashhunt.episode import Episode
from crashhunt.oracles import Overlap
from crashhunt.scenario import AgentSetup
from crashhunt.sumo import _simulator
from crashhunt.sumo._disturbances import JunctionLanes, SteppingOut, _between, _nearest, can_step_out
from crashhunt.trial import Disturbance, Outcome, TrialSpec

NETS = Path(__file__).parent / "nets"
LANE_0_M, END_M = -4.8, 296.0  # y of the middle of the lane that ends, and x of its end
STEADY = '<vType id="steady" vClass="pedestrian" maxSpeed="1.4" speedFactor="1" speedDev="0"/>'
WALKER = (
    f'{STEADY}<person id="walker" type="steady" depart="0" departPos="60"><walk edges="e" arrivalPos="250"/></person>'
)
EGO = '<vehicle id="ego" depart="0" departPos="10" departSpeed="10"><route edges="e"/></vehicle>'


@pytest.fixture
def drive(sumo_runs):
    """Runs an episode on a straight road with a sidewalk; returns its result and who watched."""

    def run(traffic, *disturbances, net="sidewalk", speed=5.0, steps=120, strength=None):
        simulator = sumo_runs.written(
            NETS / f"{net}.net.xml", f"<routes>{traffic}</routes>", step_length_s=0.1, warmup_s=0.0,
            agents={"ego": AgentSetup(existing=True)},
        )  # fmt: skip
        watch = Watch()
        spec = TrialSpec(0, 1, {}, strength or {}, steps, disturbances=disturbances)
        with Episode(spec, simulator=simulator, make_agent=lambda *_: Steady(speed), observers=(watch,)) as episode:
            episode.start()
            while episode.result is None:
                episode.step()
        assert episode.result.failure is None, episode.result.failure
        return episode.result, watch

    return run


def stepping(step, strong=1.4, long=6.0, who="right ahead"):
    return Disturbance(step, who, "step_out", strong, long, "ego")


def test_a_walker_steps_out_and_walks_on_where_it_was_going(drive):
    _, plain = drive(EGO + WALKER)
    _, watch = drive(EGO + WALKER, stepping(20))
    (told,) = watch.told
    assert told.vehicle == "person walker"
    assert told.words == "person walker steps out onto the road with 1.4 m/s, and is back after 6 s"
    points, speeds = np.array(watch.of("person walker", "points")), np.array(watch.of("person walker", "speeds"))
    out = points[:, 1] - points[19, 1]
    way = watch.of("ego", "points")[0][1] - points[19, 1]
    assert out.max() == pytest.approx(way)  # the middle of the agent's way, and no further
    assert np.flatnonzero(out > 0.01).tolist() == list(range(20, 79))  # away from step 20 on, for 6 s
    moved = np.hypot(*np.diff(points[19:80], axis=0).T) / 0.1
    assert moved.max() == pytest.approx(1.4)  # as fast as said, never faster
    assert speeds[20:80] == pytest.approx(moved)  # and that is what others are shown
    assert moved[25:30] == pytest.approx(0.0)  # it stands there
    assert points[80:, 1] == pytest.approx(points[19, 1])
    walked = np.diff(points[80:, 0])  # it goes on where it was going
    assert (len(points), walked.min() > 0.05, walked.max() < 0.2) == (121, True, True)
    assert np.array(plain.of("person walker", "points"))[:20].tolist() == points[:20].tolist()


def test_person_steps_out_as_fast_as_a_signal_and_is_back_in_time(drive):
    strength = {"step_out@20": "signal:constant:3:6.0"}
    strength |= {f"step_out@20[{number}]": value for number, value in enumerate((1.2, 0.0, 0.7))}
    _, watch = drive(EGO + WALKER, stepping(20), strength=strength)
    points = np.array(watch.of("person walker", "points"))
    moved = np.hypot(*np.diff(points[19:80], axis=0).T) / 0.1
    out = points[:, 1] - points[19, 1]
    assert moved[:11] == pytest.approx(watch.told[0].how_strong) == 1.2
    assert out[39] == pytest.approx(1.4)  # the 2 s of the last part suffice for 1.4 m back
    assert moved[20:40] == pytest.approx(0.0)
    assert moved[40:60] == pytest.approx(0.7)
    assert out[79] == pytest.approx(0.0)


def test_scene_has_the_headings_and_speeds_of_persons_and_vehicles(drive):
    _, watch = drive(EGO + WALKER, steps=5)
    core = _simulator.core_for(_simulator.VERSION, _simulator.sumo.__file__)
    for step, scene in enumerate(watch.scenes):
        assert [actor.id for actor in scene.roster.actors] == ["ego", "person walker"]
        assert [*scene.headings] == [0.0, 0.0]  # both go east
        assert scene.speeds[0] == pytest.approx(10.0 - 0.45 * step)  # it brakes with 4.5 m/s²
        assert (scene.speeds[1] > 1.0) == (step > 0)
        assert scene.points[1][1] < scene.points[0][1]
        assert scene.core is core  # which is no longer used after it has read something wrong


def test_who_steps_out_can_be_hit(drive):
    result, watch = drive(EGO + WALKER, stepping(10, long=10.0), speed=12.0, steps=60)
    oracle = Overlap()
    found = [finding for scene in watch.scenes for finding in oracle.check(scene, ("ego",))]
    assert result.disturbances
    assert (found[0].outcome, found[0].collision.victim) == (Outcome.COLLISION, "person walker")


MERGING = (
    '<vehicle id="{}" depart="0" departPos="{}" departSpeed="10" departLane="{}"><route edges="wide narrow"/></vehicle>'
)


@pytest.mark.parametrize("strong", [10.0, 30.0])
def test_a_vehicle_merges_only_at_the_end_of_its_lane(drive, strong):
    ego, other = MERGING.format("ego", 10, 1), MERGING.format("merges", 25, 0)
    left = []
    for disturbances in ((), (Disturbance(2, "right ahead", "late_merge", strong, 30.0, "ego"),)):
        result, watch = drive(ego + other, *disturbances, net="taper", speed=9.0, steps=340)
        points = np.array(watch.of("merges", "points"))
        changed = np.flatnonzero(points[:, 1] > LANE_0_M + 0.1)[0]
        left.append(END_M - points[changed - 1][0])
        assert [one.vehicle for one in result.disturbances] == ["merges"] * len(disturbances)
        assert libsumo.vehicle.getLaneChangeMode("merges") == 1621  # SUMO's default: it drives by itself again
        assert points[-1][0] > 300
    assert left[0] > 100  # by itself it merges soon
    assert strong - 2 < left[1] <= strong


def traffic_at_two_junctions():
    """Persons who walk from each street to each other one, and vehicles that drive likewise."""
    streets = {"w": "c", "n": "c", "s": "c", "e": "d", "m": "d", "t": "d"}
    ways = [(f"{a}{streets[a]}", f"{streets[b]}{b}") for a in streets for b in streets if a != b]
    people = [
        f'<person id="p{at}.{a}.{b}" depart="{at * 10 + number * 0.3:.2f}" departPos="25">'
        f'<walk from="{a}" to="{b}"/></person>'
        for at in range(4)
        for number, (a, b) in enumerate(ways)
    ]
    cars = [
        f'<trip id="v{at}.{a}.{b}" depart="{at * 60 + number * 2}" from="{a}" to="{b}"/>'
        for at in range(2)
        for number, (a, b) in enumerate(ways)
    ]
    return "".join(people), "".join(cars)


@pytest.fixture
def junction(tmp_path):
    routes = []
    for index, traffic in enumerate(traffic_at_two_junctions()):
        routes.append(str(tmp_path / f"{index}.rou.xml"))
        Path(routes[-1]).write_text(f"<routes>{traffic}</routes>")
    files = [f"--net-file={NETS / 'walks.net.xml'}", f"--route-files={','.join(routes)}"]
    options = [
        "--step-length=0.5",
        "--seed=3",
        "--collision.check-junctions",
        "--collision.action=warn",
        "--no-warnings",
    ]
    (libsumo.load if libsumo.isLoaded() else lambda words: libsumo.start(["sumo", *words]))([*files, *options])
    yield
    libsumo.close()


def meetings(person):
    """The vehicles into whose way a person may step."""
    x, y = libsumo.person.getPosition(person)
    for vehicle in libsumo.vehicle.getIDList():
        heading = math.radians(90 - libsumo.vehicle.getAngle(vehicle))
        dx, dy = x - libsumo.vehicle.getPosition(vehicle)[0], y - libsumo.vehicle.getPosition(vehicle)[1]
        ahead, left = dx * math.cos(heading) + dy * math.sin(heading), dy * math.cos(heading) - dx * math.sin(heading)
        if 0 < ahead <= 60 and 1.6 < abs(left) <= 15:
            yield vehicle


MAPPED = 2  # exit code: SUMO has put the person onto a crossing, a walking area or the inside of a junction


def outcome_of_stepping_out(person, vehicle, seconds=6.0):
    """How a copy of this process ends in which that happens: 0, `MAPPED`, or minus the signal that ended it."""
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        code = 1
        try:
            steps = round(seconds / 0.5)
            stepping = SteppingOut(f"person {person}", vehicle, [1.4] * steps, 0.5, {})
            roads = set()
            for _ in range(steps - 1):
                libsumo.simulationStep()
                roads.add(libsumo.person.getRoadID(person))
                stepping.keep()
            libsumo.simulationStep()
            stepping.end()
            for _ in range(20):
                libsumo.simulationStep()
            code = MAPPED if any(road.startswith(":") for road in roads) else 0
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@pytest.mark.nightly
def test_near_junctions_persons_step_out_only_where_sumo_keeps_them_on_their_sidewalk(junction):
    """Elsewhere SUMO may map them to a crossing or a walking area, and on large networks the process may die then."""
    junctions, refused, outcomes = JunctionLanes(), Counter(), Counter()
    for step in range(120):
        libsumo.simulationStep()
        for person in libsumo.person.getIDList()[step % 2 :: 2]:
            inside = libsumo.person.getRoadID(person).startswith(":")
            for vehicle in list(meetings(person))[:1]:
                if can_step_out(f"person {person}", vehicle, 4.2, junctions):
                    assert not inside
                    outcomes[outcome_of_stepping_out(person, vehicle)] += 1
                else:
                    refused[inside] += 1
    assert set(outcomes) == {0}
    assert outcomes[0] > 10
    assert refused[True] > 10
    assert refused[False] > 10


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ((3, 4), (4, 90, 0)),
        ((-3, 4), (5, 90, 8)),  # before the beginning: the next perpendicular is on the other part
        ((-3, -4), (5, 90, math.hypot(13, 4) - 5)),  # the corner counts as one
        ((13, -4), (5, 90, 0)),  # around a corner that is passed on the outside
        ((14, 7), (4, 0, 0)),
        ((10, 25), (5, 0, 20)),
    ],
)
def test_the_nearest_point_of_a_lane(point, expected):
    assert _nearest([(0, 0), (10, 0), (10, 20)], point) == pytest.approx(expected)


@pytest.mark.parametrize(("one", "other", "angle"), [(10, 350, 20), (350, 10, 20), (0, 180, 180), (-90, 270, 0)])
def test_the_angle_between_two_directions(one, other, angle):
    assert _between(one, other) == angle


def test_lanes_of_junctions_are_looked_for_nearby_only(junction):
    """At the first junction, 50 m from the second one: within how far a person gets, and how far others may be."""
    junctions = JunctionLanes()
    everything = {lane.shape for lane in junctions.near((25.0, 0.0), 100.0)}
    walked = [lane for lane in libsumo.lane.getIDList() if lane.startswith(":") and lane[2:4] in ("_c", "_w")]
    assert everything == {libsumo.lane.getShape(lane) for lane in walked}
    areas = [lane for lane in walked if lane[2:4] == "_w"]
    assert sum(lane.walking_area for lane in junctions.near((25.0, 0.0), 100.0)) == len(areas) > 8
    for x, y in ((0.0, 0.0), (0.0, 20.0), (0.0, -25.0), (25.0, 0.0), (70.0, 5.0), (-45.0, 0.0), (25.0, 70.0)):
        reach = 4.0 + 15.0 + 3.2
        expected = {
            shape
            for shape in everything
            if (np.min(shape, axis=0) <= np.array((x, y)) + reach).all()
            and (np.max(shape, axis=0) >= np.array((x, y)) - reach).all()
        }
        assert {lane.shape for lane in junctions.near((x, y), 4.0)} == expected
    assert not expected
