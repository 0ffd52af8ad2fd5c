"""The contract suites of samplers, oracles, disturbances and agents: what they ask, and what they find broken."""

from __future__ import annotations

import math
import random
from collections import Counter
from types import MappingProxyType

import numpy as np
import pytest
from contract_runs import failing, names_of_tests, run_test

from crashhunt.disturbances import Drawn
from crashhunt.oracles import Finding, Overlap, ReportedCollision
from crashhunt.panels import Text
from crashhunt.samplers import Proposal, RandomSampler
from crashhunt.simulators import SpeedAndLaneChange
from crashhunt.space import Choice, Range
from crashhunt.testing import (
    AgentContract,
    DisturbanceContract,
    OracleContract,
    SamplerContract,
    _sampler_contract as _samplers,
    drive,
)
from crashhunt.trial import Collision, Outcome
from crashhunt.world import Event

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


class Outside(RandomSampler):
    def ask(self, number, rng):
        return Proposal({**super().ask(number, rng).arguments, ("ego", "speed"): 31.0})


class Counts(RandomSampler):
    """Keeps a state."""

    calls = 0

    def ask(self, number, rng):
        self.calls += 1
        return Proposal({**super().ask(number, rng).arguments, ("ego", "speed"): 5.0 + self.calls % 20})


class Learns(RandomSampler):
    """Learns, but states that it does not."""

    seen = 0

    def tell(self, result):
        self.seen += 1

    def ask(self, number, rng):
        return Proposal({**super().ask(number, rng).arguments, ("ego", "speed"): 5.0 + self.seen % 20})


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


COMPLETE, STATED, APART, DRAWS, NUMBER, AGAIN, WHATEVER = (
    "test_every_proposal_is_complete_and_inside_the_space",
    "test_it_states_whether_it_learns",
    "test_trials_that_it_keeps_apart_are_plain_random_ones",
    "test_independent_draws_of_the_scenario_do_not_depend_on_who_drives",
    "test_a_proposal_depends_on_number_and_generator_alone",
    "test_one_that_is_made_again_and_reported_the_same_proposes_the_same",
    "test_one_that_does_not_learn_proposes_the_same_whatever_it_is_reported",
)


@pytest.mark.parametrize(
    ("sampler", "fails"),
    [
        (Asks, set()),
        (Outside, {COMPLETE}),
        (Counts, {NUMBER, AGAIN}),
        (Learns, {WHATEVER}),
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
def test_sampler_contract_finds_what_is_broken_and_nothing_else(sampler, fails):
    assert failing(SamplerContract, lambda: {"make": sampler, "space": SPACE}) == fails


def test_proposal_that_the_ledger_cannot_write_is_refused():
    space = {**SPACE, ("", "vehicles"): WithNumpy(1, 9, integer=True)}
    with pytest.raises(TypeError, match="int64"):
        run_test(SamplerContract, COMPLETE, {"make": Numpy, "space": space})


# Oracles.


def test_scenes_of_the_oracle_contract_have_what_their_description_states():
    scenes = []
    for number, scene in enumerate(drive()):
        scenes.append(scene)
        rows = scene.roster.index
        assert [*rows] == ["ego", "second", "other", "near"]
        ego, second, other, near = (scene.points[rows[name]] for name in rows)
        assert scene.speeds[rows["second"]] == 0.0
        assert tuple(second) == (-30.0, 0.0)
        assert (bool(scene.contacts)) == (abs(other[0] - ego[0]) < 4.5)
        assert all((contact.collider, contact.victim) == ("ego", "other") for contact in scene.contacts)
        assert (scene.off_road == ("ego",)) == (number > 55)
        assert [event.kind for event in scene.events] == (["red_light"] if number == 20 else [])
        assert [(event.x, event.y, event.speed) for event in scene.events] == [(*ego, scene.speeds[0])] * (number == 20)
        assert scene.previous is (scenes[number - 1] if number else None)
        assert scene.swept == (number > 0)
        for contact in scene.contacts:
            assert (contact.collider_speed, contact.victim_speed) == (
                scene.speeds[rows["ego"]],
                scene.speeds[rows["other"]],
            )
        if number:
            moved = np.array(scene.points) - scenes[number - 1].points
            assert moved[:, 0] == pytest.approx(np.array(scene.speeds) * 0.1)
        assert near[1] - ego[1] == pytest.approx(2.2)
    assert [scene.time_s for scene in scenes] == pytest.approx([n / 10 for n in range(60)])
    assert any(scene.contacts for scene in scenes)
    assert any(abs(scene.points[0][0] - scene.points[3][0]) < 1 for scene in scenes)


class Moody(ReportedCollision):
    """Uses a global random generator."""

    def check(self, scene, agents):
        return super().check(scene, agents) if random.random() < 0.5 else []


class Loud(ReportedCollision):
    """Finds what no agent does."""

    def check(self, scene, agents):
        return [Finding("red_light", event=Event("red_light", "another", ""))]


class Unnamed(Overlap):
    name = ""


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


SAME, LEFT, EVIDENCE, BEARS, NAMED = (
    "test_the_same_scenes_give_the_same_findings",
    "test_it_leaves_scenes_as_they_are",
    "test_it_finds_what_agents_do_and_gives_the_evidence",
    "test_it_bears_agents_that_are_not_there_and_empty_roads",
    "test_it_has_a_name_and_states_which_outcomes_it_brings",
)


@pytest.mark.parametrize(
    ("oracle", "fails"),
    [
        (ReportedCollision, set()),
        (NeedsMap, set()),
        (Moody, {SAME}),
        (Loud, {EVIDENCE, BEARS}),
        (Unnamed, {NAMED}),
        (NeedsLanes, {BEARS}),
        (Draws, {SAME}),
        (Own, set()),
        (Both, {EVIDENCE}),
        (Unproven, {EVIDENCE}),
        (Undeclared, {EVIDENCE}),
        (NoTrafficOutcome, {EVIDENCE}),
        (type("Contacts", (Touches,), {"attribute": "contacts", "value": ()}), {LEFT}),
        (type("Data", (Touches,), {"attribute": "data"}), {LEFT}),
        (type("Lanes", (Touches,), {"attribute": "lanes", "value": ()}), {LEFT}),
        (type("Events", (Touches,), {"attribute": "events", "value": ()}), {LEFT}),
        (type("OffRoad", (Touches,), {"attribute": "off_road", "value": ()}), {LEFT}),
    ],
)
def test_oracle_contract_finds_what_is_broken_and_nothing_else(oracle, fails):
    assert failing(OracleContract, lambda: {"make": oracle}) == fails


# Models of disturbances.


class Model:
    """A disturbance model whose two draws have probability 0.3 and 0.7."""

    what = "brake"
    known = (0.3, 0.7)

    def draw(self, rng):
        return Drawn("ahead", 2.0 if rng.random() < 0.3 else 4.0, 1.0)

    def log_likelihood(self, drawn):
        return math.log(self.known[drawn.how_strong > 3])


class Unlikely(Model):
    known = (0.2, 0.6)


class TooLikely(Model):
    known = (0.35, 0.7)


class Certain(Model):
    known = (0.0, 1.0)

    def draw(self, rng):
        return Drawn("ahead", 4.0, 1.0)


class Endless(Model):
    def draw(self, rng):
        return Drawn("ahead", super().draw(rng).how_strong, math.inf)


class Global(Model):
    def draw(self, rng):
        return Drawn("ahead", 2.0 if random.random() < 0.3 else 4.0, 1.0)


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


LIKELY, DRAWN, ALONE = (
    "test_the_likelihood_is_that_of_the_draws",
    "test_what_is_drawn_is_a_disturbance",
    "test_the_generator_alone_decides",
)


@pytest.mark.parametrize(
    ("model", "fails"),
    [
        (Model, set()),
        (Certain, set()),
        (Unlikely, {LIKELY}),
        (TooLikely, {LIKELY}),
        (Endless, {DRAWN}),
        (Global, {ALONE}),
        (Rounded, set()),
        (Several, {LIKELY}),
    ],
)
def test_disturbance_contract_finds_what_is_broken(model, fails):
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


class Scribbles(Steady):
    def act(self, observation):
        observation[:] = 0
        return super().act(observation)


class Paints(Steady):
    """Its panels change what it does."""

    def panels(self):
        self.speed += 1
        return {}


class OneText(Steady):
    libraries = "numpy"


ACTS, LIBRARIES, PANELS, CLOSED, SHOWN = (
    "test_it_acts_inside_its_space_and_by_its_seed_alone",
    "test_the_libraries_that_it_needs_are_names",
    "test_panels_are_pictures_and_change_nothing",
    "test_it_can_be_closed_whenever_a_trial_may_end",
    "test_it_leaves_what_it_is_shown_alone",
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
        (Scribbles, {SHOWN}),
        (Paints, {PANELS}),
        (OneText, {LIBRARIES}),
    ],
)
def test_agent_contract_finds_what_is_broken_and_nothing_else(agent, fails):
    def fixtures():
        observations = [observation.copy() for observation in OBSERVATIONS]
        return {"make": agent, "form": SpeedAndLaneChange(), "observations": observations}

    assert failing(AgentContract, fixtures) == fails


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
