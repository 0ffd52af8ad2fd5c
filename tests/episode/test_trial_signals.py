"""Requirements in running episodes: the signals that they name, and the step at which a violation ends the trial."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest
from onlookers import Always

from crashhunt.base.errors import UnusableValueError
from crashhunt.episode import Episode, TrialSignals
from crashhunt.episode._trial_signals import _SURROUNDINGS as SURROUNDINGS
from crashhunt.gym import GymSimulator
from crashhunt.gym._descriptor import GymSetup
from crashhunt.oracles import parse_oracle, requirement_oracles
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.simulators.toy import ToySimulator
from crashhunt.trial import CRASHES, Outcome, TrialSpec
from crashhunt.world import Crossing, Neighbor, Surroundings, outlines

STEP_S = 0.5
HUNTED = (*CRASHES, Outcome("requirement"))


class Ramp(gymnasium.Env):
    """A value that grows by one in each step; it is in the observation, the reward and info."""

    observation_space = gymnasium.spaces.Box(-1e3, 1e3, (2,), np.float64)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return np.array([0.0, 100.0]), {"level": 0, "note": "none"}

    def step(self, action):
        self.steps += 1
        info = {"level": np.float32(self.steps), "late": self.steps >= 4, "note": "text", "2nd": 1}
        if self.steps == 6:
            info |= {"level": math.nan, "late": None}
        return np.array([self.steps, 100.0 - self.steps]), -float(self.steps), self.steps >= 8, False, info


gymnasium.register("Ramp-v0", entry_point=Ramp, disable_env_checker=True)


class Scripted:
    """Drives at the speeds that a list has."""

    def __init__(self, speeds):
        self.speeds = list(speeds)

    def reset(self, seed):
        pass

    def act(self, observation):
        return (self.speeds.pop(0), 0) if self.speeds else (0.0, 0)


def episode_of(simulator, *requirements, agent=lambda: Always(0), steps=20, oracles=(), arguments=None):
    oracles = [*oracles] + [parse_oracle(text).make() for text in requirement_oracles(requirements)]
    spec = TrialSpec(number=0, seed=3, arguments={}, scenario_arguments=arguments or {}, max_steps=steps)
    return Episode(spec, simulator=simulator, make_agent=lambda *_: agent(), oracles=oracles, crash_on=HUNTED)


def finish(episode):
    result = episode.start()
    while result is None:
        result = episode.step()
    return result


def ramp(*requirements, tmp_path, **options):
    scenario = Scenario(
        simulator="gym", tables={"gym": GymSetup(id="Ramp-v0")}, agents={"ego": AgentSetup()}, step_length_s=STEP_S
    )
    return finish(episode_of(GymSimulator(scenario, tmp_path), *requirements, **options))


def toy(tmp_path, agents=("ego",), **setup):
    return ToySimulator(
        Scenario(simulator="toy", agents=dict.fromkeys(agents, AgentSetup(**setup)), step_length_s=STEP_S), tmp_path
    )


@pytest.mark.parametrize(
    ("requirement", "step", "robustness"),
    [
        ("always (level < 3)", 3, 0.0),
        ("always (info.level <= 3)", 4, -1.0),
        ("always (observation[1] > 98)", 2, 0.0),
        ("always (reward > -3)", 3, 0.0),
        ("always[0:1] (level < 2)", 2, 0.0),
        ("always (late -> level > 5)", 4, -1.0),
        ("always[0:1] eventually[0:1] (level > 4)", 2, -2.0),
    ],
)
def test_a_violation_ends_the_trial_at_the_step_at_which_it_is_certain(requirement, step, robustness, tmp_path):
    result = ramp(requirement, tmp_path=tmp_path)
    assert (result.outcome, result.steps) == ("requirement", step)
    assert result.robustness == {"requirement": robustness}
    assert (result.event.kind, result.event.name, result.danger) == ("requirement", "requirement", 1.0)
    assert result.summary == f"ego violates requirement: {requirement}, at step {step}"


def test_a_violation_before_the_first_step_ends_the_trial_after_it(tmp_path):
    result = ramp("always (level > 0)", tmp_path=tmp_path)
    assert (result.outcome, result.steps) == ("requirement", 1)
    assert result.event.details == ("robustness 0", "(level > 0) is false at step 0 (0.0 s): level = 0")


def test_what_only_the_end_decides_is_a_violation_at_the_end(tmp_path):
    result = ramp("eventually (level > 50)", tmp_path=tmp_path, steps=5)
    assert (result.outcome, result.steps, result.robustness) == ("requirement", 5, {"requirement": -45.0})
    assert result.event.details[1] == "(level > 50) is false from step 0 to 5 (0.0 s to 2.5 s), at step 5: level = 5"


def test_a_satisfied_requirement_leaves_the_trial_as_it_is_and_takes_the_place_of_criticality(tmp_path):
    result = ramp("far=always (level < 7)", "near=always (level < 5.5)", "sure=true", tmp_path=tmp_path, steps=5)
    assert (result.outcome, result.event) == ("survived", None)
    assert result.robustness == {"far": 2.0, "near": 0.5, "sure": None}
    assert result.danger == 1 / 1.5  # the nearest of them


def test_signals_without_a_value_before_the_first_step_begin_with_it(tmp_path):
    # The first sample is the first step, at which reward is -1.
    assert ramp("reward > -1.5 and level > 0", tmp_path=tmp_path, steps=3).robustness == {"requirement": 0.5}
    result = ramp("always (reward > -2)", tmp_path=tmp_path)
    assert result.event.details == ("robustness 0", "(reward > -2) is false at step 2 (1.0 s): reward = -2")


@pytest.mark.parametrize(
    ("requirement", "message"),
    [
        ("always (levl < 99)", "the signal 'levl' of ego is unknown; did you mean 'level'?"),
        ("always (level < 99)", "the signal 'level' is NaN; give a number in every step"),
        ("always (late -> reward < 5)", "info['late'] is of type NoneType"),
        ("always (note > 1)", "info['note'] is of type str"),
        ("always (observation[2] < 99)", "the signal 'observation[2]' is not in the observation of 2 numbers"),
        ("always (1 / (level - 2) < 99)", "it divides by zero at sample 2: 1 / (level - 2)"),
        ("always (speed < 99)", "the signal 'speed' of ego is unknown"),
        ("always[0:0.7] (level < 9)", "a window has the bound 0.7 s, not a multiple of the step length of 0.5 s"),
    ],
)
def test_a_requirement_that_cannot_be_evaluated_names_the_reason(requirement, message, tmp_path):
    result = ramp(f"calm={requirement}", tmp_path=tmp_path)
    assert result.failure.kind == "unusable value"
    assert result.failure.message.startswith(f"the requirement calm cannot be evaluated: {message}")
    assert "\n" not in result.failure.message


SCENE_SIGNALS = ("time_s", "x", "speed", "acceleration", "jerk", "yaw_rate", "clearance_m", "lane", "lane_offset_m")


class Reads:
    """An oracle that only reads, and keeps the scenes for comparison."""

    name = "reads"

    def __init__(self):
        self.rows, self.scenes = [], []

    def read_signals(self, source, agents):
        self.read = source.reader(SCENE_SIGNALS, agents[0])

    def check(self, scene, agents):
        self.rows.append(self.read())
        ego, leader = (outlines(scene, number)[0] for number in (0, 1))
        gap_m = leader[0] - leader[3] - ego[0]  # both drive along the x axis
        self.scenes.append((scene.points[0][0], scene.speeds[0], gap_m if gap_m <= 50 else math.inf))
        return []


def test_signals_of_scenes_are_those_of_the_positions(tmp_path):
    reads = Reads()
    speeds = [12.0, 14.0, 9.0, 20.0, 20.0, 0.0]
    finish(
        episode_of(toy(tmp_path), agent=lambda: Scripted(speeds), steps=6, oracles=[reads], arguments={"gap_m": 48.0})
    )
    columns = dict(zip(SCENE_SIGNALS, np.array(reads.rows).T, strict=True))
    x, speed, gap_m = np.array(reads.scenes).T
    assert len(set(speed)) > 3
    acceleration = np.diff(speed) / STEP_S
    wanted = {
        "time_s": np.arange(7) * STEP_S, "x": x, "speed": speed, "acceleration": [0.0, *acceleration],
        "jerk": [0.0, 0.0, *np.diff(acceleration) / STEP_S], "clearance_m": gap_m,
    }  # fmt: skip
    for name, values in columns.items():
        assert values == pytest.approx(np.array(wanted.get(name, np.zeros(7)))), name


def test_every_agent_has_to_satisfy_a_requirement_that_names_none(tmp_path):
    agents = iter([Scripted([10.0] * 20), Scripted([20.0] * 20)])
    episode = episode_of(
        toy(tmp_path, ("a", "b")), "always (speed < 12)", agent=lambda: next(agents), arguments={"gap_m": 60.0}
    )
    result = finish(episode)
    assert (result.outcome, result.event.agent, result.steps) == ("requirement", "b", 2)


def test_a_requirement_may_name_agents(tmp_path):
    agents = iter([Scripted([10.0] * 20), Scripted([20.0] * 20)])
    episode = episode_of(
        toy(tmp_path, ("a", "b")),
        "always (b.speed - a.speed < 4)",
        agent=lambda: next(agents),
        arguments={"gap_m": 60.0},
    )
    result = finish(episode)
    assert (result.outcome, result.steps) == ("requirement", 3)


def test_an_agent_that_has_left_has_no_further_samples(tmp_path):
    episode = episode_of(
        toy(tmp_path), "always[0:5] eventually[0:4] (x > 300)", agent=lambda: Scripted([10.0] * 60), steps=60,
        arguments={"road_m": 30.0},
    )  # fmt: skip
    assert finish(episode).outcome == "requirement"


@pytest.mark.parametrize("other", ["b.x < 99", "b.reward > -99", "b.observation[0] > -99"])
def test_another_agent_that_has_left_ends_the_samples_of_its_signals(other, tmp_path):
    agents = iter([Scripted([4.0] * 20), Scripted([10.0] * 20)])
    episode = episode_of(
        toy(tmp_path, ("a", "b")), f"always ({other} and speed >= 0)", agent=lambda: next(agents), steps=15,
        arguments={"gap_m": 60.0, "road_m": 40.0},
    )  # fmt: skip
    result = finish(episode)
    assert (result.outcome, result.failure) == ("survived", None)
    assert "b" not in episode.scene.roster.index
    assert "a" in episode.scene.roster.index


def test_signals_are_listed_with_their_units(tmp_path):
    episode = episode_of(toy(tmp_path), agent=lambda: Scripted([10.0]))
    episode.start()
    episode.step()
    signals = TrialSignals(episode)
    known = signals.known("ego")
    assert (known["speed"], known["jerk"], known["lane"]) == ("m/s", "m/s³", "")
    assert "gap_m" not in known  # the toy does not report the vehicles ahead
    assert {"reward", "observation[0]"} <= known.keys()
    assert signals.meaning("observation[8]") == "x in row 1 of the observation"
    assert all(signals.meaning(name) for name in known)


def test_elements_of_an_observation_in_parts_are_named_by_part(tmp_path):
    episode = episode_of(toy(tmp_path, observation=("ego", "actors:rows=2")), agent=lambda: Scripted([10.0]))
    episode.start()
    layout, signals = episode.simulator.observation_layouts["ego"], TrialSignals(episode)
    actors, speed = layout.columns["actors"], layout.columns["ego"]["speed"]
    assert signals.meaning(f"observation[{len(actors) + actors['ahead']}]") == "ahead in row 1 of the part actors"
    assert signals.meaning(f"observation[{2 * len(actors) + speed}]") == "speed of the part ego"
    assert signals.meaning(f"observation[{2 * len(actors)}]") == f"{next(iter(layout.columns['ego']))} of the part ego"


class Surrounded(ToySimulator):
    """The toy, whose surroundings are those of a list, by step."""

    given: tuple[Surroundings, ...] = ()

    def surroundings(self, agent):
        return self.given[self._step]

    def speed_limit(self, agent):
        return 13.5


def surrounded(*, ahead=(), crossing=()):
    neighbors = [
        Neighbor(actor=actor, gap_m=gap_m, speed_mps=speed, braking_mps2=5.0, kind=kind)
        for actor, gap_m, speed, kind in ahead
    ]
    names = ("distance_m", "exit_m", "actor_distance_m", "actor_exit_m", "speed_mps", "has_right_of_way")
    crossings = [
        Crossing(actor="crosses", braking_mps2=5.0, **dict(zip(names, each, strict=True))) for each in crossing
    ]
    return Surroundings(
        speed_mps=10.0, acceleration_mps2=3.0, braking_mps2=8.0, ahead=tuple(neighbors), crossing=tuple(crossings)
    )


def signals_at(tmp_path, *given, speed=10.0):
    """The signals of the surroundings in each step, of an agent that drives at 10 m/s."""
    simulator = Surrounded(Scenario(simulator="toy", agents={"ego": AgentSetup()}, step_length_s=STEP_S), tmp_path)
    simulator.given = given
    names = (*SURROUNDINGS, "speed_limit")
    with episode_of(simulator, agent=lambda: Scripted([speed] * 20), arguments={"gap_m": 500.0}) as episode:
        episode.start()
        read = TrialSignals(episode).reader(names, "ego")
        rows = [read()]
        for _ in given[1:]:
            episode.step()
            rows.append(read())
    return {name: list(values) for name, values in zip(names, zip(*rows, strict=True), strict=True)}


def test_signals_of_vehicles_ahead_are_those_of_the_nearest(tmp_path):
    far, red = ("far", 90.0, 5.0, "vehicle"), ("", 40.0, 0.0, "red light")
    found = signals_at(
        tmp_path,
        surrounded(ahead=[far, ("near", 20.0, 8.0, "vehicle"), red, ("", 30.0, 0.0, "red light")]),
        surrounded(ahead=[far, ("near", 19.0, 6.0, "vehicle"), ("", 5.0, 0.0, "crossing")]),
        surrounded(ahead=[far, red]),
        surrounded(),
        surrounded(ahead=[("next", -1.0, 4.0, "vehicle")]),
    )
    assert found["gap_m"] == [20.0, 19.0, 90.0, math.inf, -1.0]
    assert found["leader_speed"] == [8.0, 6.0, 5.0, math.inf, 4.0]
    assert found["headway_s"] == [2.0, 1.9, 9.0, math.inf, -0.1]
    assert found["ttc_s"] == [10.0, 4.75, 18.0, math.inf, 0.0]
    assert found["leader_acceleration"] == [0.0, -4.0, 0.0, 0.0, 0.0]
    assert found["leader_changed"] == [False, False, True, False, True]
    assert found["red_light_m"] == [30.0, math.inf, 40.0, math.inf, math.inf]
    assert found["priority_m"] == found["priority_arrival_s"] == [math.inf] * 5
    assert found["speed_limit"] == [13.5] * 5


def test_standing_agent_has_no_headway_and_closes_in_on_nothing(tmp_path):
    found = signals_at(tmp_path, *[surrounded(ahead=[("near", 20.0, 8.0, "vehicle")])] * 9, speed=0.0)
    assert (found["headway_s"][-1], found["ttc_s"][-1], found["gap_m"][-1]) == (math.inf, math.inf, 20.0)


def test_signals_of_priority_describe_actors_with_the_right_of_way(tmp_path):
    inside = (-1.0, 4.0, 12.0, 20.0, 6.0, True)
    found = signals_at(
        tmp_path,
        surrounded(crossing=[(30.0, 38.0, 9.0, 15.0, 9.0, True), (20.0, 28.0, 9.0, 15.0, 9.0, True)]),
        surrounded(crossing=[(20.0, 28.0, 9.0, 15.0, 9.0, False)]),
        surrounded(crossing=[inside, (-1.0, 4.0, 12.0, 20.0, 3.0, True), (9.0, 14.0, 1.0, 9.0, 9.0, True)]),
        surrounded(crossing=[(-1.0, 4.0, -2.0, 3.0, 6.0, True)]),
        surrounded(crossing=[(-1.0, 4.0, 12.0, 20.0, 0.0, True)]),
        surrounded(crossing=[(-9.0, -4.0, 12.0, 20.0, 6.0, True), (-1.0, 4.0, -9.0, -1.0, 6.0, True)]),
    )
    assert found["priority_m"] == [20.0, math.inf, 0.0, 0.0, 0.0, 0.0]
    assert found["priority_arrival_s"] == [math.inf, math.inf, 2.0, 0.0, math.inf, math.inf]


def test_signal_that_is_nan_before_the_first_step_is_unusable(tmp_path):
    with pytest.raises(UnusableValueError, match="the signal 'gap_m' is NaN"):
        signals_at(tmp_path, surrounded(ahead=[("near", math.nan, 8.0, "vehicle")]))
