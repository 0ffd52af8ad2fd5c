"""Parts of observations on SUMO, compared with libsumo's own getters and with finite differences of positions."""

from __future__ import annotations

import functools
import itertools
import math
import shutil
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import libsumo
import numpy as np
import pytest
import sumolib
from conftest import mostly_nightly

from crashhunt.scenario import argument_values, load_scenario
from crashhunt.simulators import PARTS, BicycleModel, MotionState
from crashhunt.sumo import SumoSimulator
from crashhunt.sumo._observing import READERS
from crashhunt.sumo._scene_readers import PredictionsReader
from crashhunt.trial import Disturbance

STEPS = 90
FEW = {"vehicles": 12}  # on the loop, whose usual traffic takes most of the time of a short episode
NETS = Path(__file__).parent / "nets"


def simulator_of(name, stage, *parts, **changes):
    """A simulator whose agents observe parts."""
    scenario = load_scenario(name)
    agents = {agent: replace(setup, observation=parts, action="continuous") for agent, setup in scenario.agents.items()}
    stage.mkdir(exist_ok=True)
    return SumoSimulator(replace(scenario, agents=agents, **changes), stage)


def episode(simulator, seed, steps, speed=11.0, change=0, **arguments):
    """Yield the observation of the first agent after each step, and the agent."""
    values = {**argument_values(simulator._scenario), **arguments}
    observations, _ = simulator.reset(seed=seed, options={"arguments": values})
    agent = simulator.agents[0]
    yield simulator.restore_observation(agent, observations[agent])
    for step in range(steps):
        actions = {one: simulator.actions[one].encode((speed, change if step == 20 else 0)) for one in simulator.agents}
        if agent not in actions:
            return
        observations, *_ = simulator.step(actions)
        if agent not in simulator.scene().roster.index:
            return
        yield simulator.restore_observation(agent, observations[agent])


def center(vehicle):
    """The centre of a vehicle's rectangle, from libsumo."""
    x, y = libsumo.vehicle.getPosition(vehicle)
    angle, length = math.radians(90.0 - libsumo.vehicle.getAngle(vehicle)), libsumo.vehicle.getLength(vehicle)
    return np.array((x - length / 2 * math.cos(angle), y - length / 2 * math.sin(angle)))


def test_sumo_has_a_reader_for_each_of_its_parts():
    from crashhunt.sumo import BACKEND

    assert set(BACKEND.observations) == set(READERS) <= set(PARTS)


@pytest.mark.parametrize(
    ("name", "speed"),
    mostly_nightly(
        [("loop", 9.0), ("intersection", 13.0), ("merge", 13.0), ("motorway", 9.0)],
        always=[("loop", 9.0), ("motorway", 9.0)],
    ),
)
def test_ego_and_actors_are_what_libsumo_reports(name, speed, tmp_path):
    with closing(simulator_of(name, tmp_path / "stage", "ego", "actors:rows=60:radius=90")) as simulator:
        ego, actors = (
            {column.name: index for index, column in enumerate(PARTS[part].columns)} for part in ("ego", "actors")
        )
        previous, leaders, seen = None, 0, 0
        start = time = None
        steps = STEPS
        if name == "loop":  # into the bend, where all terms of a turn count, and read by Python as without the core
            steps, simulator._parts.core = 220, None
        for shown in episode(simulator, 7, steps, speed=speed, change=name == "motorway"):
            agent = next(iter(simulator.observation_layouts))
            assert simulator.observation_layouts[agent].space.contains(shown)
            own = {column: shown["ego"][index] for column, index in ego.items()}
            place = np.array((own["x"], own["y"]))
            assert place == pytest.approx(center(agent), abs=1e-9)
            getters = libsumo.vehicle
            if start is None:
                start, time = getters.getDistance(agent), libsumo.simulation.getTime()
            assert own["speed"] == getters.getSpeed(agent)
            assert own["acceleration"] == pytest.approx(getters.getAcceleration(agent), abs=1e-9)
            assert (own["length"], own["width"]) == (getters.getLength(agent), getters.getWidth(agent))
            assert own["lane_index"] == getters.getLaneIndex(agent)
            assert own["lane_offset"] == getters.getLateralLanePosition(agent)
            assert own["distance"] == getters.getDistance(agent) - start
            assert own["time"] == libsumo.simulation.getTime() - time
            turned = math.radians(90.0 - getters.getAngle(agent)) - own["heading"]
            assert math.cos(turned) == pytest.approx(1.0)
            assert -math.pi <= own["heading"] <= math.pi
            others = [one for one in getters.getIDList() if one != agent]
            away = {one: float(np.hypot(*(center(one) - place))) for one in others}
            near = sorted((distance, one) for one, distance in away.items() if distance <= 90.0)
            rows = shown["actors"]
            assert rows[: len(near), 0].all()
            assert not rows[len(near) :].any()
            ids = simulator.identifiers(agent)
            assert [away[one] for one in ids] == pytest.approx([distance for distance, _ in near])
            for row, one in zip(rows, ids, strict=False):
                actor = {column: row[index] for column, index in actors.items()}
                assert (actor["x"], actor["y"]) == pytest.approx(tuple(center(one)), abs=1e-9)
                assert math.hypot(actor["vx"], actor["vy"]) == pytest.approx(getters.getSpeed(one))
                assert actor["acceleration"] == pytest.approx(getters.getAcceleration(one), abs=1e-9)
                assert (actor["length"], actor["width"]) == (getters.getLength(one), getters.getWidth(one))
                assert actor["lane_offset"] == getters.getLateralLanePosition(one)
                signals = getters.getSignals(one)
                assert actor["brake_light"] == bool(signals & 8)
                assert actor["indicator"] == {0: 0.0, 1: -1.0, 2: 1.0}[signals & 3]
                offset = center(one) - place
                ahead = offset @ (math.cos(own["heading"]), math.sin(own["heading"]))
                assert actor["ahead"] == pytest.approx(ahead)
                seen += 1
                if getters.getLaneID(one) == getters.getLaneID(agent):
                    assert actor["same_lane"]
                if previous is not None and previous.get(one, (0, 0))[1] == getters.getAngle(one):
                    # The centre moves along the heading, apart from turns and from changes of lane, which are jumps.
                    moved = (center(one) - previous[one][0]) / simulator.step_length_s
                    if abs(actor["lane_offset"]) < 0.01 and np.hypot(*moved) < 40.0 and abs(moved[1] * moved[0]) < 1.0:
                        assert (actor["vx"], actor["vy"]) == pytest.approx(tuple(moved), abs=1.1)
            leader = getters.getLeader(agent, 60.0)
            if leader is not None and leader[0] in ids:
                row = rows[ids.index(leader[0])]
                assert row[actors["same_lane"]]
                assert row[actors["ahead"]] > 0
                leaders += 1
            previous = {one: (center(one), getters.getAngle(one)) for one in others}
        assert seen > 50
        assert leaders > 10


def test_yaw_rate_and_steering_are_those_of_a_circle(tmp_path):
    with closing(simulator_of("loop", tmp_path / "stage", "ego")) as simulator:
        columns = simulator.observation_layouts["ego"].columns["ego"]
        rows = np.array([shown["ego"] for shown in episode(simulator, 1, 250, speed=9.0, **FEW)])
    heading, yaw_rate, speed = (rows[:, columns[name]] for name in ("heading", "yaw_rate", "speed"))
    turned = np.angle(np.exp(1j * np.diff(heading)))
    assert yaw_rate[1:] == pytest.approx(turned / 0.1)
    assert yaw_rate[0] == 0
    assert abs(yaw_rate).max() > 0.05
    # A bicycle with this steering angle turns as the vehicle does.
    model = BicycleModel(
        wheelbase=0.6 * rows[0, columns["length"]], max_acceleration=9.0, max_deceleration=9.0, max_speed=99.0
    )
    for number in np.flatnonzero(abs(yaw_rate) > 0.01)[:40]:
        angle = rows[number, columns["steering"]]
        state = MotionState(x=0.0, y=0.0, heading=0.0, speed=speed[number], steering=angle)
        assert model.step(state, 0.0, angle, 0.001).heading / 0.001 == pytest.approx(yaw_rate[number])


def test_hidden_vehicle_is_not_among_the_actors(tmp_path):
    with closing(simulator_of("loop", tmp_path / "stage", "actors")) as simulator:
        values = {**argument_values(simulator._scenario), **FEW}
        simulator.reset(seed=1, options={"arguments": values})
        one, *_ = simulator.identifiers("ego")
        hidden = simulator.disturb(one, Disturbance(1, "ahead", "unseen", 1.0, 1.0, agent="ego"))
        action = {"ego": simulator.actions["ego"].encode((10.0, 0))}
        *_, infos = simulator.step(action)
        assert one not in infos["ego"]["actors"]
        hidden.end()
        *_, infos = simulator.step(action)
        assert one in infos["ego"]["actors"]


def test_observation_of_a_vehicle_that_has_left_is_zero(tmp_path):
    with closing(simulator_of("loop", tmp_path / "stage", "ego", "actors")) as simulator:
        simulator.reset(seed=1, options={"arguments": {**argument_values(simulator._scenario), **FEW}})
        libsumo.vehicle.remove("ego")
        observations, *_ = simulator.step({"ego": simulator.actions["ego"].encode((10.0, 0))})
        assert not observations["ego"].any()
        assert observations["ego"].shape == simulator.observation_spaces["ego"].shape


def test_all_actors_within_the_radius_are_shown_in_every_step(tmp_path):
    """Also those that approach fast between two looks around of the scene."""
    with closing(simulator_of("motorway", tmp_path / "stage", "actors:rows=200:radius=120")) as simulator:
        for shown in episode(simulator, 2, 60, speed=0.0):
            place = center("ego")
            near = {
                one for one in libsumo.vehicle.getIDList() if one != "ego" and np.hypot(*(center(one) - place)) <= 120.0
            }
            assert set(simulator.identifiers("ego")) == near
            assert shown["actors"][:, 0].sum() == len(near)


def test_default_observation_keeps_its_fast_path_and_other_agents_keep_theirs(sumo_runs):
    scenario = load_scenario("loop-two-agents")
    first, second = scenario.agents
    agents = {**scenario.agents, first: replace(scenario.agents[first], observation=("ego",))}
    _, before = sumo_runs.begin(scenario, 3)
    simulator, after = sumo_runs.begin(replace(scenario, agents=agents), 3)
    assert after[second].tobytes() == before[second].tobytes()
    assert set(simulator.restore_observation(first, after[first])) == {"ego"}
    assert set(simulator.shown_spaces) == {first}


def test_grid_and_image_show_the_lanes_and_the_vehicles_of_the_network(tmp_path):
    parts = ("grid:resolution=2", "image:rows=72:columns=40")
    with closing(simulator_of("merge", tmp_path / "stage", *parts)) as one:
        cars = 0
        for step, shown in enumerate(episode(one, 3, 35, speed=13.0)):
            if step % 5:
                continue
            others = [who for who in libsumo.vehicle.getIDList() if who != "ego"]
            grid = cells_on_lanes(64, 64, 2.0), cells_of_vehicles(others, 64, 64, 2.0)
            assert (shown["grid"][1] == grid[0]).all()
            assert (shown["grid"][0] == grid[1]).all()
            picture = np.full((72, 40, 3), (246, 247, 249), np.uint8)
            picture[cells_on_lanes(72, 40, 0.5)] = (228, 232, 237)
            picture[cells_of_vehicles(others, 72, 40, 0.5)] = (125, 139, 156)
            picture[cells_of_vehicles(["ego"], 72, 40, 0.5)] = (224, 138, 0)
            assert (shown["image"] == picture).all()
            cars += (picture == (125, 139, 156)).all(axis=2).any()
            assert one.observation_layouts["ego"].space.contains(shown)
        assert cars >= 2
        # Only bytes are recorded as bytes.
        assert one.observation_spaces["ego"].dtype == np.uint8


def places_of_cells(rows, columns, resolution):
    """Where the centres of the cells around ego are: the first row is ahead, the first column to the left."""
    (x, y), heading = center("ego"), math.radians(90.0 - libsumo.vehicle.getAngle("ego"))
    sides = [(count / 2 - np.arange(count) - 0.5) * resolution for count in (rows, columns)]
    ahead, left = np.meshgrid(*sides, indexing="ij")
    c, s = math.cos(heading), math.sin(heading)
    return x + ahead * c - left * s, y + ahead * s + left * c


def cells_on_lanes(rows, columns, resolution):
    """The cells on lanes that cars may use, from libsumo's shapes, cell by cell."""
    px, py = places_of_cells(rows, columns, resolution)
    found = np.zeros((rows, columns), bool)
    for lane in libsumo.lane.getIDList():
        allowed = libsumo.lane.getAllowed(lane)
        if allowed and "passenger" not in allowed:
            continue
        points, half = np.array(libsumo.lane.getShape(lane)), libsumo.lane.getWidth(lane) / 2
        for (ax, ay), (bx, by) in itertools.pairwise(points):
            dx, dy = bx - ax, by - ay
            share = np.clip(((px - ax) * dx + (py - ay) * dy) / max(dx * dx + dy * dy, 1e-12), 0, 1)
            found |= np.hypot(px - ax - share * dx, py - ay - share * dy) <= half
    return found


def cells_of_vehicles(vehicles, rows, columns, resolution):
    """The cells in the rectangles of vehicles, from libsumo's positions of their front bumpers."""
    px, py = places_of_cells(rows, columns, resolution)
    found = np.zeros((rows, columns), bool)
    for vehicle in vehicles:
        (x, y), angle = libsumo.vehicle.getPosition(vehicle), math.radians(libsumo.vehicle.getAngle(vehicle))
        behind = (x - px) * math.sin(angle) + (y - py) * math.cos(angle)
        beside = (x - px) * math.cos(angle) - (y - py) * math.sin(angle)
        inside = (behind >= 0) & (behind <= libsumo.vehicle.getLength(vehicle))
        found |= inside & (np.abs(beside) <= libsumo.vehicle.getWidth(vehicle) / 2)
    return found


def in_front_of(px, py, ahead_m):
    """Whether places are in a wall of 2 m across the way of ego, in front of the centre of its present rectangle."""
    (x, y), heading = center("ego"), math.radians(90.0 - libsumo.vehicle.getAngle("ego"))
    along = (px - x) * math.cos(heading) + (py - y) * math.sin(heading)
    across = (py - y) * math.cos(heading) - (px - x) * math.sin(heading)
    return (np.abs(along - ahead_m) < 1.0) & (np.abs(across) < 30.0)


@pytest.mark.parametrize("kind", ["building.wall", "park"])
def test_obstacle_ends_rays_and_sight_and_is_in_grid_and_image(kind, tmp_path):
    parts = ("actors:radius=120:rows=99", "lidar2d:rays=90", "grid:resolution=1.9", "image:rows=72:columns=40")
    folder = tmp_path / "walled"
    shutil.copytree(load_scenario("motorway").folder, folder)
    with closing(simulator_of("motorway", tmp_path / "a", *parts, "occlusion")) as plain:
        before = [(shown, plain.identifiers("ego")) for shown in episode(plain, 2, 12, speed=25.0)][::4]
        last, heading = center("ego"), math.radians(90.0 - libsumo.vehicle.getAngle("ego"))
    ahead, left = np.array((math.cos(heading), math.sin(heading))), np.array((-math.sin(heading), math.cos(heading)))
    # Ego, which SUMO drives through the wall, is behind it at first.
    wall = [last + u * ahead + v * left for u, v in ((-9, 30), (-7, 30), (-7, -30), (-9, -30))]
    shape = " ".join(f"{x:.2f},{y:.2f}" for x, y in wall)
    (folder / "wall.add.xml").write_text(f'<additional><poly id="w" type="{kind}" shape="{shape}"/></additional>')
    toml = folder / "scenario.toml"
    toml.write_text(toml.read_text().replace("[sumo]\n", '[sumo]\nadditional = ["wall.add.xml"]\n'))
    sides = []
    with closing(simulator_of(str(folder), tmp_path / "b", *parts, "occlusion")) as walled:
        for step, shown in enumerate(episode(walled, 2, 12, speed=25.0)):
            if step % 4:
                continue
            all_, everybody = before[step // 4]
            seen = walled.identifiers("ego")
            if kind == "park":
                assert seen == everybody
                assert all(shown[name].tobytes() == all_[name].tobytes() for name in all_)
                continue
            to_wall = float((last - center("ego")) @ ahead) - 8.0
            sides.append(to_wall > 0)
            columns, side = walled.observation_layouts["ego"].columns["actors"], math.copysign(1.0, to_wall)
            nearest = side * all_["actors"][:, columns["ahead"]] - all_["actors"][:, columns["length"]] / 2
            rows = zip(everybody, nearest, strict=False)
            assert seen == tuple(one for one, away in rows if away < abs(to_wall) - 1.0)
            in_wall = in_front_of(*places_of_cells(64, 64, 1.9), to_wall)
            assert in_wall.any()
            cars = cells_of_vehicles(seen, 64, 64, 1.9)
            assert (shown["grid"] == [cars | in_wall, all_["grid"][1]]).all()
            # The rays to the near side of the wall, which is across the heading.
            angles = math.tau * np.arange(90) / 90
            away = (to_wall - side) / np.cos(angles)
            to_side = np.where((away > 0) & (np.abs(away * np.sin(angles)) < 30.0), away, 100.0)
            assert shown["lidar2d"] == pytest.approx(np.minimum(to_side, all_["lidar2d"]), abs=0.1)
            assert (shown["lidar2d"] < all_["lidar2d"] - 1.0).any()
            picture = np.full((72, 40, 3), (246, 247, 249), np.uint8)
            picture[cells_on_lanes(72, 40, 0.5)] = (228, 232, 237)
            picture[in_front_of(*places_of_cells(72, 40, 0.5), to_wall)] = (196, 186, 176)
            picture[cells_of_vehicles(seen, 72, 40, 0.5)] = (125, 139, 156)
            picture[cells_of_vehicles(["ego"], 72, 40, 0.5)] = (224, 138, 0)
            assert (shown["image"] == picture).all()
    assert kind == "park" or {*sides} == {True, False}


@pytest.mark.parametrize("form", ["acceleration_steering", "throttle_brake_steering"])
def test_ego_that_moves_freely_is_where_its_bicycle_model_is(form, sumo_runs):
    simulator, _ = sumo_runs.begin("motorway", 2, observation=("ego", "actors"), action=form)
    motion, columns = simulator._driving.moving["ego"], simulator.observation_layouts["ego"].columns["ego"]
    driven, before = 0.0, motion.state
    for step in range(25):
        wave = 0.02 * math.sin(step / 4)
        action = (0.5, wave) if form == "acceleration_steering" else (0.3, 0.0, wave)
        observations, *_ = simulator.step({"ego": simulator.actions["ego"].encode(action)})
        own = simulator.restore_observation("ego", observations["ego"])["ego"]
        state = motion.state
        driven += math.hypot(state.x - before.x, state.y - before.y)
        expected = {
            "x": state.x, "y": state.y, "speed": state.speed, "steering": state.steering, "heading": state.heading,
            "yaw_rate": (state.heading - before.heading) / 0.1, "acceleration": (state.speed - before.speed) / 0.1,
        }  # fmt: skip
        assert own[[columns[name] for name in expected]] == pytest.approx([*expected.values()], abs=2e-3), step
        assert own[columns["distance"]] == pytest.approx(driven, rel=1e-4)
        before = state


def test_every_part_stacks_with_a_history_and_is_within_its_space(tmp_path):
    parts = tuple(f"{name}:rows=8:columns=8" if name in ("grid", "image") else name for name in READERS)
    with (
        closing(simulator_of("intersection", tmp_path / "a", *parts)) as plain,
        closing(simulator_of("intersection", tmp_path / "b", *parts, "history:steps=3")) as stacking,
    ):
        single = list(episode(plain, 4, 5))
        stacked = list(episode(stacking, 4, 5))
        assert stacking.observation_layouts["ego"].space.contains(stacked[-1])
    assert set(single[0]) == set(READERS)
    for step, shown in enumerate(stacked):
        for name in READERS:
            expected = [single[max(0, step - back)][name] for back in (2, 1, 0)]
            assert shown[name].dtype == single[0][name].dtype
            assert shown[name].tobytes() == np.stack(expected).tobytes(), (step, name)


@pytest.mark.parametrize(("point", "share"), [("center", 0.0), ("rear_axle", -0.3), ("front_bumper", 0.5)])
def test_positions_are_those_of_the_reference_point(point, share, tmp_path):
    with closing(
        simulator_of("loop", tmp_path / "stage", "ego", "actors", "predictions", f"reference_point:at={point}")
    ) as simulator:
        columns = simulator.observation_layouts["ego"].columns
        for shown in episode(simulator, 3, 8, **FEW):
            for who, row in zip(("ego", *simulator.identifiers("ego")), (shown["ego"], *shown["actors"]), strict=False):
                index = columns["ego" if who == "ego" else "actors"]
                heading = math.radians(90.0 - libsumo.vehicle.getAngle(who))
                ahead = share * libsumo.vehicle.getLength(who) * np.array((math.cos(heading), math.sin(heading)))
                assert row[[index["x"], index["y"]]] == pytest.approx(center(who) + ahead, abs=1e-9)
            assert shown["predictions"][0, 0, :2] == pytest.approx(
                shown["actors"][0, 1:3] + 0.1 * shown["actors"][0, 4:6]
            )
        if point == "front_bumper":
            assert shown["ego"][:2] == pytest.approx(libsumo.vehicle.getPosition("ego"), abs=1e-9)


def test_predictions_along_lanes_lead_where_actors_then_drive_that_stay_in_their_lane(tmp_path):
    """The way that SUMO's vehicles drive in the next seconds is the independent source."""
    parts = ("actors:rows=20", "predictions:rows=20:steps=20")
    errors = []
    for number, setting in enumerate(("", ":along=lanes")):
        with closing(simulator_of("loop", tmp_path / str(number), parts[0], parts[1] + setting)) as simulator:
            driven, seen = {}, []
            for shown in episode(simulator, 3, 36):
                seen.append(dict(zip(simulator.identifiers("ego"), shown["predictions"][:, -1], strict=False)))
                for who in libsumo.vehicle.getIDList():
                    place = (len(seen), libsumo.vehicle.getLaneIndex(who), *center(who))
                    driven.setdefault(who, []).append(place)
        found = []
        for step in (1, 5, 9):
            for who, (x, y, *_) in seen[step - 1].items():
                way = np.array([place for place in driven[who] if place[0] >= step])
                if np.ptp(way[:, 1]) == 0:
                    found.append(np.hypot(way[:, 2] - x, way[:, 3] - y).min())
        errors.append(np.array(found))
    straight, along = errors
    assert len(along) > 20
    assert straight.max() > 2.0
    assert along.max() < 1.6  # the way is known at steps of 0.1 s only


@pytest.mark.parametrize(("interval", "steps", "length_m"), [(0.5, 4, 120), (0.25, 7, 105), (0.5, 60, 1000)])
def test_path_of_a_prediction_is_as_long_as_a_vehicle_may_drive(interval, steps, length_m):
    reader = PredictionsReader(SimpleNamespace(settings={"interval": interval}, shape=(1, steps, 4)))
    assert (reader._sampling.points - 1) * reader._sampling.spacing_m == length_m


def test_noise_of_ranges_is_normal_and_that_of_the_seed(tmp_path):
    def drive(name, seed, words, core=True):
        with closing(simulator_of("motorway", tmp_path / name, "ego", words)) as simulator:
            if not core:
                simulator._parts.core = None
            shown = list(episode(simulator, seed, 24, speed=25.0))
            assert simulator.observation_layouts["ego"].space.contains(shown[-1])
        return np.array([one["lidar2d"] for one in shown])

    true, noisy, again, other = (
        drive(name, 2, words, core)
        for name, words, core in (
            ("a", "lidar2d", True), ("b", "lidar2d:noise=0.2", True), ("c", "lidar2d:noise=0.2", False),
            ("d", "lidar2d:rays=360:range=100:noise=0.1", True),
        )
    )  # fmt: skip
    assert noisy.tobytes() == again.tobytes()
    hits = true < 100.0
    assert (noisy[~hits] == 100.0).all()
    errors = (noisy - true)[hits]
    assert len(errors) > 1000
    assert errors.std() == pytest.approx(0.2, rel=0.1)
    assert abs(errors.mean()) < 0.03
    assert (other - true)[hits] == pytest.approx(errors / 2, abs=1e-9)
    assert (noisy[1] - true[1])[hits[1] & hits[2]] != pytest.approx((noisy[2] - true[2])[hits[1] & hits[2]])


def test_occlusion_hides_the_same_actors_in_every_part(tmp_path):
    parts = ("actors:radius=120:rows=99", "actor_ids:radius=120:rows=99", "predictions:radius=120:rows=99", "lidar2d")
    with (
        closing(simulator_of("motorway", tmp_path / "a", *parts)) as plain,
        closing(simulator_of("motorway", tmp_path / "b", *parts, "occlusion")) as hiding,
    ):
        before = [(shown, plain.identifiers("ego")) for shown in episode(plain, 2, 12, speed=25.0)]
        after = [(shown, hiding.identifiers("ego")) for shown in episode(hiding, 2, 12, speed=25.0)]
    fewer, names = 0, {}
    for (all_, everybody), (some, seen) in zip(before, after, strict=True):
        assert set(seen) <= set(everybody)
        fewer += len(everybody) - len(seen)
        assert [all_["actors"][everybody.index(one)].tolist() for one in seen] == some["actors"][: len(seen)].tolist()
        assert np.count_nonzero(some["predictions"].any(axis=(1, 2))) == len(seen)
        # The rays of lidar2d are among those that decide who is seen.
        assert some["lidar2d"].tobytes() == all_["lidar2d"].tobytes()
        for one, number in zip(seen, some["actor_ids"].tolist(), strict=False):
            assert names.setdefault(one, number) == number > 0
    assert fewer > 5


CROSSING_TOWN = """schema = 1
simulator = "sumo"
step_length_s = 0.1
[sumo]
net = "walks.net.xml"
routes = ["r.rou.xml"]
[agents.ego]
route = "ego"
observation = ["crossings", "right_of_way", "ego"]
"""


@functools.cache
@functools.cache
def must_yield(net, lane, target, crossing):
    """Whether the network file makes a path across junction c yield to a crossing."""
    junction = ElementTree.parse(NETS / "walks.net.xml").find("junction[@id='c']")
    inside = junction.get("intLanes").split()
    vias = [one.getViaLaneID() for one in net.getLane(lane).getOutgoing() if one.getTo().getID() == target]
    index = next(inside.index(one) for one in vias if one in inside)
    return int(junction.find(f"request[@index='{index}']").get("response")[-1 - inside.index(crossing)])


@functools.cache
def area_on(net, lane, target, crossing):
    """Where a lane ends, where its way to an edge meets a crossing, and the middle of this area on the crossing."""
    (start,) = (one for one in net.getLane(lane).getOutgoing() if one.getTo().getID() == target)
    path, via = [], start.getViaLaneID()
    while via:
        path += [point[:2] for point in net.getLane(via).getShape()]
        via = next((one.getViaLaneID() for one in net.getLane(via).getOutgoing()), "")
    (mine, along), (theirs, across) = densely(path), densely(crossing)
    close = ((mine[:, None] - theirs[None]) ** 2).sum(axis=2) < (0.8 * (3.2 + 4.0) / 2) ** 2
    ends = across[close.any(axis=0)][[0, -1]]
    middle = [np.interp(ends.mean(), across, theirs[:, axis]) for axis in (0, 1)]
    return net.getLane(lane).getLength(), along[close.any(axis=1)][0], middle


def densely(line):
    """Points every 4 cm along a line, and their distances from its start."""
    points = np.array(line)
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    at = np.arange(0.0, along[-1], 0.04)
    return np.column_stack([np.interp(at, along, points[:, axis]) for axis in (0, 1)]), at


@pytest.mark.parametrize(("target", "second"), [("cd", ":c_c1_0"), ("cs", ":c_c2_0")])
def test_crossings_show_the_persons_near_them(target, second, sumo_runs):
    """Persons, distances and their order by SUMO's own shapes and positions."""
    walks = "".join(
        f'<person id="p{number}" depart="{at}" departPos="-8"><walk from="{a}" to="{b}"/></person>'
        for number, (at, a, b) in enumerate([(0, "wc", "cw"), (1, "wc", "cs"), (1, "wc", "cw"), (3, "sc", "cd")])
    )
    routes = f'<routes><route id="ego" edges="wc {target}"/>{walks}</routes>'
    simulator = sumo_runs.open(sumo_runs.write(NETS / "walks.net.xml", routes, {"scenario.toml": CROSSING_TOWN}))
    net = sumolib.net.readNet(str(NETS / "walks.net.xml"), withInternal=True, withPedestrianConnections=True)
    crossings = (":c_c3_0", second)
    lines = [tuple(point[:2] for point in net.getLane(name).getShape()) for name in crossings]
    people, yields = 0, False
    for shown in episode(simulator, 1, 260, speed=1.2):
        lane = libsumo.vehicle.getLaneID("ego")
        if not lane.startswith("wc"):
            continue
        rows = shown["crossings"]
        assert rows[:, 0].tolist() == [1.0, 1.0, 0.0, 0.0]
        assert rows[0, 1] < rows[1, 1]
        middles = []
        for person in libsumo.person.getIDList():
            x, y = libsumo.person.getPosition(person)
            angle = math.radians(90.0 - libsumo.person.getAngle(person))
            half = libsumo.person.getLength(person) / 2
            middles.append((x - half * math.cos(angle), y - half * math.sin(angle)))
        for row, line, crossing in zip(rows, lines, crossings, strict=False):
            away = [sumolib.geomhelper.distancePointToPolygon(one, line) for one in middles]
            assert row[3] == sum(one <= 5.0 for one in away)
            stop_line, begin, middle = area_on(net, lane, target, line)
            assert row[1] == pytest.approx(stop_line - libsumo.vehicle.getLanePosition("ego") + begin, abs=0.1)
            nearest = min((math.dist(middle, one) for one in middles), default=1000.0)
            assert row[4] == pytest.approx(nearest, abs=0.1)
            people += int(row[3])
            yields |= bool(row[2])
            assert row[2] == must_yield(net, lane, target, crossing)
    assert people > 20
    assert yields == (target == "cs")  # who turns gives way


def test_vehicle_data_contain_the_limits_of_the_bicycle_model(tmp_path):
    with closing(simulator_of("loop", tmp_path / "stage", "ego")) as simulator:
        simulator.reset(seed=1, options={"arguments": {**argument_values(simulator._scenario), **FEW}})
        data = simulator.vehicle_data("ego")
    model = BicycleModel(wheelbase=data.wheelbase, max_acceleration=9.0, max_deceleration=9.0, max_speed=99.0)
    state = MotionState(x=0.0, y=0.0, heading=0.0, speed=5.0)
    after = model.step(state, 9.0, 9.0, 0.01)
    assert after.steering == pytest.approx(data.max_steering_rate * 0.01)
    assert after.acceleration == pytest.approx(data.max_jerk * 0.01)
    assert model.step(state, 0.0, 9.0, 10.0).steering == data.max_steering
