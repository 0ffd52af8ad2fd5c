"""An episode, a step at a time: who is told what, what can be looked at, and whose fault it is."""

from __future__ import annotations

import functools
import json
import os
import sys

import numpy as np
import pytest

from crashhunt.agents import KeepLaneWithSpeed
from crashhunt.episode import Episode, Nearness, Observer, Recorder, run_episode
from crashhunt.episode._failures import are_functions_replaced, failure_of, record_originals
from crashhunt.errors import RecorderError, SimulatorError
from crashhunt.oracles import Overlap, ReportedCollision
from crashhunt.recording import BlackBox
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.simulators.toy import ToySimulator
from crashhunt.trial import Disturbance, Outcome, TrialSpec

TWO = Scenario(simulator="toy", agents={"ego": AgentSetup(), "second": AgentSetup(action="meta")})
ONE = Scenario(simulator="toy", agents={"ego": AgentSetup()})
ORACLES = (ReportedCollision(), Overlap())


class Teller(Observer):
    """Writes down what it is told."""

    def __init__(self, log=None, name=""):
        self.log = [] if log is None else log
        self.name = name

    def begin(self, episode):
        self.log.append((f"begin{self.name}", episode.names, dict(episode.agents)))

    def observation(self, number, observation):
        self.log.append((f"observation{self.name}", number, observation.tobytes()))

    def action(self, number, action):
        self.log.append((f"action{self.name}", number, action.tolist()))

    def scene(self, step, scene, rewards):
        self.log.append((f"scene{self.name}", step, scene.time_s, rewards))

    def end(self, result):
        self.log.append((f"end{self.name}", result.outcome))
        return result


class Driver:
    """Drives at a speed, and fails as told."""

    def __init__(self, speed=5.0, fail_at=0, error=None):
        self.speed, self.fail_at, self.error = speed, fail_at, error
        self.steps = self.closed = 0

    def reset(self, seed):
        self.seed = seed

    def act(self, observation):
        self.steps += 1
        if self.steps == self.fail_at:
            raise self.error
        return self.speed, 0

    def close(self):
        self.closed += 1


def spec(steps=10, **arguments):
    return TrialSpec(0, 1, {}, arguments, steps)


@pytest.fixture
def begin(tmp_path):
    """Makes and starts an episode on the toy."""
    made = []

    def start(*, scenario=ONE, agent=None, observers=(), steps=10, oracles=ORACLES, **arguments):
        simulator = ToySimulator(scenario, tmp_path)
        episode = Episode(
            spec(steps, **arguments),
            simulator=simulator,
            make_agent=lambda name, *_: agent or KeepLaneWithSpeed(5.0, simulator.actions[name].space),
            oracles=oracles,
            observers=observers,
        )
        made.append(episode)
        episode.start()
        return episode

    yield start
    for episode in made:
        episode.close()


def drive(episode):
    while episode.result is None:
        episode.step()
    return episode.result


def test_observers_are_reported_everything_in_order(begin):
    log = []
    episode = begin(scenario=TWO, observers=(Teller(log, " 1"), Teller(log, " 2")), steps=1)
    assert [entry[0] for entry in log] == ["begin 1", "begin 2", "scene 1", "scene 2"]
    assert log[0][1:] == (("ego", "second"), {})  # nobody drives yet
    assert log[2][1:] == (0, 0.0, (0.0, 0.0))
    shown = {name: observation.tobytes() for name, observation in episode.observations.items()}
    log.clear()
    episode.step()
    told = [entry[0] for entry in log]
    each = ["observation 1", "observation 2", "action 1", "action 2"]
    assert told == [*each, *each, "scene 1", "scene 2", "end 2", "end 1"]
    assert log[0][1:] == (0, shown["ego"])
    assert log[4][1:] == (1, shown["second"])
    assert log[2][2] == [5.0, 0.0]
    assert log[-4][1] == 1
    assert log[-4][3] == (episode.rewards["ego"], episode.rewards["second"])


def test_what_is_not_overridden_is_not_called(begin, monkeypatch):
    class Quiet(Observer):
        pass

    def called(*_):
        raise AssertionError("called for nothing")

    for name in ("begin", "observation", "action", "scene", "end"):
        monkeypatch.setattr(Observer, name, called)
    assert drive(begin(observers=(Quiet(),))).outcome is Outcome.SURVIVED


def test_between_two_steps_everything_can_be_seen_and_agents_replaced(begin):
    episode = begin(steps=4)
    assert (episode.steps, episode.acting, episode.result, episode.error) == (0, (0,), None, None)
    assert episode.scene.time_s == 0.0
    before = episode.scene
    assert episode.step() is None
    assert (episode.steps, episode.scene.previous) == (1, before)
    assert episode.terminations == {"ego": False}
    assert set(episode.observations) == set(episode.rewards) == {"ego"}
    episode.agents["ego"] = stand_in = Driver(3.0)
    episode.step()
    episode.step({"ego": np.array([9.0, 0.0])})  # who is not asked has no say
    assert stand_in.steps == 1
    assert episode.step().outcome is Outcome.SURVIVED
    assert stand_in.steps == 2
    with pytest.raises(RuntimeError, match="over"):
        episode.step()
    episode.close()
    assert stand_in.closed == 1
    episode.close()
    assert stand_in.closed == 1
    assert episode.result.steps == 4


def test_it_has_to_be_started(tmp_path):
    episode = Episode(spec(), simulator=ToySimulator(ONE, tmp_path), make_agent=lambda *_: Driver())
    with pytest.raises(RuntimeError, match="started"):
        episode.step()


def test_given_actions_are_recorded_as_those_of_agents(begin):
    asked, given = Teller(), Teller()
    drive(begin(observers=(asked,), agent=Driver(7.0)))
    episode = begin(observers=(given,), agent=Driver(fail_at=1, error=ValueError()))
    while episode.result is None:
        episode.step({"ego": np.array([7.0, 0.0])})
    assert given.log[1:] == asked.log[1:]


def run(tmp_path, simulator=None, agent=None, **options):
    box = BlackBox(tmp_path / "box")
    box.begin(pid=0, trial=0, started=0.0)
    simulator = simulator or ToySimulator(ONE, tmp_path)
    given = {"oracles": ORACLES, "make_agent": lambda *_: agent or Driver(30.0), **options}
    arguments = given.pop("arguments", {})
    return run_episode(spec(given.pop("steps", 600), **arguments), simulator=simulator, box=box, **given)


def test_stepping_by_hand_gives_what_running_gives(begin, tmp_path):
    whole = run(tmp_path)
    assert whole.outcome is Outcome.COLLISION
    box = BlackBox(tmp_path / "other")
    box.begin(pid=0, trial=0, started=0.0)
    nearness = Nearness(box.take_frames)
    simulator = ToySimulator(ONE, tmp_path)
    episode = Episode(
        spec(600), simulator=simulator, make_agent=lambda *_: Driver(30.0), oracles=ORACLES,
        observers=(Recorder(box, simulator), nearness),
    )  # fmt: skip
    episode.start()
    gaps = []
    while episode.result is None:
        gaps.append(nearness.closest.gap_m)  # asking does not change what comes out
        episode.step()
    assert gaps == sorted(gaps, reverse=True)
    assert gaps[0] == pytest.approx(30.0)
    assert (episode.result.digest, episode.result.steps) == (whole.digest, whole.steps)
    assert episode.result.closest == whole.closest
    assert whole.closest.gap_m == 0.0
    assert whole.events is None  # the toy looks for none


def in_a_copy(work):
    """Return the text that a function returns in a fork of this process."""
    receive, send = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.write(send, work().encode())
        finally:
            os._exit(0)
    os.close(send)
    with os.fdopen(receive) as pipe:
        answer = pipe.read()
    os.waitpid(child, 0)
    return answer


def test_a_running_episode_can_be_forked(begin):
    """Both copies end the same, as they would have without."""
    expected = drive(begin(agent=Driver(20.0), steps=200))
    episode = begin(agent=Driver(20.0), steps=200)
    for _ in range(15):
        episode.step()
    theirs = in_a_copy(lambda: json.dumps(drive(episode).to_json()))
    assert json.loads(theirs) == drive(episode).to_json() == expected.to_json()


def brake(step):
    return Disturbance(step, "ahead", "brake", 2.0, 0.1, "ego")


def test_a_new_plan_replaces_what_begins_after_the_next_step_and_is_in_the_specification(tmp_path):
    spec = TrialSpec(0, 1, {}, {}, 9, disturbances=tuple(map(brake, (2, 3, 4, 6))))
    episode = Episode(spec, simulator=ToySimulator(ONE, tmp_path), make_agent=lambda *_: Driver())
    episode.start()
    episode.step()
    episode.step()
    episode.replan([brake(7), brake(5)])
    assert [one.step for one in episode.spec.disturbances] == [2, 3, 5, 7]
    assert [episode.takes_place(brake(step)) for step in (2, 3)] == [True, False]  # the third step has not begun
    assert [one.step for one in drive(episode).disturbances] == [2, 3, 5, 7]
    plain = Episode(TrialSpec(0, 1, {}, {}, 9), simulator=ToySimulator(ONE, tmp_path), make_agent=lambda *_: None)
    with pytest.raises(RuntimeError, match="forks"):
        plain.disturb(brake(3))
    plain.replan([brake(3)])
    assert [one.step for one in plain.spec.disturbances] == [3]
    assert not plain.takes_place(brake(3))


class Failing(Observer):
    def __init__(self, what, error):
        self.what, self.error = what, error

    def _fail(self, what, step=0):
        if what == self.what:
            raise self.error

    def observation(self, number, observation):
        self._fail("observation")

    def scene(self, step, scene, rewards):
        self._fail(f"scene {step}")

    def end(self, result):
        self._fail("end")
        return result


class WithoutMethods:
    """Has the methods of an agent that it is given."""

    def __init__(self, **methods):
        vars(self).update(methods)


async def _waits(*_):
    return 1.0, 0


def _yields(*_):
    yield 1.0, 0


async def _waits_and_yields(*_):
    yield 1.0, 0


@pytest.mark.parametrize("method", ["reset", "act"])
@pytest.mark.parametrize(
    ("runs", "says"),
    [
        (_waits, "is async, so a call does not run it; define it as def "),
        (_yields, "yields, so a call does not run it; define it as def "),
        (_waits_and_yields, "is async, so a call does not run it; define it as def "),
        (lambda: None, "cannot be called with one argument: too many positional arguments; define it as def "),
        (lambda _, info: None, "cannot be called with one argument: missing a required argument: 'info'; define it as"),
    ],
)
def test_agent_whose_method_would_not_run_does_not_start(tmp_path, method, runs, says):
    """A call of a coroutine or generator returns an object: an asynchronous reset did nothing, without a word."""
    methods = {"reset": lambda seed: None, "act": lambda observation: (1.0, 0), method: runs}
    result = run(tmp_path, agent=WithoutMethods(**methods))
    assert (str(result.outcome), result.failure.kind) == ("invalid", "UsageError")  # of every value of the arguments
    assert result.failure.message.startswith(f"its method {method}(")
    assert f") {says}" in result.failure.message


def test_a_decorator_may_add_an_argument_to_a_method_of_an_agent(tmp_path):
    """The signature that functools.wraps copies is that of the inner function, which is not what is called."""

    @functools.wraps(lambda observation, speed: None)
    def act(observation):
        return 1.0, 0

    agent = WithoutMethods(reset=lambda seed: None, act=act)
    assert str(run(tmp_path, agent=agent, steps=2).outcome) == "survived"


@pytest.mark.parametrize(
    ("place", "error", "has_digest"), [("scene 2", OSError("closed"), True), ("end", MemoryError(), False)]
)
def test_error_of_an_observer_is_that_of_an_unknown_agent(tmp_path, place, error, has_digest):
    result = run(tmp_path, observers=[Failing(place, error)], steps=2 + has_digest)
    assert (str(result.outcome), result.steps, result.failure.agent) == ("agent_error", 2, "")
    assert result.failure.kind == type(error).__name__
    assert bool(result.digest) is has_digest


def test_the_error_itself_is_at_hand_until_it_is_closed(begin):
    error = SimulatorError("mine")
    episode = begin(agent=Driver(fail_at=2, error=error))
    assert drive(episode).outcome is Outcome.AGENT_ERROR
    assert episode.error is error
    episode.close()
    assert episode.error is None


def test_a_full_disk_is_nobodys_fault_and_agents_are_closed_all_the_same(tmp_path):
    agent = Driver()
    with pytest.raises(RecorderError):
        run(tmp_path, agent=agent, observers=[Failing("scene 2", RecorderError("full"))])
    assert agent.closed == 1
    with pytest.raises(RecorderError):
        run(tmp_path, agent=agent, observers=[Failing("scene 0", RecorderError("full"))])
    assert agent.closed == 2


def test_an_episode_leaves_the_generators_of_the_process_alone(begin):
    import random

    random.seed(5)
    state = random.getstate()
    drive(begin())
    assert random.getstate() == state


def test_what_is_reported_of_an_exception_is_bounded():
    def fail(message):
        try:
            raise ValueError(message)
        except ValueError as error:
            return failure_of(error, "ego")

    short = fail("no")
    assert (short.message, short.kind) == ("no", "ValueError")
    assert short.traceback.startswith("Traceback") and short.traceback.endswith("ValueError: no\n")  # noqa: PT018
    assert fail("x" * 10_000).message == "x" * 10_000
    long = fail("x" * 5_000_000)
    assert long.message == "x" * 10_000 + "… (4990000 more characters are left out)"
    assert len(long.traceback) < 101_000
    assert long.traceback.startswith("Traceback")
    assert "characters are omitted) …" in long.traceback
    assert long.traceback.endswith("xxx\n")


@pytest.mark.parametrize("arguments", [{"fail_at_step": 5}, {}])
def test_trial_that_empties_sys_modules_is_to_blame_and_has_the_digest_of_its_steps(tmp_path, arguments):
    class Empties(Driver):
        def act(self, observation):
            if self.steps == 3:
                sys.modules.clear()
            return super().act(observation)

    class Imports(Observer):
        def end(self, result):
            import warnings  # as NumPy does where it has not been used before

            assert warnings
            return result

    def facts(result):
        failure = result.failure
        words = f"|{result.outcome}|{failure.message}" if failure else ""
        return f"{result.steps}|{result.digest}|{result.closest}|{are_functions_replaced()}{words}"

    def without_modules():
        record_originals()
        return facts(run(tmp_path, agent=Empties(30.0), **options))

    options = {"arguments": arguments, "steps": 6, "observers": (Imports(),)}
    plain = run(tmp_path, **options)
    found = in_a_copy(without_modules)  # which will not do for anything else
    assert plain.digest
    if not arguments:
        assert found == facts(plain).replace("False", "True")
    else:
        start, _, message = found.rpartition("|")
        expected = facts(plain).replace("False", "True").rpartition("|simulator_error")[0]
        assert start == f"{expected}|agent_error"
        assert message.startswith("the code has emptied sys.modules, upon which this fails: ")


@pytest.mark.parametrize(
    ("methods", "missing"),
    [({"act": lambda observation: (1.0, 0)}, "reset(seed)"), ({"reset": lambda seed: None}, "act(observation)")],
)
def test_agent_without_a_method_does_not_start(tmp_path, methods, missing):
    result = run(tmp_path, agent=WithoutMethods(**methods))
    assert (str(result.outcome), result.failure.message) == (
        "invalid",
        f"it has no method {missing}; define def {missing.replace('(', '(self, ')}",
    )
    assert result.failure.agent == "ego"
