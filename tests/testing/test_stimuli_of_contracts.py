"""What the contract suites of simulators and executors do with the plugin that they check, and in which order."""

from __future__ import annotations

import copy
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from contract_runs import failing, names_of_tests, run_test
from gymnasium import spaces

from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.simulators import FACULTIES
from crashhunt.simulators.toy import ToySimulator
from crashhunt.testing import (
    AgentContract,
    BackendContract,
    DisturbanceContract,
    ExecutorContract,
    OracleContract,
    SamplerContract,
    SimulatorContract,
)
from crashhunt.trial import Outcome, TrialResult
from crashhunt.world import Event

SUITES = [
    (AgentContract, "make", "form", "observations"),
    (BackendContract, "name", "scenario"),
    (DisturbanceContract, "make"),
    (ExecutorContract, "make"),
    (OracleContract, "make"),
    (SamplerContract, "make", "space"),
    (SimulatorContract, "make"),
]


@pytest.mark.parametrize(("suite", "name"), [(suite, name) for suite, *names in SUITES for name in names])
def test_suite_without_its_fixture_names_the_fixture(suite, name):
    with pytest.raises(NotImplementedError, match=f"must define the fixture '{name}'"):
        getattr(suite, name)._get_wrapped_function()(suite())


# Simulators. The toy simulator writes down each call.


class Watched(ToySimulator):
    """Writes down what a contract suite does with it."""

    notices, setup_steps = ("a line",), 3

    def __init__(self, scenario, folder, calls):
        self.calls = calls
        super().__init__(scenario, folder)
        self.actions = {agent: self._watched(agent, form) for agent, form in self.actions.items()}

    def _watched(self, agent, form):
        def seed(number):
            self.calls.append(("seed", agent))
            return form.space.seed(number)

        def sample():
            self.calls.append(("sample", agent))
            return form.space.sample()

        return SimpleNamespace(encode=form.encode, space=SimpleNamespace(seed=seed, sample=sample))

    def reset(self, *, seed, options=None):
        self.calls.append(("reset", seed))
        return super().reset(seed=seed, options=options)

    def reseed(self, seed):
        self.calls.append(("reseed", seed))
        super().reseed(seed)

    def step(self, actions):
        self.calls.append(("step",))
        return super().step(actions)

    def tidy(self):
        self.calls.append(("tidy",))

    def close(self):
        self.calls.append(("close",))


@pytest.mark.parametrize("name", names_of_tests(SimulatorContract))
def test_each_simulator_is_reset_before_its_use_and_closed_after_it(name):
    made = []

    def make():
        made.append([])
        return Watched(
            Scenario(simulator="toy", agents=dict.fromkeys(("ego", "second"), AgentSetup())), Path(), made[-1]
        )

    run_test(SimulatorContract, name, {"make": make})
    assert made
    for calls in made:
        assert calls[0][0] in ("reset", "tidy")
        assert calls[-1] == ("close",)
        assert calls.count(("close",)) == (2 if "closing_twice" in name else 1)
        seeded, running = set(), False
        for kind, *words in calls:
            if kind == "reset":
                seeded, running = set(), True
            elif kind == "seed":
                seeded.add(words[0])
            elif kind == "sample":
                assert words[0] in seeded, "an action is drawn at random"
            elif kind != "tidy":
                assert running
    order = ["".join(kind[0] for kind, *_ in calls if kind in ("reset", "tidy", "step")) for calls in made]
    if "tidying" in name:
        assert [one.replace("s", "") for one in order] == ["rtr", "tr"]
    if "braking" in name:  # each agent in an episode of its own
        assert order == ["rrsssrsss"]
    if "another_seed" in name:
        first, again, other = (call[1] for calls in made for call in calls if call[0] == "reseed")
        assert first == again != other


BARE = type("Bare", (ToySimulator,), {name: None for kind in FACULTIES for name in vars(kind) if name[0] != "_"})


class Bare(BARE):
    """Has no optional capability."""

    @property
    def observation_names(self):
        return None

    @observation_names.setter
    def observation_names(self, names):
        pass


class CannotReseed(ToySimulator):
    """States why it cannot be re-seeded."""

    why_no_reseeding = "its generators cannot be reached"
    reseed = None

    def __init__(self, *words):
        super().__init__(*words)

        def reseed(seed):
            pytest.fail("it has stated that it cannot")

        self.reseed = reseed


class Forgets(ToySimulator):
    """Another seed has another effect each time."""

    count, late_s = 0, 0.0

    def reset(self, *, seed, options=None):
        self.late_s = 0.0
        return super().reset(seed=seed, options=options)

    def reseed(self, seed):
        self.count += 1
        self.late_s = 0.001 * self.count

    def scene(self):
        found = copy.copy(super().scene())
        found.time_s += self.late_s
        return found


class LateEvent(ToySimulator):
    """Has an event only after steps, which it does not announce."""

    def step(self, actions):
        found = super().step(actions)
        self.scene().events = (Event("red_light", "ego", "ego ran the red light"),)
        return found


class WrongKind(ToySimulator):
    """Announces a crash as a type of event."""

    reported_events = ("collision",)


class BrakesBadly(ToySimulator):
    def full_braking(self, agent):
        found = super().full_braking(agent)
        return type(found)(found.action, "", found.deceleration) if agent == "second" else found


class CannotBrake(ToySimulator):
    """Has no braking action for one of its agents, which is allowed."""

    def full_braking(self, agent):
        return None if agent == "second" else super().full_braking(agent)


RESEEDED, EVENTS, BRAKING = (
    "test_another_seed_within_an_episode_changes_only_what_follows",
    "test_only_events_that_it_looks_for_happen",
    "test_braking_as_hard_as_it_can_is_an_action_that_does_not_speed_up",
)


@pytest.mark.parametrize(
    ("simulator", "fails"),
    [
        (Bare, set()),
        (CannotReseed, set()),
        (Forgets, {RESEEDED}),
        (LateEvent, {EVENTS}),
        (WrongKind, {EVENTS}),
        (BrakesBadly, {BRAKING}),
        (CannotBrake, set()),
    ],
)
def test_simulator_contract_knows_what_is_optional(simulator, fails, tmp_path):
    scenario = Scenario(simulator="toy", agents={"ego": AgentSetup(), "second": AgentSetup(action="meta")})
    assert failing(SimulatorContract, lambda: {"make": lambda: simulator(scenario, tmp_path)}) == fails


class Structured:
    """A simulator with observations of two parts, as it is seen by the test of structured observations."""

    space = spaces.Dict({"gap": spaces.Box(0.0, 9.0, (2,)), "lane": spaces.Discrete(3)})

    def __init__(self, observation, **members):
        self.shown_spaces, self.observation = {"ego": self.space}, np.array(observation, np.float32)
        self.closed, self.restored = 0, []
        vars(self).update(members)

    def reset(self, *, seed):
        return {"ego": self.observation, "plain": self.observation}, {}

    def close(self):
        self.closed += 1


@pytest.mark.parametrize(
    ("simulator", "kept"),
    [
        (Structured([1.0, 2.0, 0.0, 1.0, 0.0]), True),
        (Structured([1.0, 2.0, 0.0, 1.0, 1.0]), False),  # one-hot it is not
        (Structured([1.0, 2.0, 3.0], restore_observation=lambda agent, array: {"gap": array}), True),
        (Structured([1.0, 2.0, 0.0, 1.0, 0.0], restore_observation=lambda agent, array: None), False),
        (Structured([1.0], shown_spaces={}), True),
        (Structured([1.0], shown_spaces=None), True),
        (Structured([1.0], shown_spaces={"other": Structured.space}), False),
    ],
)
def test_structured_observation_must_be_the_recorded_one(simulator, kept):
    name = "test_structured_observations_can_be_had_back"
    if kept:
        run_test(SimulatorContract, name, {"make": lambda: simulator})
        assert simulator.closed == 1
    else:
        with pytest.raises(AssertionError):
            run_test(SimulatorContract, name, {"make": lambda: simulator})


# Executors: one that runs nothing and knows what the trials would do.


class Runs:
    """Answers as a pool would: hanging trials first run, then end by the time limit."""

    capacity = 2

    def __init__(self):
        self.calls, self.waiting, self.looks, self.noted = [], [], 0, False

    def outcome(self, spec):
        switches = dict(spec.scenario_arguments)
        name, step = switches.popitem() if switches else ("", spec.max_steps + 1)
        outcomes = {
            "hang_at_step": Outcome.HANG, "fail_at_step": Outcome.SIMULATOR_ERROR,
            "exit_at_step": Outcome.PROCESS_DIED, "segfault_at_step": Outcome.PROCESS_DIED,
        }  # fmt: skip
        return outcomes.get(name, Outcome.SURVIVED), step - 1

    def result(self, spec):
        outcome, steps = self.outcome(spec)
        return TrialResult(spec, outcome, steps=steps, wall_s=0.1, digest="d", kept=outcome is not Outcome.SURVIVED)

    def submit(self, spec):
        assert spec.number not in [call[1].number for call in self.calls if call[0] == "submit"], (
            "as the protocol states"
        )
        self.calls.append(("submit", spec))
        self.waiting.append(spec)

    def completed(self, timeout_s):
        self.calls.append(("completed", timeout_s))
        self.looks += 1
        assert self.looks < 50, "nothing more comes"
        running = self.waiting[: self.capacity]
        ended = [spec for spec in running if self.looks > 20 or "hang_at_step" not in spec.scenario_arguments]
        self.waiting = [spec for spec in self.waiting if spec not in ended]
        yield from map(self.result, ended)

    def cancel(self, *, above=-1):
        self.calls.append(("cancel", above))
        self.waiting = [spec for spec in self.waiting if spec.number <= above]

    def where(self):
        self.calls.append(("where",))
        return {spec.number: SimpleNamespace(trial=spec.number, step=4) for spec in self.waiting if self.looks}

    def notes(self):
        found, self.noted = [] if self.noted else ["a note"], True
        return found

    def close(self):
        self.calls.append(("close",))


class OnNodes(Runs):
    """The figures of its nodes come late."""

    asked = 0

    def nodes(self):
        self.asked += 1
        ended = sum(call[0] == "submit" for call in self.calls) - len(self.waiting) - (self.asked < 3)
        return [
            SimpleNamespace(name="a", parallel=1, trials=ended, rate_per_s=0.0),
            SimpleNamespace(name="b", parallel=1, trials=0, rate_per_s=2.0),
        ]


class Unnamed(OnNodes):
    def nodes(self):
        return [SimpleNamespace(**{**vars(node), "name": ""}) for node in super().nodes()]


class Larger(OnNodes):
    capacity = 3


class Twice(Runs):
    def completed(self, timeout_s):
        for result in super().completed(timeout_s):
            yield result
            yield result


class OtherSeed(Runs):
    def result(self, spec):
        from dataclasses import replace

        return replace(super().result(spec), spec=replace(spec, seed=77))


class Survives(Runs):
    def outcome(self, spec):
        return Outcome.SURVIVED, 30


class Early(Runs):
    def outcome(self, spec):
        outcome, steps = super().outcome(spec)
        return outcome, steps - 1


class Keeps(Runs):
    """Cancels nothing."""

    def cancel(self, *, above=-1):
        pass


class Elsewhere(Runs):
    def where(self):
        return {number: SimpleNamespace(trial=9, step=4) for number in super().where()}


class Beyond(Runs):
    def where(self):
        return {number: SimpleNamespace(trial=number, step=6) for number in super().where()}


class Ahead(Runs):
    """Reports a trial before it was submitted."""

    def where(self):
        return super().where() or {0: SimpleNamespace(trial=0, step=0)}


class Repeats(Runs):
    def notes(self):
        return ["a note"]


class Lines(Runs):
    def notes(self):
        return [note + "\nmore" for note in super().notes()]


ONCE, COSTS, CANCELLED, STATES, REPORTED, BOX = (
    "test_every_trial_comes_back_once",
    "test_a_failure_costs_its_own_trial_only",
    "test_cancelled_trials_do_not_come_back",
    "test_it_states_how_much_it_runs_and_where_that_is",
    "test_what_is_reported_is_reported_once",
    "test_what_is_kept_has_its_black_box_here",
)


@pytest.fixture
def boxes(monkeypatch):
    """Replace black boxes: each has the steps of its trial."""
    from crashhunt.testing import _executor_contract as _executors

    read = []
    monkeypatch.setattr(_executors, "read_black_box", lambda path: read.append(path) or path)
    monkeypatch.setattr(_executors, "Recording", lambda path: SimpleNamespace(steps=9))
    return read


@pytest.mark.parametrize(
    ("executor", "fails"),
    [
        (Runs, set()),
        (OnNodes, set()),
        (Unnamed, {ONCE}),
        (Larger, {ONCE, STATES}),
        (Twice, {ONCE, COSTS, CANCELLED, REPORTED, BOX}),
        (OtherSeed, {ONCE}),
        (Survives, {COSTS, BOX}),
        (Early, {COSTS, BOX}),
        (Keeps, {CANCELLED, STATES}),
        (Elsewhere, {STATES}),
        (Beyond, {STATES}),
        (Ahead, {STATES}),
        (Repeats, {REPORTED}),
        (Lines, {REPORTED}),
    ],
)
def test_executor_contract_finds_what_is_broken(executor, fails, boxes, tmp_path):
    made = []

    def fixtures():
        made.append(executor())
        return {"executor": made[-1], "patient": made[-1], "tmp_path": tmp_path}

    assert failing(ExecutorContract, fixtures) == fails
    if executor is Runs:
        assert all(not one.waiting for one in made if ("close",) not in one.calls)
        assert boxes == [tmp_path / "scratch" / "000001" / "box"] or len(boxes) == 1


def test_executor_contract_waits_until_trials_run_before_it_stops_them(tmp_path, boxes):
    for name, stop in ((CANCELLED, "cancel"), ("test_closing_twice_is_fine", "close"), (STATES, "cancel")):
        executor = Runs()
        run_test(ExecutorContract, name, {"executor": executor, "patient": executor})
        order = [call[0] for call in executor.calls]
        stopped = order.index(stop)
        begun = max(n for n, kind in enumerate(order[:stopped]) if kind == "submit")
        assert "hang_at_step" in executor.calls[begun][1].scenario_arguments
        assert "completed" in order[begun:stopped]
    assert Counter(call[0] for call in executor.calls)["where"] > 2


@pytest.mark.parametrize(("fixture", "timeout_s"), [("executor", 2.0), ("patient", 300.0)])
def test_executor_of_the_contract_has_room_for_two_and_is_closed(fixture, timeout_s, tmp_path):
    made = []

    def make(settings, parallel):
        assert settings.scratch.is_dir()
        assert (parallel, settings.timeout_s) == (2, timeout_s)
        assert {setup.default for setup in settings.scenario.arguments.values()} == {0}  # none fails unasked
        made.append(Runs())
        return made[-1]

    given = getattr(ExecutorContract, fixture)._get_wrapped_function()(ExecutorContract(), make, tmp_path)
    assert next(given) is made[0]
    assert made[0].calls == []
    assert list(given) == []
    assert made[0].calls == [("close",)]
