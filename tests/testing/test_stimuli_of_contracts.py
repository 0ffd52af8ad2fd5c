"""What the contract suites do with the plugin that they check, in which order, and with which values."""

from __future__ import annotations

import copy
import math
import random
from collections import Counter
from pathlib import Path
from types import MappingProxyType, SimpleNamespace

import numpy as np
import pytest
from contract_runs import failing, names_of_tests, run_test
from gymnasium import spaces

from crashhunt.disturbances import Drawn
from crashhunt.oracles import Finding, ReportedCollision
from crashhunt.panels import Text
from crashhunt.samplers import Proposal, RandomSampler
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.simulators import FACULTIES, SpeedAndLaneChange
from crashhunt.simulators.toy import ToySimulator
from crashhunt.space import Choice, Range
from crashhunt.testing import (
    AgentContract,
    BackendContract,
    DisturbanceContract,
    ExecutorContract,
    OracleContract,
    SamplerContract,
    SimulatorContract,
    _sampler_contract as _samplers,
    drive,
)
from crashhunt.trial import Collision, Outcome, TrialResult
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
        return {"executor": made[-1], "tmp_path": tmp_path}

    assert failing(ExecutorContract, fixtures) == fails
    if executor is Runs:
        assert all(not one.waiting for one in made if ("close",) not in one.calls)
        assert boxes == [tmp_path / "scratch" / "000001" / "box"] or len(boxes) == 1


def test_executor_contract_waits_until_trials_run_before_it_stops_them(tmp_path, boxes):
    for name, stop in ((CANCELLED, "cancel"), ("test_closing_twice_is_fine", "close"), (STATES, "cancel")):
        executor = Runs()
        run_test(ExecutorContract, name, {"executor": executor, "tmp_path": tmp_path})
        order = [call[0] for call in executor.calls]
        stopped = order.index(stop)
        begun = max(n for n, kind in enumerate(order[:stopped]) if kind == "submit")
        assert "hang_at_step" in executor.calls[begun][1].scenario_arguments
        assert "completed" in order[begun:stopped]
    assert Counter(call[0] for call in executor.calls)["where"] > 2


def test_executor_of_the_contract_has_room_for_two_and_is_closed(tmp_path):
    made = []

    def make(settings, parallel):
        assert settings.scratch.is_dir()
        assert parallel == 2
        assert {setup.default for setup in settings.scenario.arguments.values()} == {0}  # none fails unasked
        made.append(Runs())
        return made[-1]

    given = ExecutorContract.executor._get_wrapped_function()(ExecutorContract(), make, tmp_path)
    assert next(given) is made[0]
    assert made[0].calls == []
    assert list(given) == []
    assert made[0].calls == [("close",)]


# Samplers.

SPACE = {
    ("ego", "speed"): Range(5.0, 30.0),
    ("", "mode"): Choice(("a", "b")),
    ("", "vehicles"): Range(1, 9, integer=True),
}


class Listens(RandomSampler):
    """Writes down requests and results."""

    learns, independent = True, False

    def __init__(self, space):
        super().__init__(space)
        self.calls = []

    def ask(self, number, rng):
        self.calls.append(number)
        return super().ask(number, rng)

    def tell(self, result):
        self.calls.append(result)


def test_results_of_the_sampler_contract_arrive_by_the_rule_of_the_lag_and_some_late():
    sampler = Listens(SPACE)
    turns = _samplers._talk(sampler)
    lag, asked, told = _samplers._LAG, [], []
    for call in sampler.calls:
        if isinstance(call, int):
            asked.append(call)
        else:
            number = call.spec.number
            assert number <= len(asked) - lag, "it has not ended"
            told.append(number)
    assert asked == list(range(len(turns)))
    assert sorted(told) == list(range(len(turns) - lag))
    late = [number for number in told if any(other > number for other in told[: told.index(number)])]
    assert len(late) > 1
    assert 10 < len(turns) < 1000
    for results, _ in turns:
        numbers = [result.spec.number for result in results]
        assert numbers == sorted(numbers)
    assert told == [result.spec.number for results, _ in turns for result in results]
    assert {len(results) for results, _ in turns} >= {0, 1, 2}
    assert not any(results for results, _ in turns[:lag])
    assert turns[lag][0]


def test_results_of_the_sampler_contract_have_the_proposal_and_are_possible():
    turns = _samplers._talk(Listens(SPACE))
    results = [result for found, _ in turns for result in found]
    for result in results:
        spec, proposal = result.spec, turns[result.spec.number][1]
        assert spec.arguments == {"ego": {"speed": proposal.arguments["ego", "speed"]}}
        assert spec.scenario_arguments == {name: proposal.arguments["", name] for name in ("mode", "vehicles")}
        assert 0 < result.steps <= spec.max_steps
        if result.outcome is Outcome.INVALID:
            assert result.danger is None
        else:
            assert 0 <= result.danger <= 1
            assert (result.danger == 1) == (result.outcome is Outcome.COLLISION)
        near = result.closest
        assert math.isfinite(near.gap_m) == math.isfinite(near.time_to_collision_s)
        assert near.gap_m > 0 <= near.time_to_collision_s
        assert math.isinf(near.gap_m) or near.time_to_collision_s < 10
    assert set(Counter(result.outcome for result in results)) == {
        Outcome.SURVIVED, Outcome.COLLISION, Outcome.INVALID, Outcome.FINISHED
    }  # fmt: skip
    near = [result.closest for result in results if math.isfinite(result.closest.gap_m)]
    assert 0.6 < len(near) / len(results) < 0.9
    assert len({one.gap_m for one in near}) > 8
    assert len({one.time_to_collision_s for one in near}) > 4
    assert len({result.danger for result in results}) > 8


def test_result_of_the_sampler_contract_has_seed_parent_and_origin_of_its_proposal():
    arguments = {("ego", "speed"): 7.0}
    plain = _samplers._result(3, Proposal(arguments)).spec
    assert (plain.number, plain.seed, plain.parent, plain.origin) == (3, 3, None, "")
    full = _samplers._result(3, Proposal(arguments, 55, 2, "mutation")).spec
    assert (full.number, full.seed, full.parent, full.origin) == (3, 55, 2, "mutation")
    assert (full.arguments, full.scenario_arguments) == ({"ego": {"speed": 7.0}}, {})


class Asks(RandomSampler):
    """Proposes with changes, which depend on the number alone."""

    changes = staticmethod(lambda number: {})

    def ask(self, number, rng):
        return Proposal(super().ask(number, rng).arguments, **self.changes(number))


def asking(**changes):
    def of(number):
        return {key: value(number) if callable(value) else value for key, value in changes.items()}

    return type("Asking", (Asks,), {"changes": staticmethod(of)})


class Mapping(RandomSampler):
    """Proposes arguments alone."""

    def ask(self, number, rng):
        return dict(super().ask(number, rng).arguments)


class Numpy(RandomSampler):
    """Proposes what cannot be written as JSON."""

    def ask(self, number, rng):
        return {**super().ask(number, rng).arguments, ("", "vehicles"): np.int64(3)}


class WithNumpy(Range):
    """Contains numbers of NumPy too."""

    def contains(self, value):
        return True


class Partly(RandomSampler):
    """Proposes no value for a key, and one for a key that there is not."""

    def ask(self, number, rng):
        found = dict(super().ask(number, rng).arguments)
        found["other", "speed"] = found.pop(("ego", "speed"))
        return found


class Streams(RandomSampler):
    """Learns, and keeps each third trial apart."""

    learns, independent, plain_origin, told = True, False, "plain", 0

    def tell(self, result):
        self.told += 1

    def apart(self, number):
        return number % 3 == 0

    def ask(self, number, rng):
        found = super().ask(number, rng).arguments
        if self.apart(number):
            return Proposal(found, origin="plain")
        return Proposal({**found, ("ego", "speed"): 5.0 + self.told % 20}, origin="guess")


class Moves(Streams):
    """Which trials it keeps apart depends on results."""

    def apart(self, number):
        return (number + self.told) % 3 == 0


class Tuned(Streams):
    """What it keeps apart is not drawn at random."""

    def ask(self, number, rng):
        found = super().ask(number, rng)
        return Proposal({**found.arguments, ("ego", "speed"): 6.0}, origin=found.origin)


class SeedsOfItsOwn(Streams):
    def ask(self, number, rng):
        found = super().ask(number, rng)
        return Proposal(found.arguments, 5, origin=found.origin)


class NeverApart(Streams):
    def apart(self, number):
        return False


class AgentFirst(RandomSampler):
    """Draws the arguments of agents before those of the scenario."""

    def ask(self, number, rng):
        keys = sorted(self.space, reverse=True)
        return Proposal({key: self.space[key].sample(rng) for key in keys})

    independent = True

    def __init__(self, space):
        self.space = space


class LearnsAndIsIndependent(RandomSampler):
    learns = True


COMPLETE, STATED, APART, DRAWS = (
    "test_every_proposal_is_complete_and_inside_the_space",
    "test_it_states_whether_it_learns",
    "test_trials_that_it_keeps_apart_are_plain_random_ones",
    "test_independent_draws_of_the_scenario_do_not_depend_on_who_drives",
)


@pytest.mark.parametrize(
    ("sampler", "fails"),
    [
        (Asks, set()),
        (Mapping, set()),
        (Partly, {COMPLETE}),
        (asking(parent=lambda number: number - 1 if number else None), set()),
        (asking(parent=lambda number: number), {COMPLETE}),
        (asking(parent=lambda number: number + 1), {COMPLETE}),
        (asking(seed=2**31 - 1), set()),
        (asking(seed=2**31), {COMPLETE}),
        (asking(seed=-1), {COMPLETE}),
        (asking(seed=0, origin="x"), set()),
        (asking(origin=3), {COMPLETE}),
        (Streams, set()),
        (Moves, {APART}),
        (Tuned, {APART}),
        (SeedsOfItsOwn, {APART}),
        (NeverApart, {APART}),
        (AgentFirst, {DRAWS}),
        (LearnsAndIsIndependent, {DRAWS}),
        (type("Maybe", (RandomSampler,), {"learns": 0}), {STATED}),
        (type("MaybeAsked", (RandomSampler,), {"only_asked": 1}), {STATED}),
        (type("Asked", (RandomSampler,), {"only_asked": True}), set()),
    ],
)
def test_sampler_contract_knows_what_a_proposal_may_be(sampler, fails):
    assert failing(SamplerContract, lambda: {"make": sampler, "space": SPACE}) == fails


def test_proposal_that_the_ledger_cannot_write_is_refused():
    space = {**SPACE, ("", "vehicles"): WithNumpy(1, 9, integer=True)}
    with pytest.raises(TypeError, match="int64"):
        run_test(SamplerContract, COMPLETE, {"make": Numpy, "space": space})


# Oracles.


def test_evidence_in_the_scenes_of_the_oracle_contract_belongs_to_the_actors():
    for scene in drive():
        rows, points, speeds = scene.roster.index, scene.points, scene.speeds
        for contact in scene.contacts:
            assert contact.collider_speed == speeds[rows[contact.collider]]
            assert contact.victim_speed == speeds[rows[contact.victim]]
            assert contact.lane == scene.lanes[rows[contact.victim]]
        for event in scene.events:
            row = rows[event.agent]
            assert (event.x, event.y, event.speed) == (*points[row], speeds[row])
        assert set(scene.off_road) <= {"ego"}
        assert scene.swept == (scene.previous is not None)
        assert list(scene.headings) == [0.0] * len(rows)
        lengths = {actor.id: actor.length for actor in scene.roster.actors}
        widths = {actor.id: actor.width for actor in scene.roster.actors}
        gap = points[rows["other"]][0] - points[rows["ego"]][0]
        assert bool(scene.contacts) == (-lengths["other"] < gap < lengths["other"])
        aside = points[rows["near"]][1] - points[rows["ego"]][1]
        assert 0 < aside - widths["ego"] / 2 - widths["near"] / 2 < 0.5  # near, and no contact


class NeedsMap(ReportedCollision):
    """Wants to see the map before its first scene."""

    lanes = None

    def see_map(self, lanes):
        self.lanes = lanes

    def check(self, scene, agents):
        assert self.lanes is not None
        return super().check(scene, agents)


class NeedsLanes(NeedsMap):
    def check(self, scene, agents):
        assert self.lanes
        return super().check(scene, agents)


class Draws(ReportedCollision):
    """Uses the global generator of NumPy."""

    def check(self, scene, agents):
        return super().check(scene, agents) if np.random.random() < 0.5 else []  # noqa: NPY002


class Touches(ReportedCollision):
    """Changes what a scene has."""

    name, attribute, value = "touches", "", None

    def check(self, scene, agents):
        if self.attribute == "data":
            scene.speeds[: len(scene.roster) > 0] = [99.0] * (len(scene.roster) > 0)
        else:
            setattr(scene, self.attribute, self.value)
        return super().check(scene, agents)


class Own(ReportedCollision):
    """Adds an outcome."""

    outcomes = MappingProxyType({"tailgating": "traffic event"})

    def check(self, scene, agents):
        if "ego" not in agents or not scene.off_road:
            return []
        Outcome.own("tailgating", "traffic event")
        return [Finding(Outcome("tailgating"), event=Event("tailgating", "ego", "too near"))]


class Both(Own):
    """Gives two pieces of evidence."""

    def check(self, scene, agents):
        collision = Collision(agent="ego", collider="ego", victim="other", role="striker", lane="", seen_by=("both",))
        return [Finding(found.outcome, collision, found.event) for found in super().check(scene, agents)]


class Unproven(Own):
    """Gives no evidence."""

    def check(self, scene, agents):
        return [Finding(found.outcome) for found in super().check(scene, agents)]


class Undeclared(Own):
    outcomes = MappingProxyType({"other": "traffic event"})


class NoTrafficOutcome(Own):
    """Finds what is neither a crash nor an event."""

    def check(self, scene, agents):
        return [Finding(Outcome.HANG, event=found.event) for found in super().check(scene, agents)]


SAME, LEFT, EVIDENCE, BEARS = (
    "test_the_same_scenes_give_the_same_findings",
    "test_it_leaves_scenes_as_they_are",
    "test_it_finds_what_agents_do_and_gives_the_evidence",
    "test_it_bears_agents_that_are_not_there_and_empty_roads",
)


@pytest.mark.parametrize(
    ("oracle", "fails"),
    [
        (NeedsMap, set()),
        (NeedsLanes, {BEARS}),
        (Draws, {SAME}),
        (Own, set()),
        (Both, {EVIDENCE}),
        (Unproven, {EVIDENCE}),
        (Undeclared, {EVIDENCE}),
        (NoTrafficOutcome, {EVIDENCE}),
        (type("Data", (Touches,), {"attribute": "data"}), {LEFT}),
        (type("Lanes", (Touches,), {"attribute": "lanes", "value": ()}), {LEFT}),
        (type("Events", (Touches,), {"attribute": "events", "value": ()}), {LEFT}),
        (type("OffRoad", (Touches,), {"attribute": "off_road", "value": ()}), {LEFT}),
    ],
)
def test_oracle_contract_knows_evidence_and_changes(oracle, fails):
    assert failing(OracleContract, lambda: {"make": oracle}) == fails


# Suites are as deterministic as what they check.


def test_verdicts_of_contracts_do_not_depend_on_global_generators():
    found = []

    class Listening(ReportedCollision):
        def check(self, scene, agents):
            found[-1].append((random.random(), np.random.random()))  # noqa: NPY002
            return super().check(scene, agents)

    class Model:
        what = "brake"

        def draw(self, rng):
            found[-1].append((random.random(), np.random.random()))  # noqa: NPY002
            return Drawn("ahead", 1.0, 1.0)

        def log_likelihood(self, drawn):
            return 0.0

    for suite, kind, name in (
        (OracleContract, Listening, SAME),
        (DisturbanceContract, Model, "test_the_generator_alone_decides"),
    ):
        found.clear()
        for seed in (8, 9):
            random.seed(seed)
            np.random.seed(seed)  # noqa: NPY002
            found.append([])
            run_test(suite, name, {"make": kind})
        assert found[0] == found[1]
        runs = 2 if suite is OracleContract else 3
        first, second = found[0][0], found[0][len(found[0]) // runs]
        assert first[0] != second[0]  # each run is seeded otherwise
        assert first[1] != second[1]


class Rounded:
    """A disturbance model whose only draw is a little likelier than certain, by rounding."""

    what = "brake"

    def draw(self, rng):
        return Drawn("ahead", 1.0, 1.0)

    def log_likelihood(self, drawn):
        return 4e-10


class Several(Rounded):
    """Two draws, which are certain each."""

    def draw(self, rng):
        return Drawn("ahead", float(rng.random() < 0.999), 1.0)

    def log_likelihood(self, drawn):
        return math.log(1e-4 if drawn.how_strong < 1 else 0.9999)


@pytest.mark.parametrize(
    ("model", "fails"), [(Rounded, set()), (Several, {"test_the_likelihood_is_that_of_the_draws"})]
)
def test_disturbance_contract_accepts_rounding_and_finds_a_rare_excess(model, fails):
    assert failing(DisturbanceContract, lambda: {"make": model}) == fails


# Agents.


class Closing:
    """Writes down what is done with each instance."""

    def __init__(self, made):
        self.calls = []
        made.append(self.calls)

    def reset(self, seed):
        self.calls.append("reset")

    def act(self, observation):
        self.calls.append("act")
        return (5.0, 0)

    def close(self):
        self.calls.append("close")


OBSERVATIONS = [np.full((2, 2), 1.0 + n) for n in range(4)]


def test_agents_are_closed_before_a_reset_after_it_and_after_an_action():
    made = []
    name = "test_it_can_be_closed_whenever_a_trial_may_end"
    run_test(AgentContract, name, {"make": lambda: Closing(made), "observations": OBSERVATIONS})
    assert made == [["close"], ["reset", "close"], ["reset", "act", "close"], ["reset", "act"]]


@pytest.mark.parametrize("name", names_of_tests(AgentContract))
def test_no_agent_acts_before_its_reset(name):
    made = []
    fixtures = {"make": lambda: Closing(made), "form": SpeedAndLaneChange(), "observations": OBSERVATIONS}
    run_test(AgentContract, name, fixtures)
    for calls in made:
        assert "act" not in calls or calls.index("reset") < calls.index("act")
    if "closed" not in name and "libraries" not in name:
        assert all(calls.count("act") >= len(OBSERVATIONS) for calls in made)


class Steady:
    speed = 5.0

    def reset(self, seed):
        pass

    def act(self, observation):
        return (self.speed, 0)


class Largest(Steady):
    """Remembers the largest seed."""

    def reset(self, seed):
        self.speed = max(self.speed, 5.0 + seed)


class Instances(Steady):
    """Each instance drives otherwise."""

    made = 0

    def __init__(self):
        type(self).made += 1
        self.speed = 5.0 + self.made


class Shows(Steady):
    def panels(self):
        return {"speed": Text("5 m/s"), "plan": Text("ahead")}


class CannotClose(Steady):
    def close(self):
        assert "seen" in vars(self)

    def reset(self, seed):
        self.seen = True


class Slashed(Steady):
    libraries = ("a/b",)


class Libraries(Steady):
    libraries = ("numpy", "os.path")


ACTS, LIBRARIES, PANELS, CLOSED = (
    "test_it_acts_inside_its_space_and_by_its_seed_alone",
    "test_the_libraries_that_it_needs_are_names",
    "test_panels_are_pictures_and_change_nothing",
    "test_it_can_be_closed_whenever_a_trial_may_end",
)


@pytest.mark.parametrize(
    ("agent", "fails"),
    [
        (Steady, set()),
        (Largest, {ACTS}),
        (Instances, {ACTS, PANELS}),
        (Shows, set()),
        (CannotClose, {CLOSED}),
        (Slashed, {LIBRARIES}),
        (Libraries, set()),
    ],
)
def test_agent_contract_knows_what_is_optional(agent, fails):
    fixtures = {"make": agent, "form": SpeedAndLaneChange(), "observations": OBSERVATIONS}
    assert failing(AgentContract, lambda: fixtures) == fails
