"""Steps that the core takes by itself: the same records, results and scenes as one thing after the other."""

from __future__ import annotations

import errno
import random
import shutil
from collections import Counter
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import examples
from saying import Says

from crashhunt.agents import KeepLaneWithSpeed
from crashhunt.base.errors import RecorderError
from crashhunt.crashes import own_frames
from crashhunt.episode import Episode, FastEpisode, Nearness, Observer, Recorder
from crashhunt.episode._fast_path import FastPath
from crashhunt.native import ANSWERED, ASK, DONE, REFUSED, SIMULATED
from crashhunt.oracles import OffRoad, Overlap, RedLight, ReportedCollision, RequirementOracle, TooClose
from crashhunt.recording import BlackBox, Tag
from crashhunt.scenario import argument_values, load_scenario
from crashhunt.simulators import SpeedAndLaneChange
from crashhunt.trial import CRASHES, Outcome, TrialSpec

core = pytest.importorskip("_crashhunt_core", reason="the compiled core is not built")

NET = Path(__file__).parents[1] / "on_sumo" / "signal.net.xml"
# Somebody follows the agent, somebody comes and somebody goes in its sight, and somebody else out of it.
TRAFFIC = (
    '<vType id="car" sigma="0"/>'
    '<vehicle id="ego" type="car" depart="0" departPos="60" departSpeed="8"><route edges="west east"/></vehicle>'
    '<vehicle id="behind" type="car" depart="0" departPos="40" departSpeed="8"><route edges="west east"/></vehicle>'
    '<vehicle id="far" type="car" depart="1.3" departPos="0"><route edges="south north"/></vehicle>'
    '<vehicle id="late" type="car" depart="2.5" departPos="20"><route edges="west north"/></vehicle>'
)


class Street:
    """A small scenario, whose episodes run with the core's own steps or without."""

    def __init__(self, folder, agent="", further=""):
        from crashhunt.sumo import SumoSimulator

        shutil.copy(NET, folder)
        (folder / "r.rou.xml").write_text(f"<routes>{TRAFFIC}{further}</routes>")
        (folder / "scenario.toml").write_text(
            'title = "t"\nschema = 1\nsimulator = "sumo"\nstep_length_s = 0.1\nwarmup_s = 0.0\n'
            '[sumo]\nnet = "signal.net.xml"\nroutes = ["r.rou.xml"]\n'
            f"[events]\nnot_moving = 2.0\n[agents.ego]\nexisting = true\n{agent}\n"
        )
        self.simulator = SumoSimulator(load_scenario(folder), folder)
        self.box = BlackBox(folder / "box")
        self.comes = Counter()

    def episode(self, answer, *, at_once=True, steps=90, oracles=(), crash_on=CRASHES, observers=(), seed=1):
        self.box.begin(pid=1, trial=0, started=0.0)
        episode = FastEpisode(
            TrialSpec(0, seed, {}, {}, steps), simulator=self.simulator, make_agent=lambda *_: Says(answer),
            oracles=[ReportedCollision(), Overlap(), OffRoad(), *oracles], crash_on=crash_on,
            observers=[Recorder(self.box, self.simulator), Nearness(self.box.take_frames), *observers],
        )  # fmt: skip
        assert episode.start() is None, episode.result
        take = episode._take if at_once else None
        episode._take = take and self._counted(take)
        return episode

    def _counted(self, take):
        def taken(agents):
            come = take(agents)
            self.comes[come] += 1
            return come

        return taken

    def run(self, answer, **options):
        """How an episode ends, and everything that is recorded of it."""
        with self.episode(answer, **options) as episode:
            while episode.result is None:
                episode.step()
            failure = episode.result.failure
            calls = [(one.file.name, one.function) for one in own_frames(failure)] if failure else []
            calls = [call for call in calls if call[1] not in ("taken", "breaks")]
            result = replace(episode.result, failure=failure and replace(failure, traceback=""))
        # By the calls, two faults are told to be the same.
        return repr(result), bytes(self.box.committed()), bytes(self.box._map[32:56]), repr(calls)

    def both(self, answer, **options):
        """The same with the core's own steps, without them, and without the core."""
        ours, theirs = self.run(answer, **options), self.run(answer, **options, at_once=False)
        assert ours == theirs
        return ours


@pytest.fixture
def street(tmp_path):
    made = Street(tmp_path)
    yield made
    made.box.close()
    made.simulator.close()


ANSWERS = {
    "steady": lambda step, _: (8.0, 0),
    "whole numbers": lambda step, _: (8, 0),
    "of NumPy's": lambda step, _: np.array([8.0, 0.0]),
    "as a list now and then": lambda step, _: [6.0, 0] if step % 3 else (6.0, 0),
    "what it sees": lambda step, seen: (min(12.0, 4.0 + abs(float(seen[1, 1])) / 10), 0),
    "changes lanes into nothing": lambda step, _: (8.0, 1 if step == 40 else 0),
    "brakes hard": lambda step, _: (8.0 if step < 25 else 0.0, 0),
    "stands and goes on": lambda step, _: (0.0 if 10 < step < 60 else 9.0, 0),
    "crawls": lambda step, _: (0.05, 0),
    "too fast": lambda step, _: (8.0 if step < 30 else 1e9, 0),
    "nonsense": lambda step, _: (8.0, 0) if step < 30 else (8.0, 2**70),
    "not a number": lambda step, _: (8.0, 0) if step < 30 else (float("nan"), 0),
    "true": lambda step, _: (8.0, 0) if step < 30 else (8.0, True),
    "raises": lambda step, _: (8.0, 0) if step < 30 else 1 / 0,
    "raises at once": lambda *_: 1 / 0,
}


@pytest.mark.parametrize("how", ANSWERS)
def test_an_episode_is_the_same_bit_by_bit(street, how):
    street.both(ANSWERS[how])
    street.both(ANSWERS[how], crash_on=[*CRASHES, Outcome("not_moving"), Outcome("hard_braking")], oracles=[RedLight()])
    assert street.comes[DONE] + street.comes[ANSWERED] > 20 or how == "raises at once"


ACCELERATIONS = {
    "within its limits": lambda _, seen: (max(-4.0, min(2.0, 8.0 - float(seen[0, 3]))), 0),
    "to a stand and on": lambda step, _: (-3.0 if 20 < step < 60 else 1.5, 0),
    "none": lambda step, _: (-0.0 if step % 2 else 0.0, 0),
    "the least and the most": lambda step, _: (-10.0 if step % 2 else 10.0, 0),
    "too much": lambda step, _: (1.0 if step < 30 else 10.5, 0),
    "not a number": lambda step, _: (1.0 if step < 30 else float("nan"), 0),
    "a lane that is not there": lambda step, _: (0.5, 1 if step == 40 else 0),
}


@pytest.mark.parametrize("how", ACCELERATIONS)
def test_accelerations_are_the_same_bit_by_bit(tmp_path, how):
    street = Street(tmp_path, 'action = "acceleration"')
    street.both(ACCELERATIONS[how])
    street.box.close()
    street.simulator.close()
    assert street.comes[DONE] > 10
    assert street.comes[ANSWERED] == (how in ("too much", "not a number", "a lane that is not there"))


def test_call_that_an_agent_must_not_make_is_its_error_even_if_it_hides_the_refusal(street):
    import libsumo

    def answer(step, _):
        if step == 30:
            with suppress(Exception):
                libsumo.vehicle.setSpeed("behind", 0.0)
        return 8.0, 0

    result, *_ = street.both(answer)
    assert "agent_error" in result
    assert "vehicle.setSpeed" in result
    assert "agent='ego'" in result


def test_most_steps_are_taken_at_once(street):
    result, *_ = street.both(ANSWERS["steady"])
    assert "survived" in result
    assert street.comes[DONE] > 80  # with those in which somebody comes
    assert not street.comes[SIMULATED]
    assert street.comes[ASK] == 1  # the last one


ALL_SIGNALS = (
    "always (time_s + x + y + heading + speed + acceleration + jerk + yaw_rate < 1e6 and min(gap_m, headway_s, ttc_s, "
    "leader_speed, priority_m, priority_arrival_s, red_light_m) + abs(leader_acceleration) + speed_limit >= 0 and "
    "clearance_m > -9 and lane < 9 and abs(lane_offset_m) < 9 and reward > -1e9 and observation[1] < 1e9 and "
    "not hard_braking and (leader_changed or not leader_changed))"
)
LEAD = (
    '<vehicle id="lead" depart="0" departPos="95" departLane="0" departSpeed="5"><route edges="west east"/></vehicle>'
)
REQUIREMENTS = {
    "all signals": ("steady", [ALL_SIGNALS]),
    "violated": ("steady", ["always (time_s < 4.05)", "always (x < 1e6)"]),
    "violated by the gap": ("steady", ["always (gap_m > 31 or time_s < 1)", "always (gap_m > -1)"]),
    "violated later": ("brakes hard", ["always (speed < 5 -> eventually[0:2] (speed > 6))", "always (jerk > -1e9)"]),
    "violated by the jerk": ("brakes hard", ["always (abs(jerk) < 30)"]),
    "violated at the end": ("steady", ["eventually (x > 1e6)", "always[0:1] (speed > 0)"]),
    "violated at the start": ("steady", ["speed > 1e6"]),
    "violated in one step": ("steady", ["always (time_s < 4.05)", "always (not time_s >= 4.05)"]),
}


@pytest.fixture
def follow(tmp_path, monkeypatch):
    """A street with a vehicle ahead."""
    monkeypatch.setitem(globals(), "TRAFFIC", TRAFFIC.replace('<vehicle id="behind"', f'{LEAD}<vehicle id="behind"'))
    made = Street(tmp_path)
    yield made
    made.box.close()
    made.simulator.close()


@pytest.mark.parametrize("how", REQUIREMENTS)
def test_requirements_read_the_same_with_steps_of_the_core(follow, how):
    answer, formulas = REQUIREMENTS[how]

    def run(*, at_once):
        oracles = [RequirementOracle(f"r{number}", formula) for number, formula in enumerate(formulas)]
        found = follow.run(
            ANSWERS[answer], oracles=oracles, crash_on=[*CRASHES, Outcome("requirement")], at_once=at_once
        )
        return found, [bytes(one) for oracle in oracles for one in oracle._watched[0].monitor.samples]

    ours = run(at_once=True)
    assert ours == run(at_once=False)
    assert ("ego violates r0" in ours[0][0]) == how.startswith("violated")
    assert follow.comes[DONE] > 5 or how == "violated at the start"


def test_requirement_without_a_value_ends_an_episode_of_the_core(street):
    formula = "always (1 / (time_s - 4) < 1e9)"
    results = [
        street.run(ANSWERS["steady"], oracles=[RequirementOracle("r", formula)], at_once=at_once)
        for at_once in (True, False)
    ]
    assert results[0] == results[1]
    assert "it divides by zero at sample 40" in results[0][0]


def test_requirements_of_ordinary_signals_keep_the_steps_of_the_core(follow, monkeypatch):
    formula = "always (speed < 99 and abs(jerk) < 1e9 and headway_s + ttc_s >= 0 and red_light_m > -9 and x < 1e9)"
    with follow.episode(ANSWERS["steady"], oracles=[RequirementOracle("calm", formula)], steps=500) as episode:
        episode.step()
        monkeypatch.setattr(follow.simulator.at_once, "catch_up", None)  # which makes the scene
        follow.comes.clear()
        for _ in range(8):
            assert episode.step() is None
    assert follow.comes == {DONE: 8}


@pytest.mark.parametrize("every", [1, 7, 10, 11])
def test_the_one_that_looks_sees_the_same(street, every):
    def seen(*, at_once):
        with street.episode(ANSWERS["what it sees"], at_once=at_once) as episode:
            while episode.result is None:
                episode.step()
                if episode.steps % every == 0:
                    scene, last = episode.scene, episode.scene.previous
                    assert scene is episode.scene is street.simulator.scene()
                    assert last.previous is None
                    yield [
                        [
                            one.time_s,
                            one.lanes,
                            one.points,
                            one.headings,
                            one.speeds,
                            one.agent_lanes,
                            one.swept,
                            one.events,
                        ]
                        for one in (scene, last)
                    ]
                    yield episode.steps, episode.observations["ego"].tobytes(), episode.rewards, episode.terminations
                    yield street.simulator.at_once is None, episode.acting

    assert [*seen(at_once=True)] == [*seen(at_once=False)]


def test_what_is_recorded_can_be_read_after_each_step(street):
    def read(*, at_once):
        with street.episode(ANSWERS["steady"], at_once=at_once, steps=30) as episode:
            while episode.step() is None:
                yield bytes(street.box._map[32:56])
                if episode.steps % 2:
                    yield len(street.box.committed()), len(street.box.take_frames())

    assert [*read(at_once=True)] == [*read(at_once=False)]


def test_where_there_is_no_room_python_makes_some(street, monkeypatch, tmp_path):
    monkeypatch.setattr("crashhunt.recording._blackbox.CHUNK", 4096)
    street.box.close()
    street.box = BlackBox(tmp_path / "small")
    street.both(ANSWERS["steady"])


@pytest.fixture
def introduced(monkeypatch):
    """The actors that were recorded while the core had no room for them, which lends itself short buffers."""
    lend, record_roster, given = BlackBox.lend, FastPath._record_roster, []
    draw = random.Random(1)

    def lend_little(box, *what):
        box._stop_core()
        whole, box._reserved = box._reserved, box._offset + draw.randrange(200, 1200)
        lend(box, *what)
        box._reserved = whole

    def listening(fast, records=(b"", b"")):
        given.append(records[0])
        record_roster(fast, records if records[1] else None)

    monkeypatch.setattr(BlackBox, "lend", lend_little)
    monkeypatch.setattr(FastPath, "_record_roster", listening)
    return given


def test_actors_that_come_are_recorded_although_the_buffer_is_short(street, introduced):
    whole = street.run(ANSWERS["steady"], at_once=False)
    for _ in range(examples(25)):
        assert street.run(ANSWERS["steady"]) == whole
    assert any(introduced)


def test_a_disk_that_is_full_as_an_actor_comes_is_reported(street, introduced, monkeypatch):
    append = BlackBox.append

    def full(box, tag, aux, payload):
        if tag == Tag.ACTORS and any(introduced):
            raise RecorderError("the trial cannot be recorded", fix="", where="")
        append(box, tag, aux, payload)

    def often():
        for _ in range(25):
            street.run(ANSWERS["steady"])

    monkeypatch.setattr(BlackBox, "append", full)
    with pytest.raises(RecorderError):
        often()


class _Scenes(Observer):
    def __init__(self):
        self.told = []

    def scene(self, step, scene, rewards):
        self.told.append((step, scene.time_s, scene.speeds, rewards))


class _Answers(Observer):
    def __init__(self):
        self.told = []

    def observation(self, number, observation):
        self.told.append((number, observation.tobytes()))

    def action(self, number, action):
        self.told.append((number, action.tobytes()))


@pytest.mark.parametrize("kind", [_Scenes, _Answers])
def test_observers_are_reported_of_everything(street, kind):
    ours, theirs = kind(), kind()
    street.run(ANSWERS["stands and goes on"], observers=[ours])
    street.run(ANSWERS["stands and goes on"], observers=[theirs], at_once=False)
    assert ours.told == theirs.told
    assert len(ours.told) > 90


class _Counts:
    name = "counts"

    def __init__(self):
        self.asked = []

    def check(self, scene, agents):
        self.asked.append((scene.time_s, scene.previous and scene.previous.time_s, agents))
        return []


def test_oracles_of_others_are_asked_about_every_step(street):
    ours, theirs = _Counts(), _Counts()
    street.run(ANSWERS["steady"], oracles=[ours])
    street.run(ANSWERS["steady"], oracles=[theirs], at_once=False)
    assert ours.asked == theirs.asked
    assert len(ours.asked) == 91
    near = street.both(
        lambda step, _: (8.0 if step < 30 else 0.0, 0), oracles=[TooClose(10.0, 0.0)], crash_on=[Outcome("too_close")]
    )
    assert "too_close" in near[0]


def test_an_oracle_that_inherits_from_one_of_ours_is_asked(street):
    class Sees(OffRoad):
        def check(self, scene, agents):
            return 1 / 0 if scene.time_s > 4 else []

    result, *_ = street.both(ANSWERS["steady"], oracles=[Sees()])
    assert "ZeroDivisionError" in result


def test_an_agent_that_is_replaced_is_asked_from_then_on(street):
    with street.episode(ANSWERS["steady"], steps=30) as episode:
        while episode.result is None:
            episode.step()
            if episode.steps == 10:
                episode.agents["ego"] = Says(lambda step, _: (1.0, 0))
    assert street.comes[DONE] > 15
    assert street.simulator.scene().speeds[street.simulator.scene().roster.index["ego"]] < 3


def test_given_actions_are_not_asked_for(street):
    actions = {"ego": np.array([3.0, 0.0])}
    with street.episode(lambda *_: 1 / 0, steps=20) as episode:
        while episode.step(actions) is None:
            pass
        assert episode.result.outcome == "survived", episode.result
    assert not street.comes


def test_a_simulator_of_an_actor_elses_takes_its_own_steps(street, tmp_path):
    class Slower(type(street.simulator)):
        def step(self, actions):
            return super().step({agent: action / 2 for agent, action in actions.items()})

    before = street.run(ANSWERS["steady"])
    street.simulator.__class__ = Slower
    assert street.both(ANSWERS["steady"]) != before
    assert street.simulator.at_once is None


class _Wrapper:
    """Somebody's around a simulator, of which one thing is another."""

    def __init__(self, simulator, **others):
        self._simulator = simulator
        vars(self).update(others)

    def __getattr__(self, name):
        return getattr(self._simulator, name)


class _Halved:
    names, space = SpeedAndLaneChange.names, SpeedAndLaneChange().space

    def encode(self, action):
        return np.array(action) / 2


def _slower(street):
    """What has a steady agent drive half as fast: in a wrapper, or set in the simulator itself."""
    simulator, step = street.simulator, street.simulator.step

    def halved(actions):
        return step({agent: action / 2 for agent, action in actions.items()})

    yield _Wrapper(simulator, step=halved)
    yield _Wrapper(simulator, actions={"ego": _Halved()})
    simulator.actions["ego"] = _Halved()
    yield simulator
    simulator.actions["ego"] = SpeedAndLaneChange()
    simulator.step = halved
    yield simulator
    del simulator.step


def test_what_an_actor_wraps_or_sets_is_not_passed_by(street):
    plain, simulator = street.run(ANSWERS["steady"]), street.simulator
    found = set()
    for slower in _slower(street):
        street.simulator = slower
        found.add(street.both(ANSWERS["steady"]))
    assert len(found) == 2  # recorded as it was answered, or as it was encoded
    assert plain not in found
    street.comes.clear()
    street.simulator = _Wrapper(simulator, scene=simulator.scene)
    assert street.both(ANSWERS["steady"]) == plain
    assert street.comes[DONE] > 60  # what only hands on is no other


def test_an_answer_is_let_go_when_it_has_been_read(street):
    def view(step, _):
        kept.extend(b"more")  # an error while somebody looks into it
        del kept[16:]
        return np.frombuffer(kept)

    kept = bytearray(np.array([8.0, 0.0]).tobytes())
    assert "survived" in street.both(view)[0]


def test_a_black_box_that_fails_at_an_action_is_the_agents_doing(street, monkeypatch):
    lend, action, told = street.box.lend, street.box.action, []

    class Scarce:
        """Room for an observation, and not for what the agent answers."""

        def __init__(self, steps):
            self.give_back, self._borrow = steps.give_back, steps.borrow

        def borrow(self, tape, offset, reserved, *rest):
            self._borrow(tape, offset, offset + street.simulator._shown["ego"].nbytes + 16, *rest)

    def scarcely(steps, *rest):
        return lend(Scarce(steps), *rest)

    def closed(number, array):
        told.append(number)
        if len(told) % 30 == 0:
            raise OSError(errno.EBADF, "closed")
        action(number, array)

    monkeypatch.setattr(street.box, "lend", scarcely)
    monkeypatch.setattr(street.box, "action", closed)
    result, *_ = street.both(ANSWERS["of NumPy's"])
    assert "agent_error" in result
    assert "closed" in result
    assert street.comes[REFUSED] > 20


def test_another_simulator_is_reported_of(street, tmp_path):
    (tmp_path / "other").mkdir()
    other = Street(tmp_path / "other")

    def meddle(step, _):
        if step == 20:
            other.simulator.reset(seed=1)
        return 8.0, 0

    result, *_ = street.both(meddle)
    assert "another simulator in this process has been reset" in result
    other.box.close()
    other.simulator.close()


def test_what_sumo_raises_is_reported(street, monkeypatch):
    import libsumo

    step, calls = libsumo.simulationStep, []

    def breaks():
        calls.append(1)
        if len(calls) % 31 == 0:
            raise libsumo.TraCIException("no more")
        step()

    monkeypatch.setattr(libsumo, "simulationStep", breaks)
    result, *_, calls = street.both(ANSWERS["steady"])
    assert "SUMO gave up: no more" in result
    assert "kind='simulator error'" in result
    assert calls == "[('_simulator.py', 'step')]"


MEDDLING = {
    "goes": lambda libsumo: libsumo.vehicle.remove("ego"),
    "takes somebody away": lambda libsumo: libsumo.vehicle.remove("behind"),
    "simulates": lambda libsumo: [libsumo.vehicle.remove("behind"), libsumo.simulationStep()],
    "simulates for long": lambda libsumo: [libsumo.simulationStep() for _ in range(9)],
    "looks ahead": lambda libsumo: [
        libsumo.simulation.saveState("ahead.xml"),
        libsumo.simulationStep(),
        libsumo.simulation.loadState("ahead.xml"),
    ],
    "moves somebody": lambda libsumo: libsumo.vehicle.moveTo("behind", "west_0", 5.0),
}


@pytest.mark.usefixtures("agents_may_command_sumo")
@pytest.mark.parametrize("what", MEDDLING)
def test_an_agent_that_meddles_with_sumo_sees_the_same(street, what, tmp_path, monkeypatch):
    import libsumo

    monkeypatch.chdir(tmp_path)

    def meddle(step, _):
        if step == 22 or (step > 22 and what == "looks ahead" and step % 3 == 0):
            MEDDLING[what](libsumo)
        return 8.0, 0

    result, *_ = street.both(meddle)
    if what == "goes":  # the agent has removed its own vehicle, and SUMO has not failed
        assert "Outcome.FINISHED" in result
    assert street.comes[DONE] > 10


@pytest.mark.usefixtures("agents_may_command_sumo")
def test_what_sumo_does_not_report_is_seen_by_the_oracle(street):
    import libsumo

    def meddle(step, _):
        if step >= 30:  # beside the road, where SUMO looks at nobody, and aslant into the agent
            x, y = libsumo.vehicle.getPosition("ego")
            libsumo.vehicle.moveToXY("behind", "", 0, x + 0.4, y + 2.0, 60.0, 2)
        return 8.0, 0

    result, *_ = street.both(meddle)
    assert "seen_by=('overlap',)" in result
    assert street.comes[ASK]


@pytest.mark.parametrize("place", range(17))
def test_what_reads_something_else_takes_no_steps(street, place):
    class Lying:
        def __init__(self, *given):
            self._steps = core.UsualSteps(*given)

        def reads(self, vehicles):
            read = [*self._steps.reads(vehicles)]
            read[place] = f"{read[place]}0" if isinstance(read[place], str) else read[place] + 1e-9
            return tuple(read)

        def __getattr__(self, name):
            return getattr(self._steps, name)

    class Core:
        UsualSteps = Lying

        def __getattr__(self, name):
            return getattr(core, name)

    street.simulator._sight.core = Core()
    ours = street.run(ANSWERS["steady"], steps=2)
    assert street.simulator.at_once is street.simulator._sight.core is None
    assert len(street.simulator.notices) == 1
    assert ours == street.run(ANSWERS["steady"], steps=2)


def test_a_meta_action_is_applied_by_python(tmp_path):
    street = Street(tmp_path, 'action = "meta"\ntarget_speeds = [0, 4, 8, 12]')
    street.both(lambda step, _: step % 5)
    assert street.simulator.at_once is not None
    street.box.close()
    street.simulator.close()


def test_arguments_of_another_kind_are_refused(street):
    street.run(ANSWERS["steady"], steps=12)
    steps = street.simulator.at_once.core
    sized = core.Vehicles(("a",), [5.0], [2.0], [5.1])
    for call in (
        lambda: core.UsualSteps("ego", None, (), 1, 0.1, False, True, (sized, 10, 1.0), 0.0),
        lambda: core.UsualSteps("ego", None, (None, None, None), 1, 0.1, False, True, (None, 10, 1.0), 0.0),
        lambda: core.UsualSteps("ego", None, (None, None, None), -1, 0.1, False, True, (sized, 10, 1.0), 0.0),
        lambda: core.UsualSteps("ego", None, (None, None, None), 1, 0.1, False, True, (sized, 0, 1.0), 0.0),
        lambda: steps.heed([], 0.0, {}, 1),
        lambda: steps.judge(1),
        lambda: steps.borrow(bytearray(200), 0, 100, (1, 2, 3, 4, 5), None, b""),
        lambda: steps.borrow(bytearray(200), 201, 100, (1, 2, 3, 4, 5), None, b""),
        lambda: steps.borrow(b"", 64, 100, (1, 2, 3, 4, 5), None, b""),
        lambda: steps.resume((sized, (), 0, {}, ()), None, None, 0.0, "", ("", 0, "", 0.0), "", 1),
        lambda: steps.reads(None),
    ):
        with pytest.raises((TypeError, ValueError, BufferError)):
            call()
    columns = core.columns(sized, [(0.0, 0.0)], [0.0], [0.0])
    for ids, row, actors in (((), 0, (1,)), (("a",), 1, (1,)), (("a",), -1, (1,)), (("a",), 0, ())):
        with pytest.raises(ValueError, match="not the vehicles"):
            steps.resume((sized, ids, row, {}, actors), None, columns, 0.0, "", ("", 0, "", 0.0), "", 1)
    assert steps.take({}) == steps.take(None) == 2
    assert not steps.note(np.zeros(2))


# Each drives where the agent does, or stands beside its road.
SIZES = {
    "plain": ("passenger", 4.3), "small": ("motorcycle", 0.1 + 0.2), "bent": ("trailer", 16.5), "é": ("taxi", 5.0),
    "long": ("bus", 12.0),
}  # fmt: skip
ENDS = "east", "north"
FURTHER = (
    '<vehicle id="stands" depart="2.6" departPos="70"><route edges="west east"/>'
    '<stop lane="west_0" endPos="76" duration="900" parking="true"/></vehicle>'
) + "".join(
    f'<vType id="{name}" vClass="{kind}" length="{length!r}" width="{length / 3!r}" sigma="0"/>'
    f'<vehicle id="{name}-1" type="{name}" depart="{3 + number}"><route edges="west {ENDS[number % 2]}"/>'
    f'</vehicle><vehicle id="{name}-2" type="{name}" depart="{3 + number}"><route edges="south north"/></vehicle>'
    for number, (name, (kind, length)) in enumerate(SIZES.items())
)


def test_vehicles_of_all_sizes_and_names_are_recorded_as_python_does(tmp_path, monkeypatch):
    from crashhunt.sumo import Sight, _scene_reader

    read, actor_of = [], Sight._actor
    monkeypatch.setattr(Sight, "_actor", lambda sight, vehicle: (read.append(vehicle), actor_of(sight, vehicle))[1])
    street = Street(tmp_path, further=FURTHER)
    met = set()

    def waits(step, _):
        return 0.0 if step % 100 < 60 else 8.0, 0

    for sight_m in (20.0, 45.0, 12.0, 30.0)[: examples(5)]:
        monkeypatch.setattr(_scene_reader, "_SIGHT_SQUARED", sight_m**2)
        whole = street.run(waits, at_once=False, steps=300, crash_on=())
        read.clear()
        assert street.run(waits, steps=300, crash_on=()) == whole
        met |= {*street.simulator._sight.known} - {*read}
    assert {"stands", "small-1"} <= met  # they were read by the core
    street.box.close()
    street.simulator.close()


def test_vehicles_that_come_into_sight_again_are_recorded_without_python(tmp_path, monkeypatch):
    from crashhunt.sumo import SumoSimulator

    scenario = load_scenario("loop")
    simulator, box = SumoSimulator(scenario, tmp_path), BlackBox(tmp_path / "box")
    spec = TrialSpec(0, 1, {}, argument_values(scenario), 400)
    calls, recorded, record_roster = [], {}, FastPath._record_roster
    monkeypatch.setattr(FastPath, "_record_roster", lambda path: (calls.append(1), record_roster(path))[1])
    for kind in (Episode, FastEpisode):
        box.begin(pid=0, trial=0, started=0.0)
        with kind(spec, simulator=simulator, make_agent=lambda *_: KeepLaneWithSpeed(10.0), crash_on=(),
                  observers=[Recorder(box, simulator)]) as episode:  # fmt: skip
            result = episode.start()
            while result is None:
                result = episode.step()
        recorded[kind] = bytes(box.committed())
    assert recorded[Episode] == recorded[FastEpisode]
    at, rosters, data = 0, 0, recorded[FastEpisode]
    while at < len(data):
        rosters += data[at] == Tag.ROSTER
        at += 8 + (int.from_bytes(data[at + 4 : at + 8], "little") + 7) // 8 * 8
    assert rosters > 30
    assert len(calls) < rosters  # those of vehicles seen for the first time, and those after an event
    box.close()
    simulator.close()
