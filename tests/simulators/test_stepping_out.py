"""Persons of SUMO who step out onto the road, and vehicles that merge at the very end of their lane."""

from __future__ import annotations

import shutil
from pathlib import Path

import libsumo
import numpy as np
import pytest
from onlookers import Steady, Watch

from crashhunt.episode import Episode
from crashhunt.oracles import Overlap
from crashhunt.scenario import load_scenario
from crashhunt.simulators.sumo import SumoSimulator
from crashhunt.trial import Disturbance, Outcome, TrialSpec

NETS = Path(__file__).parent / "nets"
LANE_0_M, END_M = -4.8, 296.0  # y of the middle of the lane that ends, and x of its end
STEADY = '<vType id="steady" vClass="pedestrian" maxSpeed="1.4" speedFactor="1" speedDev="0"/>'
WALKER = (
    f'{STEADY}<person id="walker" type="steady" depart="0" departPos="60"><walk edges="e" arrivalPos="250"/></person>'
)
WAITING = '<person id="waiting" depart="0" departPos="60"><stop lane="e_0" duration="100"/></person>'
EGO = '<vehicle id="ego" depart="0" departPos="10" departSpeed="10"><route edges="e"/></vehicle>'


@pytest.fixture
def drive(tmp_path):
    """Runs an episode on a straight road with a sidewalk; returns its result and who watched."""
    made = []

    def run(traffic, *disturbances, net="sidewalk", speed=5.0, steps=120):
        folder = tmp_path / f"s{len(made)}"
        (folder / "stage").mkdir(parents=True)
        shutil.copy(NETS / f"{net}.net.xml", folder / "n.net.xml")
        (folder / "r.rou.xml").write_text(f"<routes>{traffic}</routes>")
        (folder / "scenario.toml").write_text(
            'title = "t"\nschema = 1\nsimulator = "sumo"\nstep_length_s = 0.1\nwarmup_s = 0.0\n'
            '[sumo]\nnet = "n.net.xml"\nroutes = ["r.rou.xml"]\n[agents.ego]\nexisting = true\n'
        )
        simulator = SumoSimulator(load_scenario(folder), folder / "stage")
        made.append(simulator)
        watch = Watch()
        spec = TrialSpec(0, 1, {}, {}, steps, disturbances=disturbances)
        with Episode(spec, simulator=simulator, make_agent=lambda *_: Steady(speed), observers=(watch,)) as episode:
            episode.start()
            while episode.result is None:
                episode.step()
        assert episode.result.failure is None, episode.result.failure
        return episode.result, watch

    yield run
    for simulator in made:
        simulator.close()


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


def test_nobody_steps_out_faster_than_its_type_can_nor_further_than_it_is_back_in_time(drive):
    slow = WALKER.replace('"1.4"', '"0.5"')
    _, watch = drive(EGO + slow, stepping(20, strong=3.0, long=2.0))
    assert watch.told[0].how_strong == 0.5
    points = np.array(watch.of("person walker", "points"))
    assert points[:, 1].max() - points[19, 1] == pytest.approx(0.5)  # a second out, a second back
    assert points[39, 1] == pytest.approx(points[19, 1])


@pytest.mark.parametrize(
    ("traffic", "who"), [(WALKER, "left ahead"), (WAITING, "right ahead"), ("", "right ahead"), (WALKER, "right")]
)
def test_who_is_elsewhere_or_does_not_walk_is_not_meant(drive, traffic, who):
    result, watch = drive(EGO + traffic, stepping(20, who=who), steps=30)
    assert [one.vehicle for one in watch.told] == [""]
    assert not result.disturbances


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


def test_whose_lane_goes_on_merges_nowhere(drive):
    ego, other = MERGING.format("ego", 10, 0), MERGING.format("other", 25, 1)
    _, watch = drive(ego + other, Disturbance(2, "left ahead", "late_merge", 10.0, 60.0, "ego"), net="taper", steps=5)
    assert [one.vehicle for one in watch.told] == [""]
