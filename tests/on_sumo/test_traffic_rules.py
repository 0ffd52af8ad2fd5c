"""The rules of `list requirements` on recorded traffic: against loops over what libsumo itself reports."""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path

import libsumo
import numpy as np
import pytest
from conftest import mostly_nightly

from crashhunt.episode import Episode, TrialSignals
from crashhunt.oracles import Overlap, RequirementOracle
from crashhunt.requirements import TRAFFIC_RULES, parse
from crashhunt.scenario import argument_values, load_scenario
from crashhunt.sumo import SumoSimulator
from crashhunt.trial import Outcome, TrialSpec

ROOT = Path(__file__).parents[2]
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


@pytest.mark.parametrize("scenario", mostly_nightly(["merge", "intersection", "motorway"], ["intersection"]))
def test_signals_are_those_of_libsumo_and_rules_those_of_a_loop(scenario, tmp_path):
    verdicts = {name: set() for name in TRAFFIC_RULES}
    compared = 0
    for seed in range(1, 7):
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
    for seed in range(1, 40):
        result, signals, _, _ = driven(str(minor), seed, 300, tmp_path, agent=Rushes)
        if result.outcome == Outcome.COLLISION and signals["priority_m"].min() == 0:
            hit += 1
            assert result.robustness["right-of-way"] <= 0
            return
    raise AssertionError(hit)
