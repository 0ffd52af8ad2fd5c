"""One episode after a script: what is asked, recorded, found and said, in the order in which it happens."""

from __future__ import annotations

import random
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from gymnasium import spaces

from crashhunt.base.errors import InvalidEpisodeError, SimulatorError
from crashhunt.episode import run_episode
from crashhunt.oracles import OffRoad, Overlap, ReportedCollision
from crashhunt.recording import BlackBox, Phase, Recording, Tag, digest_of, read_black_box, read_header
from crashhunt.simulators import SpeedAndLaneChange
from crashhunt.trial import CRASHES, Outcome, TrialSpec
from crashhunt.world import Actor, Contact, Event, Roster, Scene

EGO, SECOND, OTHER = (Actor(name, "passenger", 5.0, 2.0) for name in ("ego", "second", "other"))
ORACLES = (ReportedCollision(), Overlap(), OffRoad())
ROSTER = Roster((EGO, SECOND, OTHER))


class Scripted:
    """A simulator whose scenes are 10 m apart, but for what a script says of a step.

    Args:
        script: step to what happens there: ``scene`` (keywords of a scene), ``events``, ``ends`` (agents that
            terminate), ``truncated``, ``raises``.
        agents: who is controlled.
    """

    step_length_s = 0.5
    observation_names = ("a", "b")

    def __init__(self, script=None, agents=("ego", "second")):
        self.script, self.everybody = script or {}, list(agents)
        self.observation_spaces = dict.fromkeys(agents, spaces.Box(-1e6, 1e6, (2,), np.float32))
        self.actions = dict.fromkeys(agents, SpeedAndLaneChange())
        self.agents, self.asked, self.number = [], [], 0

    def reset(self, *, seed, options=None):
        self.asked.append(("reset", seed, options, random.random(), np.random.random()))  # noqa: NPY002
        self.number, self.agents = 0, list(self.everybody)
        self._raise()
        self._look()
        return {agent: self._observe(agent) for agent in self.agents}, {}

    def step(self, actions):
        self.number += 1
        self.asked.append({agent: action.tolist() for agent, action in actions.items()})
        self._raise()
        told = self.script.get(self.number, {})
        ends, truncated = told.get("ends", ()), told.get("truncated", ())
        self.agents = [agent for agent in self.agents if agent not in ends]
        self._look()
        observations = {agent: self._observe(agent) for agent in actions}
        rewards = {agent: float(self.number + place) for place, agent in enumerate(actions)}
        return (
            observations, rewards, {agent: agent in ends for agent in actions},
            {agent: agent in truncated for agent in actions}, {},
        )  # fmt: skip

    def scene(self):
        return self._scene

    def close(self):
        pass

    def _raise(self):
        error = self.script.get(self.number, {}).get("raises")
        if error is not None:
            raise error

    def _observe(self, agent):
        return np.array([self.number, self.everybody.index(agent)], np.float32)

    def _look(self):
        told = self.script.get(self.number, {})
        more = {"roster": ROSTER, "xs": (0.0, 10.0, 20.0), **told.get("scene", {})}
        roster, xs = more.pop("roster"), more.pop("xs")
        count = len(roster)
        points = [(x + self.number, 0.0) for x in xs[:count]]
        self._scene = Scene(self.number * 0.5, roster, points, [0.0] * count, [2.0] * count, **more)
        self._scene.events = told.get("events", ())


class Driver:
    def __init__(self, script=None, log=None):
        self.script, self.log, self.number = script or {}, log if log is not None else [], 0

    def reset(self, seed):
        self.log.append(("seed", seed))
        if "reset" in self.script:
            raise self.script["reset"]

    def act(self, observation):
        self.number += 1
        self.log.append(observation)
        answer = self.script.get(self.number, (5.0 + self.number % 90, 0))
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def close(self):
        self.log.append("closed")
        if "close" in self.script:
            raise self.script["close"]


@pytest.fixture
def run(tmp_path):
    box = BlackBox(tmp_path / "box")

    def go(
        simulator=None,
        drivers=None,
        *,
        max_steps=3,
        oracles=ORACLES,
        crash_on=CRASHES,
    ):
        simulator = simulator or Scripted()
        drivers = drivers or {}
        box.begin(pid=1, trial=4, started=0.0)
        go.made = []

        def make(agent, given, arguments):
            assert given is simulator
            go.made.append((agent, dict(arguments)))
            driver = drivers.get(agent) or Driver()
            if isinstance(driver, BaseException):
                raise driver
            return driver

        spec = TrialSpec(4, 77, {"ego": {"speed": 1.5}}, {"gap": 3}, max_steps=max_steps)
        state = random.getstate(), np.random.get_state()  # noqa: NPY002
        try:
            result = run_episode(
                spec, simulator=simulator, make_agent=make, box=box, oracles=oracles, crash_on=crash_on
            )
        finally:
            random.setstate(state[0])
            np.random.set_state(state[1])  # noqa: NPY002
        assert result.spec == spec
        assert 0 <= result.setup_s <= result.wall_s < 60
        go.records = list(read_black_box(tmp_path / "box"))
        return result

    go.box = box
    go.recording = lambda: Recording(go.records)
    go.header = lambda: read_header(tmp_path / "box")
    yield go
    box.close()


def test_an_episode_that_goes_well_is_recorded_in_order(run):
    simulator, log = Scripted({2: {"scene": {"lanes": ("a", "b", "c")}}}), []
    result = run(simulator, {"ego": Driver(log=log)})
    assert (result.outcome, result.steps, result.sim_time_s) == (Outcome.SURVIVED, 3, 1.5)
    assert (result.collision, result.failure, result.event, result.events) == (None, None, None, None)
    assert run.made == [("ego", {"speed": 1.5}), ("second", {})]
    assert simulator.asked[0][:3] == ("reset", 77, {"arguments": {"gap": 3}})
    assert simulator.asked[1:] == [{"ego": [5.0 + step, 0], "second": [5.0 + step, 0]} for step in (1, 2, 3)]
    (_, seed), *seen, closed = log
    assert 0 <= seed < 2**31
    assert seed != 77
    assert [observation.tolist() for observation in seen] == [[0, 0], [1, 0], [2, 0]]
    assert closed == "closed"
    step = [Tag.OBSERVATION, Tag.ACTION, Tag.OBSERVATION, Tag.ACTION]
    assert [(record.tag, record.aux) for record in run.records] == [
        (Tag.PROLOGUE, 0), (Tag.ACTORS, 0), (Tag.ROSTER, 0), (Tag.STEP, 0),
        *zip(step, (0, 0, 1, 1), strict=True), (Tag.STEP, 0),
        *zip(step, (0, 0, 1, 1), strict=True), (Tag.LANES, 0), (Tag.STEP, 0),
        *zip(step, (0, 0, 1, 1), strict=True), (Tag.STEP, 0),
    ]  # fmt: skip
    recording = run.recording()
    assert result.digest == recording.digest == digest_of(run.box.evidence())
    assert [step.rewards for step in recording.all_steps[:2]] == [
        {"ego": 0.0, "second": 0.0}, {"ego": 1.0, "second": 2.0},
    ]  # fmt: skip
    assert recording.actions("second").tolist() == [[6, 0], [7, 0], [8, 0]]
    ego = recording.prologue.agents[0]
    assert (ego.observation_dtype, ego.observation_shape, ego.action_dtype, ego.action_shape) == (
        "<f4",
        (2,),
        "<f8",
        (2,),
    )
    assert (ego.action_names, ego.observation_names) == (("target_speed", "lane_change"), ("a", "b"))
    assert recording.prologue.step_length_s == 0.5
    assert (run.header().phase, run.header().step) == (Phase.DONE, 3)
    assert (result.closest.gap_m, result.closest.time_to_collision_s) == (5, np.inf)


def test_the_same_is_drawn_in_every_run(run, monkeypatch):
    first, again, other = Scripted(), Scripted(), Scripted()
    seeds = {name: [] for name in ("ego", "second")}
    run(first, {name: Driver(log=log) for name, log in seeds.items()})
    random.seed(5)
    run(again)
    assert first.asked == again.asked
    # What a policy draws follows from them, and so do the digests of crashes.
    assert [log[0] for log in seeds.values()] == [("seed", 774435325), ("seed", 327075251)]
    seeded = []
    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(manual_seed=seeded.append))
    run(other)
    assert seeded == [77]
    random.seed(77)
    np.random.seed(77)  # noqa: NPY002
    assert other.asked[0][3:] == (random.random(), np.random.random())  # noqa: NPY002


def test_actors_are_reported_of_once_and_rosters_when_they_change(run):
    late = Actor("late", "truck", 12.0, 2.5)
    script = {
        1: {"scene": {"roster": Roster((EGO, SECOND, late)), "xs": (0.0, 10.0, 40.0)}},
        2: {"scene": {"roster": Roster((late, EGO, SECOND)), "xs": (40.0, 0.0, 10.0)}},
    }
    run(Scripted(script))
    tags = [record.tag for record in run.records if record.tag in (Tag.ACTORS, Tag.ROSTER)]
    assert tags == [Tag.ACTORS, Tag.ROSTER, Tag.ACTORS, Tag.ROSTER, Tag.ROSTER, Tag.ROSTER]
    rosters = [[actor.id for actor in scene.roster.actors] for scene in run.recording().scenes()]
    assert rosters == [
        ["ego", "second", "other"],
        ["ego", "second", "late"],
        ["late", "ego", "second"],
        ["ego", "second", "other"],
    ]


def test_everything_of_a_scene_is_recorded(run):
    contact, event = Contact("x", "y", "collision", "", 1.0, 2.0), Event("teleport", "ego", "ego was moved")
    spine = ((20.0, 0.0, 1.0), (15.0, 0.0, 1.0))
    script = {
        1: {
            "scene": {
                "contacts": (contact,),
                "heights": (0.0, 9.0, 1.0),
                "grades": (0.0, 0.1, 0.0),
                "spines": {2: spine},
            }
        },
        2: {"scene": {"off_road": ("other",)}, "events": (event,)},
    }
    simulator = Scripted(script)
    simulator.reported_events = ("teleport", "red_light")
    result = run(simulator)
    _, first, second, third = run.recording().scenes()
    assert (first.contacts, first.heights, first.grades, first.spines) == (
        (contact,),
        [0, 9, 1],
        [0, 0.1, 0],
        {2: spine},
    )
    assert (second.off_road, second.events, second.contacts) == (("other",), (event,), ())
    assert (third.heights, third.events) == ([], ())
    assert (result.outcome, result.events) == (Outcome.SURVIVED, {"teleport": 1})
    assert run(Scripted()).events is None
    silent = Scripted()
    silent.reported_events = ("teleport",)
    assert run(silent).events == {}


def test_a_crash_ends_it_and_states_who(run):
    contact = Contact("ego", "other", "collision", "a_0", 3.0, 1.0)
    result = run(Scripted({2: {"scene": {"contacts": (contact,)}}}))
    assert (result.outcome, result.steps, result.sim_time_s) == (Outcome.COLLISION, 2, 1.0)
    assert (result.collision.collider, result.collision.seen_by) == ("ego", ("reported",))
    assert result.closest.gap_m == 5
    assert run.recording().steps == 2
    overlap = run(Scripted({2: {"scene": {"xs": (0.0, 4.0, 20.0)}}}))
    assert (overlap.outcome, overlap.collision.seen_by) == (Outcome.COLLISION, ("overlap",))
    assert (overlap.closest.gap_m, overlap.closest.time_to_collision_s) == (0, 0)
    both = run(
        Scripted({2: {"scene": {"xs": (0.0, 4.0, 20.0), "contacts": (Contact("ego", "second", "k", "", 3.0, 1.0),)}}})
    )
    assert both.collision.seen_by == ("overlap", "reported")
    off = run(Scripted({1: {"scene": {"off_road": ("second",)}}}))
    assert (off.outcome, off.steps, off.collision.agent) == (Outcome.OFF_ROAD, 1, "second")


def test_what_no_one_asked_for_does_not_end_it(run):
    contact, event = Contact("ego", "other", "collision", "a_0", 3.0, 1.0), Event("red_light", "second", "it ran")
    script = {1: {"scene": {"contacts": (contact,)}, "events": (event,)}, 2: {"scene": {"off_road": ("ego",)}}}
    assert run(Scripted(script), crash_on=(Outcome.HANG,)).outcome is Outcome.SURVIVED
    off = run(Scripted(script), crash_on=(Outcome.OFF_ROAD,))
    assert (off.outcome, off.steps) == (Outcome.OFF_ROAD, 2)
    red = run(Scripted(script), crash_on=(Outcome.OFF_ROAD, Outcome.RED_LIGHT))
    assert (red.outcome, red.steps, red.event, red.collision) == (Outcome.RED_LIGHT, 1, event, None)
    first = run(Scripted(script), crash_on=(Outcome.COLLISION, Outcome.RED_LIGHT))
    assert (first.outcome, first.event) == (Outcome.COLLISION, None)  # where it collides in the same step, it collided


def test_an_oracle_that_wants_it_sees_the_map_before_it_looks(run):
    class Looks:
        name = "looks"

        def __init__(self):
            self.seen = []

        def see_map(self, lanes):
            self.seen.append(lanes)

        def check(self, scene, agents):
            self.seen.append(scene.time_s)
            return []

    class Mapped(Scripted):
        def lanes(self):
            return ["a lane"]

    for simulator, expected in ((Mapped(), ["a lane"]), (Scripted(), ())):
        looks = Looks()
        run(simulator, oracles=(looks,), max_steps=2)
        assert looks.seen == [expected, 0.0, 0.5, 1.0]


def test_who_overlaps_before_the_first_step_was_never_on_the_road(run):
    result = run(Scripted({0: {"scene": {"xs": (0.0, 4.0, 20.0)}}}))
    assert (result.outcome, result.steps, result.digest, result.danger) == (Outcome.INVALID, 0, "", None)
    assert run(Scripted({1: {"scene": {"xs": (0.0, 4.0, 20.0)}}})).danger == 1.0
    assert 0.0 <= run(Scripted()).danger < 1.0
    assert (result.failure.kind, result.failure.message) == ("invalid", "ego and second overlap before the first step")
    assert result.collision is not None
    red = Event("red_light", "ego", "ego ran 'c'")
    result = run(Scripted({0: {"events": (red,)}}), crash_on=(*CRASHES, Outcome.RED_LIGHT))
    assert (result.outcome, result.failure.message) == (Outcome.INVALID, "ego ran 'c' before the first step")


def test_agents_leave_one_by_one(run):
    log = []
    simulator = Scripted({1: {"ends": ("ego",)}, 3: {"ends": ("second",)}})
    result = run(simulator, {"ego": Driver(log=log)}, max_steps=9)
    assert (result.outcome, result.steps) == (Outcome.FINISHED, 3)
    assert [list(actions) for actions in simulator.asked[1:]] == [["ego", "second"], ["second"], ["second"]]
    assert len(log) == 3  # its seed, one step, and its end
    assert [step.rewards for step in run.recording().all_steps[1:]] == [
        {"ego": 1.0, "second": 2.0}, {"ego": 0.0, "second": 2.0}, {"ego": 0.0, "second": 3.0},
    ]  # fmt: skip
    aux = [record.aux for record in run.records if record.tag == Tag.ACTION]
    assert aux == [0, 1, 1, 1]
    both = run(Scripted({2: {"ends": ("ego", "second")}}), max_steps=9)
    assert (both.outcome, both.steps) == (Outcome.FINISHED, 2)
    cut = run(Scripted({2: {"truncated": ("ego", "second")}}), max_steps=9)
    assert (cut.outcome, cut.steps) == (Outcome.FINISHED, 2)
    mixed = run(Scripted({2: {"truncated": ("ego",), "ends": ("second",)}}), max_steps=9)
    assert (mixed.outcome, mixed.steps) == (Outcome.FINISHED, 2)
    one = run(Scripted({2: {"truncated": ("ego",)}}), max_steps=4)
    assert (one.outcome, one.steps) == (Outcome.SURVIVED, 4)


@pytest.mark.parametrize(
    ("script", "outcome", "kind", "agent", "steps"),
    [
        ({"ego": Driver({2: ValueError("no")})}, Outcome.AGENT_ERROR, "ValueError", "ego", 1),
        ({"second": Driver({1: SystemExit(3)})}, Outcome.AGENT_ERROR, "SystemExit", "second", 0),
        ({"second": Driver({3: (5.0, 7)})}, Outcome.AGENT_ERROR, "bad action", "second", 2),
        ({"ego": Driver({1: KeyboardInterrupt()})}, Outcome.AGENT_ERROR, "KeyboardInterrupt", "ego", 0),
        ({"second": Driver({"reset": ValueError("no")})}, Outcome.INVALID, "ValueError", "second", 0),
        ({"ego": RuntimeError("cannot be made")}, Outcome.INVALID, "RuntimeError", "ego", 0),
    ],
)
def test_what_an_agent_raises_is_its_own_fault(run, script, outcome, kind, agent, steps):
    log = []
    drivers = {"ego": Driver(log=log), **script}
    result = run(drivers=drivers)
    assert (result.outcome, result.failure.kind, result.failure.agent, result.steps) == (outcome, kind, agent, steps)
    assert "Traceback" in result.failure.traceback
    assert bool(result.digest) == (outcome is Outcome.AGENT_ERROR)
    if "ego" not in script:
        assert log[-1] == "closed"
    actions = [record.aux for record in run.records if record.tag == Tag.ACTION]
    assert len(actions) == 2 * steps + (agent == "second" and outcome is Outcome.AGENT_ERROR)


@pytest.mark.parametrize(
    ("at", "error", "outcome", "kind"),
    [
        (2, SimulatorError("it gave up"), Outcome.SIMULATOR_ERROR, "simulator error"),
        (2, SystemExit(1), Outcome.SIMULATOR_ERROR, "SystemExit"),
        (0, InvalidEpisodeError("no room"), Outcome.INVALID, "invalid"),
        (0, OSError("no file"), Outcome.INVALID, "OSError"),
    ],
)
def test_what_a_simulator_raises_is_no_agents_fault(run, at, error, outcome, kind):
    result = run(Scripted({at: {"raises": error}}))
    assert (result.outcome, result.failure.kind, result.failure.agent) == (outcome, kind, "")
    assert result.failure.message == str(error)
    assert ("Traceback" in result.failure.traceback) == (kind != "invalid")
    assert result.steps == max(0, at - 1)
    assert result.sim_time_s == result.steps / 2


def test_an_agent_that_cannot_even_be_closed_has_driven_all_the_same(run, capsys):
    result = run(drivers={"ego": Driver({"close": RuntimeError("stuck")})})
    assert result.outcome is Outcome.SURVIVED
    assert "stuck" in capsys.readouterr().err
    open_ended = SimpleNamespace(reset=lambda seed: None, act=lambda observation: (1.0, 0))
    assert run(drivers={"ego": open_ended}).outcome is Outcome.SURVIVED


def test_the_closest_approach_is_that_of_all_steps(run):
    """Measured many steps at a time: in the first, the last, and across their edges."""
    for at in (0, 255, 256, 300):
        result = run(Scripted({at: {"scene": {"xs": (0.0, 6.5, 20.0)}}}), max_steps=300)
        assert result.closest.gap_m == pytest.approx(1.5), at
        assert result.steps == 300


def test_a_structured_observation_is_shown_as_it_is_meant(run):
    shown = spaces.Dict(place=spaces.Box(-1e6, 1e6, (1,), np.float32), who=spaces.Box(-1e6, 1e6, (1,), np.float32))
    simulator, logs = Scripted(), {"ego": [], "second": []}
    simulator.shown_spaces = {"second": shown}
    run(simulator, {name: Driver(log=log) for name, log in logs.items()})
    assert logs["ego"][1].tolist() == [0, 0]
    assert {name: value.tolist() for name, value in logs["second"][2].items()} == {"place": [1], "who": [1]}
    assert run.recording().observations("second").tolist() == [[0, 1], [1, 1], [2, 1]]
