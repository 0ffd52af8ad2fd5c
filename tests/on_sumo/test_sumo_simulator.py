"""Parts of the simulator SUMO without SUMO: windows, braking, the core's conditions, and errors in words."""

from __future__ import annotations

from types import SimpleNamespace

import libsumo
import numpy as np
import pytest
from fake_sumo import FakeSumo

from crashhunt.base.errors import InvalidEpisodeError, SimulatorError
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.simulators import META_ACTIONS
from crashhunt.sumo import SumoSetup, SumoSimulator, _loading, _simulator
from crashhunt.trial import Disturbance
from crashhunt.world import Actor, Contact, Roster, Scene


@pytest.fixture
def sumo(monkeypatch):
    made = FakeSumo(vehicle_getIDList=("ego", "x"), person_getIDList=("p",))
    made.__file__ = _simulator.sumo.__file__
    monkeypatch.setattr(_simulator, "sumo", made)
    return made


@pytest.fixture
def make(monkeypatch, sumo):
    """Return a function that makes a simulator without the compiled core and without files."""
    monkeypatch.setattr(_simulator, "core_for", lambda *_: None)
    monkeypatch.setattr(_simulator, "StagedFiles", lambda scenario, stage: SimpleNamespace(
        arguments=lambda seed, arguments: ["command", seed, arguments]
    ))  # fmt: skip
    monkeypatch.setattr(_simulator, "Loading", lambda *, fix_link_order: SimpleNamespace(fixed=fix_link_order))

    def make(options=None, step_s=0.5, fix=None, **agents):
        setups = agents or {"ego": AgentSetup(route="r")}
        table = SumoSetup(net="n", options=options or {}, fix_link_order=fix)
        return SumoSimulator(Scenario(step_length_s=step_s, agents=setups, tables={"sumo": table}), None)

    return make


def test_lateral_offsets_are_read_where_options_of_sumo_allow_them(make):
    assert [make(options)._lateral for options in ({}, {"lateral-resolution": 0.8}, {"lanechange.duration": 3})] == [
        False, True, True,
    ]  # fmt: skip
    assert [make(fix=fix)._loading.fixed for fix in (None, True, False)] == [True, True, False]
    forms = make(a=AgentSetup(route="r", action="meta"), b=AgentSetup(route="r")).actions
    assert [type(forms[name]).__name__ for name in "ab"] == ["MetaAction", "SpeedAndLaneChange"]


def test_hardest_braking_is_what_the_speed_mode_allows(make, monkeypatch):
    monkeypatch.setattr(_simulator, "libsumo", SimpleNamespace(vehicle=SimpleNamespace(getDecel=lambda name: 4)))
    made = make(
        meta=AgentSetup(route="r", action="meta"), limited=AgentSetup(route="r", speed_mode=4),
        usual=AgentSetup(route="r", speed_mode=31), free=AgentSetup(route="r", speed_mode=3),
    )  # fmt: skip
    assert made.full_braking("meta").action == META_ACTIONS.index("SLOWER")
    for agent in ("limited", "usual"):
        found = made.full_braking(agent)
        assert (found.action, found.deceleration, found.how) == ((0.0, 0), 4.0, "the maximum of its vehicle type")
    free = made.full_braking("free")
    assert (free.action, free.deceleration, free.how) == ((0.0, 0), None, "as hard as its speed mode 3 allows")


def test_window_follows_the_first_actor_and_marks_the_second(make, monkeypatch):
    calls = []

    def noted(name):
        return lambda *given: calls.append((name, *given))

    tracked = ["other"]
    library = SimpleNamespace(
        vehicle=SimpleNamespace(setColor=noted("vehicle")), person=SimpleNamespace(setColor=noted("person")),
        gui=SimpleNamespace(getIDList=lambda: ("view", "more"), getTrackedVehicle=lambda view: tracked[0],
                            trackVehicle=noted("track"), setZoom=noted("zoom"), getZoom=lambda view: 80.0),
        simulation=SimpleNamespace(getNetBoundary=lambda: ((-100.0, 0.0), (500.0, 50.0))), isLoaded=lambda: 1,
    )  # fmt: skip
    monkeypatch.setattr(_simulator, "libsumo", library)
    made = make()
    assert made.window_open is True
    made.follow("ego", "person p")
    assert calls == [("vehicle", "ego", (224, 138, 0, 255)), ("person", "p", (198, 40, 40, 255)),
                     ("track", "view", "ego"), ("zoom", "view", 320.0)]  # fmt: skip
    calls.clear()
    tracked[0] = "ego"
    made.follow("ego", "x")
    assert calls == [("vehicle", "ego", (224, 138, 0, 255)), ("vehicle", "x", (198, 40, 40, 255))]
    calls.clear()
    made.follow("gone", "person q")
    assert calls == []
    library.simulation.getNetBoundary = lambda: ((0.0, 0.0), (100.0, 50.0))
    tracked[0] = ""
    made.follow("ego", "x")
    assert calls[-1] == ("zoom", "view", 80.0)  # a small network is shown as a whole
    made.open_window()
    assert made._program[:2] == ["sumo-gui", "--start"]


@pytest.mark.parametrize(
    ("error", "kind", "before"),
    [
        (libsumo.TraCIException("Vehicle 'x'\n is not known"), InvalidEpisodeError, "SUMO says: "),
        (libsumo.FatalTraCIError("gone"), SimulatorError, "SUMO gave up: "),
    ],
)
def test_errors_of_sumo_are_one_line_and_those_outside_its_step_are_not_its_failure(error, kind, before, monkeypatch):
    def fails(*_):
        raise error

    text = " ".join(str(error).split())
    with pytest.raises(kind) as caught:
        _simulator._part(fails)(1, 2)
    assert str(caught.value).endswith(f"{before}{text}")
    assert _simulator._part(lambda one, *, two: (one, two))(1, two=2) == (1, 2)
    assert _simulator._one_line(KeyError()) == "KeyError"
    monkeypatch.setattr(_simulator.libsumo, "simulationStep", fails)
    with pytest.raises(SimulatorError, match="SUMO gave up: "):
        _simulator._simulating(SimpleNamespace(moving={}))()
    assert {_simulator._part(fails).__name__, _simulator._simulating(SimpleNamespace()).__name__} == {"step"}


def test_another_simulator_of_the_process_ends_the_episode(make, monkeypatch):
    first, second = make(), make()
    for current in (None, lambda: None, lambda: second):
        monkeypatch.setattr(_simulator, "_current", current)
        with pytest.raises(SimulatorError, match="another simulator in this process has been reset"):
            first.step({})
    closed = []
    library = SimpleNamespace(isLoaded=lambda: is_loaded, close=lambda: closed.append(1))
    monkeypatch.setattr(_simulator, "libsumo", library)
    for current, loaded, count in (
        (None, True, 0), (lambda: second, True, 0), (lambda: first, False, 0), (lambda: first, True, 1),
    ):  # fmt: skip
        monkeypatch.setattr(_simulator, "_current", current)
        is_loaded = loaded
        first.close()
        assert len(closed) == count


def test_disturbances_and_holds_are_passed_on(make, monkeypatch):
    made, lost = make(), []
    made._scene = "scene"
    monkeypatch.setattr(made._disturbances, "resolve_target", lambda *given: given)
    monkeypatch.setattr(made._disturbances, "disturb", lambda *given: given)
    monkeypatch.setattr(_simulator, "hold_vehicle", lambda *given: given)
    monkeypatch.setattr(made._sight, "lose", lost.append)
    brake, unseen = (Disturbance(1, "ahead", what, 1.0, 1.0, "ego") for what in ("brake", "unseen"))
    assert made.resolve_target(brake) == (brake, "scene")
    assert made.disturb("x", brake) == ("x", brake)
    made.disturb("x", unseen)
    assert made._kinematics.hidden == {("ego", "x")}
    assert made.hold("x", "keep_lane") == ("x", "keep_lane")
    assert lost == []
    assert made.hold("x", "gone") == ("x", "gone")
    assert lost == ["x"]


def test_actors_that_take_part_are_named_agents_or_replaced_by_agents(make):
    made = make(ego=AgentSetup(route="r"), two=AgentSetup(replaces="vehicle"))
    made._sight.leaving.add("p")
    made._begin(None, None, {"vehicle": "v"})
    assert (made._taking_part, made.entered, made.scripted) == (None, [], False)
    assert (list(made._setups), made._replaced, made._moved.keys()) == (["ego", "two"], {"v": "two"}, {"ego", "two"})
    assert made._sight.leaving == set()
    made._begin(("x",), None, {"vehicle": "v"})
    assert made._taking_part._takes_part == {"x", "ego", "two", "v"}
    assert made._taking_part._leaving is made._sight.leaving
    made._begin((), None, {"vehicle": "v"})
    assert made._taking_part._takes_part == {"ego", "two", "v"}
    path = SimpleNamespace(actor=SimpleNamespace(id="ego"))
    script = SimpleNamespace(agents=[path], names=("x", "y"), others=())
    made._begin(None, script, {"vehicle": "v"})
    assert (list(made._setups), made._replaced, made.scripted) == (["ego"], {}, True)
    assert made._moved.keys() == {"ego", "two", "x", "y"}
    assert made._taking_part._takes_part == {"ego"}
    assert type(made._look_with).__name__ == "ScriptedSight"
    made._begin(None, None, {"vehicle": "v"})
    assert made._look_with is made._sight


@pytest.fixture
def running(make, sumo, monkeypatch):
    """A simulator after its reset, whose scenes a test gives."""
    made = make(a=AgentSetup(route="r"), b=AgentSetup(route="r"))
    monkeypatch.setattr(_simulator, "_current", lambda: made)
    stepped = []
    monkeypatch.setattr(_simulator.libsumo, "simulationStep", lambda: stepped.append(1))
    made.agents, made._steps, made._start, made._last_lanes = ["a", "b"], 0, {"a": 100.0, "b": 0.0}, {}
    made.stepped, made.looks, made.applied = stepped, [], []
    sumo.answers |= {"vehicle_getRoadID": "e", "vehicle_getLaneIndex": 1, "vehicle_getDistance": 130.0}
    made._driving = SimpleNamespace(
        apply=lambda agent, action: made.applied.append((agent, action)) or action != "off", lanes=lambda edge: 3,
        from_left=lambda edge, lane: 3.5, aside=lambda agent: (0.25, -0.5), moving={}, settle=lambda: None,
    )  # fmt: skip

    def look(steps, off_road):
        made.looks.append((steps, tuple(off_road)))
        actors = tuple(Actor(name, "car", 4.0, 2.0, 1.5) for name in made.there)
        count = len(actors)
        found = Scene(0.0, Roster(actors), [(9.0 * n, 0.0) for n in range(count)], [0.0] * count, [8.0] * count)
        found.contacts = made.contacts
        return found

    made.there, made.contacts = ["a", "b", "x"], ()
    made._look_with = SimpleNamespace(look=look)
    made._events = SimpleNamespace(look=lambda scene, agents: (("events", agents),))
    return made


def test_step_reports_what_the_scene_has(running):
    observations, rewards, terminations, truncations, infos = running.step({"a": 1, "b": 2})
    assert (running.applied, running.stepped, running.looks) == ([("a", 1), ("b", 2)], [1], [(1, ())])
    assert observations["a"][0, :4].tolist() == [1.0, 30.0, 3.5, 8.0]
    assert observations["b"][0, 1] == 130.0
    assert rewards == {"a": 4.0, "b": 4.0}
    assert terminations == truncations == {"a": False, "b": False}
    assert infos == {"a": {}, "b": {}}
    assert running.scene().events == (("events", ("a", "b")),)
    assert running.scene().agent_lanes == {"a": "e_1", "b": "e_1"}
    running._lateral = True
    observations, *_ = running.step({"a": 1})
    assert observations["a"][0, [2, 4]].tolist() == [3.75, -0.5]


def test_agent_ends_when_it_has_left_has_hit_or_leaves_the_road(running):
    running.there = ["b", "x"]
    observations, rewards, terminations, *_ = running.step({"a": 1, "b": 2})
    assert (terminations, rewards, running.agents) == ({"a": True, "b": False}, {"a": 0.0, "b": 4.0}, ["b"])
    assert not observations["a"].any()
    running.contacts = (Contact(collider="x", victim="b", kind="c", lane="", collider_speed=1.0, victim_speed=1.0),)
    *_, terminations, _, _ = running.step({"b": 2})
    assert (terminations, running.agents) == ({"b": True}, [])
    running.contacts, running.agents, running.there = (), ["a", "b"], ["a", "b", "x"]
    *_, terminations, _, _ = running.step({"a": "off", "b": 2})
    assert (terminations, running.agents, running.looks[-1]) == ({"a": True, "b": False}, ["b"], (3, ("a",)))
    running.step({"b": 2})
    assert running.looks[-1] == (4, ())


def test_step_that_sumo_cannot_do_is_a_failure_of_the_simulator(running, monkeypatch):
    def fails():
        raise libsumo.TraCIException("no lane")

    monkeypatch.setattr(_simulator.libsumo, "simulationStep", fails)
    with pytest.raises(SimulatorError, match="SUMO gave up: no lane"):
        running.step({"a": 1})


def test_reset_that_sumo_cannot_do_is_an_invalid_episode(make):
    def load(program, command):
        raise libsumo.FatalTraCIError("cannot\n load")

    made = make()
    made._loading.load = load
    with pytest.raises(InvalidEpisodeError, match="SUMO could not set up the episode: cannot load"):
        made.reset(seed=3)


@pytest.mark.parametrize(
    ("change", "fast"),
    [
        ({}, True), ({"core": None}, False), ({"agents": ["a", "b"]}, False), ({"agents": []}, False),
        ({"scripted": True}, False), ({"_taking_part": "filter"}, False), ({"usual": False}, False),
        ({"_lateral": True}, True), ({"_lateral": True, "left_hand": True}, False), ({"left_hand": True}, True),
    ],
)  # fmt: skip
def test_core_runs_steps_of_one_usual_agent(running, monkeypatch, change, fast):
    made = []
    monkeypatch.setattr(_simulator, "UsualSteps", lambda *given, **named: made.append((given, named)) or "fast")
    running._sight.core = change.get("core", "core")
    running.agents = change.get("agents", ["a"])
    running.scripted = change.get("scripted", False)
    running._taking_part = change.get("_taking_part")
    running._lateral = change.get("_lateral", False)
    running._driving.left_hand = change.get("left_hand", False)
    running._kinematics = SimpleNamespace(usual=change.get("usual", True), shape=(8, 7))
    assert running._usual_steps() == ("fast" if fast else None)
    if fast:
        ((given, named),) = made
        assert given == ("core", "a", running._sight, running._events, running._kinematics)
        assert (named["start_m"], named["step_length_s"], named["lateral"]) == (
            100.0,
            0.5,
            change.get("_lateral", False),
        )
        assert named["takes"] == 1
        assert named["instead_of"].keys() == {"actions", "reset", "step", "scene", "restore_observation"}
        assert named["apply"]("a", "off") is False
        assert running._off_road == ["a"]
        assert named["apply"]("a", 1) is True
        assert running._off_road == []


def test_core_is_wrong_where_any_of_its_values_differs(running):
    running._scene = SimpleNamespace(core="core")
    plain = {"a": np.array([1.0], np.float32)}
    running._observe_all = lambda: plain if running._scene.core is None else None
    right, wrong = {"a": np.array([1.0], np.float32)}, {"a": np.array([2.0], np.float32)}
    for observations, reads, usual, found in ((right, True, None, False), (wrong, True, None, True),
                                              (right, False, None, True), (right, True, True, False),
                                              (right, True, False, True)):  # fmt: skip
        running._sight.reads_right = lambda reads=reads: reads
        fast = None if usual is None else SimpleNamespace(reads_right=lambda usual=usual: usual)
        assert running._is_core_wrong(observations, fast) is found
        assert running._scene.core == "core"


# Loading.


@pytest.fixture
def loading(monkeypatch):
    calls = SimpleNamespace(order=[], library=[], reason="", missing="", loaded=False)
    order = SimpleNamespace(use=calls.order.append, check_load=lambda: calls.reason)
    monkeypatch.setattr(_loading, "link_order", lambda *_: order)
    monkeypatch.setattr(_loading, "why_no_link_order", lambda version: calls.missing)
    monkeypatch.setattr(_loading, "keep_xml_ready", lambda: calls.library.append("xml"))
    monkeypatch.setattr(_loading, "libsumo", SimpleNamespace(
        isLoaded=lambda: calls.loaded, load=lambda command: calls.library.append(("load", command)),
        start=lambda command: calls.library.append(("start", command)),
    ))  # fmt: skip
    return calls


def test_first_simulation_of_a_process_is_started_and_others_are_loaded(loading):
    made = _loading.Loading(fix_link_order=True)
    assert made.load(["sumo"], ("a", "b")) == ""
    assert loading.library == [("start", ["sumo", "a", "b"]), "xml"]
    loading.loaded = True
    made.load(["sumo"], ("a", "b"))
    assert loading.library[2:] == [("load", ["a", "b"])]
    assert loading.order == [True, True]


@pytest.mark.parametrize(
    ("fixed", "reason", "missing", "notice"),
    [(True, "odd", "", True), (False, "odd", "", False), (True, "", "", False), (True, "odd", "not installed", False)],
)
def test_order_of_links_that_is_not_fixed_is_noticed_where_it_should_be(loading, fixed, reason, missing, notice):
    loading.reason, loading.missing = reason, missing
    found = _loading.Loading(fix_link_order=fixed).load(["sumo"], ())
    assert found == (
        "the order of SUMO's links is not fixed, and trials may differ between processes: odd" if notice else ""
    )
