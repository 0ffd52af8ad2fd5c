"""The rules of `list requirements` on recorded traffic: against loops over what libsumo itself reports."""

from __future__ import annotations

import math
import re
import shutil
from itertools import pairwise
from pathlib import Path

import libsumo
import numpy as np
import pytest
from conftest import mostly_nightly
from crossing_lines import crossing

from crashhunt.agents import CarFollowing
from crashhunt.episode import SIGNALS as KNOWN_SIGNALS, Episode, TrialSignals
from crashhunt.oracles import Overlap, RequirementOracle
from crashhunt.requirements import TRAFFIC_RULES, parse
from crashhunt.scenario import AgentSetup, argument_values, load_scenario
from crashhunt.sumo import SumoSimulator
from crashhunt.trial import Outcome, TrialSpec

ROOT = Path(__file__).parents[2]
SIGNAL = Path(__file__).with_name("signal.net.xml")
SIGNALS = sorted({name for rule in TRAFFIC_RULES.values() for name in parse(rule.formula).signals})


class Hectic:
    """Holds a random speed for some time each, and sometimes stops."""

    def reset(self, seed):
        self.rng, self.speed, self.left = np.random.default_rng(seed), 15.0, 0

    def act(self, observation):
        if not self.left:
            self.speed, self.left = float(self.rng.choice([0.0, 8.0, 14.0, 25.0, 40.0])), int(self.rng.integers(5, 60))
        self.left -= 1
        return self.speed, 0


def raw(agent):
    """What libsumo reports of the agent and of the nearest vehicle ahead on its lane, if that is on the same lane."""
    lane, place = libsumo.vehicle.getLaneID(agent), libsumo.vehicle.getLanePosition(agent)
    ahead = [
        (libsumo.vehicle.getLanePosition(other) - libsumo.vehicle.getLength(other) - place, other)
        for other in libsumo.vehicle.getIDList()
        if other != agent
        and libsumo.vehicle.getLaneID(other) == lane
        and libsumo.vehicle.getLanePosition(other) > place
    ]
    gap_m, leader = min(ahead, default=(math.inf, ""))
    speed = libsumo.vehicle.getSpeed(leader) if leader else math.inf
    return libsumo.vehicle.getSpeed(agent), gap_m, leader, speed, lane


def driven(scenario_name, seed, steps, tmp_path, agent=Hectic):
    """Run a trial; return its result, the signals of all rules, and what libsumo reported."""
    scenario = load_scenario(scenario_name)
    simulator = SumoSimulator(scenario, tmp_path)
    spec = TrialSpec(0, seed, {}, argument_values(scenario), steps)
    oracles = [Overlap(), *(RequirementOracle(name, rule.formula) for name, rule in TRAFFIC_RULES.items())]
    with Episode(
        spec, simulator=simulator, make_agent=lambda *_: agent(), oracles=oracles, crash_on=(Outcome.COLLISION,)
    ) as episode:
        result = episode.start()
        name = episode.names[0]
        read = TrialSignals(episode).reader(SIGNALS, name)
        rows, seen = [read()], [raw(name)]
        while result is None:
            result = episode.step()
            if (row := read()) is not None and name in libsumo.vehicle.getIDList():
                rows.append(row)
                seen.append(raw(name))
    simulator.close()
    return result, dict(zip(SIGNALS, map(np.array, zip(*rows, strict=True)), strict=True)), seen, scenario


def by_loops(rule, signals, step_s):
    """Whether a rule holds, without temporal logic."""
    row = [dict(zip(signals, values, strict=True)) for values in zip(*signals.values(), strict=True)]
    has_moved, since_change = False, math.inf
    for at in row:
        has_moved |= at["speed"] > 1
        since_change = 0 if at["leader_changed"] else since_change + 1
        brakes = at["speed"] ** 2 / (2 * 10) - at["leader_speed"] ** 2 / (2 * 10) + 0.3 * at["speed"]
        is_safe = at["gap_m"] >= brakes
        wrong = {
            "safe-distance": not is_safe and since_change > round(3 / step_s),
            "unnecessary-braking": at["acceleration"] < -2 and is_safe and at["red_light_m"] >= 100
            and at["priority_m"] >= 100 and at["acceleration"] - at["leader_acceleration"] < -2,
            "maximum-speed": at["speed"] > at["speed_limit"] + 0.01,
            "no-stopping": has_moved and at["speed"] < 0.1 and at["red_light_m"] >= 20 and at["priority_m"] >= 20
            and not (at["gap_m"] < 20 and at["leader_speed"] < 5),
            "right-of-way": at["priority_arrival_s"] <= 1,
            "red-light": bool(at["red_light"]),
        }[rule]  # fmt: skip
        if wrong:
            return False
    return True


@pytest.mark.parametrize("scenario", mostly_nightly(["merge", "intersection", "loop"], ["intersection"]))
def test_signals_are_those_of_libsumo_and_rules_those_of_a_loop(scenario, tmp_path):
    verdicts = {name: set() for name in TRAFFIC_RULES}
    compared = 0
    for seed in range(1, 4):
        result, signals, seen, chosen = driven(scenario, seed, 200, tmp_path)
        net = Path(chosen.folder, next(Path(chosen.folder).glob("*.net.xml"))).read_text()
        limits = {lane: float(limit) for lane, limit in re.findall(r'<lane id="([^"]+)".*?speed="([^"]+)"', net)}
        for at, (speed, gap_m, leader, leader_speed, lane) in enumerate(seen):
            assert signals["speed"][at] == pytest.approx(speed, abs=1e-6)
            assert signals["speed_limit"][at] == pytest.approx(limits[lane], abs=1e-6)
            if leader and signals["gap_m"][at] < math.inf:
                compared += 1
                assert signals["gap_m"][at] == pytest.approx(gap_m, abs=1e-3)
                assert signals["leader_speed"][at] == pytest.approx(leader_speed, abs=1e-6)
                if at and seen[at - 1][2] == leader and signals["gap_m"][at - 1] < math.inf:
                    change = (leader_speed - seen[at - 1][3]) / chosen.step_length_s
                    assert signals["leader_acceleration"][at] == pytest.approx(change, abs=1e-6)
                    assert not signals["leader_changed"][at]
        for name, rule in TRAFFIC_RULES.items():
            holds = parse(rule.formula).satisfied(signals, chosen.step_length_s)
            assert holds == by_loops(name, signals, chosen.step_length_s), (seed, name)
            robustness = result.robustness[name]
            assert robustness is None or (robustness > 0) == holds or robustness == 0
            verdicts[name].add(holds)
    assert compared > 50
    assert verdicts["unnecessary-braking"] | verdicts["maximum-speed"] == {True, False}


class Rushes(Hectic):
    """Drives at 15 m/s whatever comes."""

    def act(self, observation):
        return 15.0, 0


def test_a_collision_with_an_actor_that_has_priority_violates_right_of_way(tmp_path):
    minor = tmp_path / "minor"
    shutil.copytree(ROOT / "scenarios" / "intersection", minor)
    table = (minor / "scenario.toml").read_text()
    (minor / "scenario.toml").write_text(table.replace('route = "west-east"', 'route = "north-south"'))
    hit = 0
    for seed in range(3, 40):  # with the seeds 1 and 2, the agent hits no actor that has priority
        result, signals, _, _ = driven(str(minor), seed, 300, tmp_path, agent=Rushes)
        if result.outcome == Outcome.COLLISION and signals["priority_m"].min() == 0:
            hit += 1
            assert result.robustness["right-of-way"] <= 0
            return
    raise AssertionError(hit)


class Junction:
    """The junction of the scenario ``intersection``, computed from its network file alone."""

    def __init__(self, net):
        self.length = {lane: float(m) for lane, m in re.findall(r'<lane id="([^"]+)".*?length="([^"]+)"', net)}
        shapes = re.findall(r'<lane id="([^"]+)".*?shape="([^"]+)"', net)
        self.shapes = {lane: [tuple(map(float, one.split(","))) for one in shape.split()] for lane, shape in shapes}
        links = re.findall(r'<connection from="([^":]+)" to="([^"]+)" fromLane="(\d+)".*? via="([^"]+)"', net)
        self.inside = {(f"{one}_{lane}", to): via for one, to, lane, via in links}
        self.after = dict(re.findall(r'<connection from="(:[^"]+)" .*? via="([^"]+)"', net))
        self.yields = [bits[::-1] for bits in re.findall(r'<request index="\d+"\s+response="(\d+)"', net)]

    def path(self, vehicle):
        """The link of a vehicle through the junction, its points, and the distance of its front from their start."""
        lane, place = libsumo.vehicle.getLaneID(vehicle), libsumo.vehicle.getLanePosition(vehicle)
        route, at = libsumo.vehicle.getRoute(vehicle), libsumo.vehicle.getRouteIndex(vehicle)
        if lane.startswith(":"):  # the route index is still that of the edge before
            first = next((via for via in self.inside.values() if lane in (via, self.after.get(f"{via}"[:-2]))), None)
            driven = place + (self.length[first] if first != lane else 0.0)
        else:
            first = self.inside.get((lane, route[at + 1])) if at + 1 < len(route) else None
            driven = place - self.length[lane]
        if first is None:
            return None
        second = self.after.get(first[:-2])
        points = self.shapes[first] + (self.shapes[second][1:] if second else [])
        return int(first[:-2].rpartition("_")[2]) + int(first.rpartition("_")[2]), points, driven


@pytest.mark.nightly
@pytest.mark.parametrize("route", ["north-south", "west-east", "south-west"])
def test_priority_is_that_of_the_network_file_and_of_the_geometry_of_the_lanes(route, tmp_path):
    shutil.copytree(ROOT / "scenarios" / "intersection", tmp_path / "own")
    table = tmp_path / "own" / "scenario.toml"
    table.write_text(table.read_text().replace('route = "west-east"', f'route = "{route}"'))
    scenario = load_scenario(tmp_path / "own")
    junction = Junction((tmp_path / "own" / "intersection.net.xml").read_text())
    near, finite, arrivals = 0, 0, 0
    for seed in range(1, 7):
        simulator = SumoSimulator(scenario, tmp_path)
        spec = TrialSpec(0, seed, {}, {**argument_values(scenario), "priority_demand": 600, "minor_demand": 100}, 260)
        with Episode(spec, simulator=simulator, make_agent=lambda *_: CarFollowing(), crash_on=()) as episode:
            result = episode.start()
            read = TrialSignals(episode).reader(["priority_m", "priority_arrival_s"], "ego")
            while result is None:
                result = episode.step()
                own = junction.path("ego") if "ego" in libsumo.vehicle.getIDList() else None
                if own is None:
                    continue
                distance_m, arrival_s = read()
                before = {}
                for other in set(libsumo.vehicle.getIDList()) - {"ego"}:
                    its = junction.path(other)
                    if its is not None and junction.yields[own[0]][its[0]] == "1":
                        meet = crossing(own[1], its[1])
                        before[other] = (meet[0] - own[2], meet[1] - its[2]) if meet else (math.nan, math.nan)
                if distance_m < math.inf:
                    finite += 1
                    assert before  # as the network file says, another vehicle has priority
                    apart = [abs(max(0.0, mine) - distance_m) for mine, _ in before.values()]
                    assert min(apart) < 8.0 or np.isnan(apart).any()  # lanes are wide, lines of points are not
                if any(0 < mine < 30 and 0 < its < 30 for mine, its in before.values()):
                    near += 1
                    assert distance_m < math.inf
                if arrival_s < math.inf:
                    arrivals += 1
                    speeds = {other: max(0.1, libsumo.vehicle.getSpeed(other)) for other in before}
                    apart = [abs(max(0.0, its) - arrival_s * speeds[other]) for other, (_, its) in before.items()]
                    assert min(apart) < 8.0
        simulator.close()
    assert (near > 0, finite > 0, arrivals > 0) == (route != "west-east",) * 3


@pytest.mark.parametrize("lane", [0, 1])
def test_red_light_is_that_of_the_program_in_the_network_file(lane, sumo_runs):
    net = SIGNAL.read_text()
    phases = [(float(s), state) for s, state in re.findall(r'<phase duration="([^"]+)"\s+state="([^"]+)"', net)]
    link = int(re.search(rf'from="west" to="east" fromLane="{lane}" .*?linkIndex="(\d+)"', net)[1])
    length_m = float(re.search(rf'<lane id="west_{lane}".*?length="([^"]+)"', net)[1])
    ego = f'<vehicle id="ego" depart="0" departPos="0" departLane="{lane}"><route edges="west east"/></vehicle>'
    agents = {"ego": AgentSetup(existing=True)}
    simulator = sumo_runs.written(SIGNAL, f"<routes>{ego}</routes>", step_length_s=0.5, warmup_s=0.0, agents=agents)
    compared = {True: 0, False: 0}
    with Episode(
        TrialSpec(0, 1, {}, {}, 200), simulator=simulator, make_agent=lambda *_: Crawls(), crash_on=()
    ) as episode:
        result = episode.start()
        read = TrialSignals(episode).reader(["red_light_m", "speed"], "ego")
        while result is None:
            if (row := read()) is None or not libsumo.vehicle.getLaneID("ego").startswith("west"):
                break
            passed_s = (libsumo.simulation.getTime() - 0.5) % sum(seconds for seconds, _ in phases)
            state = next(
                one for number, (_, one) in enumerate(phases) if passed_s < sum(s for s, _ in phases[: number + 1])
            )
            left_m = length_m - libsumo.vehicle.getLanePosition("ego")
            expected = left_m - 1.0 if state[link] in "ru" and left_m <= max(60.0, 6.0 * row[1]) else math.inf
            assert row[0] == pytest.approx(expected, abs=1e-6)
            compared[expected < math.inf] += 1
            result = episode.step()
    assert min(compared.values()) > 10


class Crawls(Hectic):
    """Drives at 1.2 m/s."""

    def act(self, observation):
        return 1.2, 0


def test_every_listed_signal_of_a_scene_is_what_libsumo_answers(sumo_runs):
    scenario = load_scenario("merge")
    simulator, step_s, get = sumo_runs.open(scenario), scenario.step_length_s, libsumo.vehicle
    spec, rows, expected = TrialSpec(0, 4, {}, argument_values(scenario), 120), [], []
    with Episode(spec, simulator=simulator, make_agent=lambda *_: Hectic(), crash_on=()) as episode:
        result = episode.start()
        signals = TrialSignals(episode)
        names = [name for name in signals.known("ego") if name in LISTED]
        assert set(names) == set(LISTED)
        read, begun = signals.reader(names, "ego"), libsumo.simulation.getTime()
        while result is None and "ego" in get.getIDList():
            rows.append(read())
            x, y = get.getPosition("ego")
            leader, gap_m = get.getLeader("ego", max(60.0, 6 * get.getSpeed("ego"))) or ("", math.inf)
            gap_m += get.getMinGap("ego") if leader else 0.0
            away = {one: math.dist((x, y), get.getPosition(one)) for one in get.getIDList() if one != "ego"}
            others = [one for one, m in away.items() if m < min(away.values()) + 40.0]  # longer than two vehicles
            expected.append({
                "time_s": libsumo.simulation.getTime() - begun, "x": x, "y": y, "speed": get.getSpeed("ego"),
                "heading": math.radians(90 - get.getAngle("ego")), "gap_m": gap_m,
                "leader_speed": get.getSpeed(leader) if leader else math.inf, "leader": leader,
                "speed_limit": libsumo.lane.getMaxSpeed(get.getLaneID("ego")), "lane": get.getLaneIndex("ego"),
                "lane_offset_m": get.getLateralLanePosition("ego"), "red_light_m": math.inf,
                "priority_m": math.inf, "priority_arrival_s": math.inf,
                "clearance_m": min((apart("ego", one) for one in others), default=math.inf),
            })  # fmt: skip
            result = episode.step()
    found = {name: np.array(values, float) for name, values in zip(names, zip(*rows, strict=True), strict=True)}
    known = {name: np.array([one[name] for one in expected]) for name in expected[0]}
    speeds, gaps = known["speed"], known["gap_m"]
    with np.errstate(all="ignore"):
        closing = speeds - known["leader_speed"]
        known["headway_s"] = np.where(speeds > 0, gaps / speeds, math.inf)
        known["ttc_s"] = np.where(closing > 0, np.maximum(0, gaps) / closing, math.inf)
    known["acceleration"] = np.append(0.0, np.diff(speeds) / step_s)
    known["jerk"] = np.append([0.0, 0.0], np.diff(known["acceleration"][1:]) / step_s)
    turned = np.diff(known["heading"])
    known["yaw_rate"] = np.append(0.0, np.arctan2(np.sin(turned), np.cos(turned)) / step_s)
    leaders = known.pop("leader")
    changed = np.append(False, (leaders[1:] != leaders[:-1]) & (leaders[1:] != ""))
    known["leader_changed"] = changed
    with np.errstate(all="ignore"):
        change = np.append(0.0, np.diff(known["leader_speed"]) / step_s)
    known["leader_acceleration"] = np.where(changed | (leaders == "") | (np.arange(len(leaders)) == 0), 0.0, change)
    known["clearance_m"] = np.where(found["clearance_m"] < math.inf, known["clearance_m"], math.inf)
    assert len(rows) > 80, result
    assert np.isfinite(found["gap_m"]).sum() > 20
    assert set(known) == set(found)
    for name, values in known.items():
        assert found[name] == pytest.approx(np.array(values, float), abs=1e-4), name


LISTED = [name for name in KNOWN_SIGNALS if not name.startswith("info")]


def corners(vehicle):
    """The corners of the rectangle of a vehicle, as complex numbers."""
    (x, y), half = libsumo.vehicle.getPosition(vehicle), libsumo.vehicle.getWidth(vehicle) / 2
    ahead, back = np.exp(1j * math.radians(90 - libsumo.vehicle.getAngle(vehicle))), libsumo.vehicle.getLength(vehicle)
    return [complex(x, y) + ahead * one for one in (half * 1j, -half * 1j, -back - half * 1j, -back + half * 1j)]


def apart(one, other):
    """The distance of two rectangles that do not overlap: of a corner of one from an edge of the other."""
    found = []
    for points, edges in ((corners(one), corners(other)), (corners(other), corners(one))):
        for begin, end in pairwise([*edges, edges[0]]):
            for point in points:
                along = ((point - begin) * (end - begin).conjugate()).real / abs(end - begin) ** 2
                found.append(abs(point - begin - min(1.0, max(0.0, along)) * (end - begin)))
    return min(found)
