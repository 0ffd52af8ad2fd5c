"""The contract suite of simulators fails for what breaks a promise, and escapes are checked by two runs."""

from __future__ import annotations

import copy
import itertools
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from contract_runs import failing

from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.simulators import SpeedAndLaneChange
from crashhunt.simulators.toy import ToySimulator
from crashhunt.testing import (
    SimulatorContract,
    _last_avoidable_step_check as _last_avoidable_step,
    check_escape,
)
from crashhunt.testing._last_avoidable_step_check import EscapeCheck, RecordedThenBrakes
from crashhunt.world import Event, Lane


class SameTraffic(ToySimulator):
    def reset(self, *, seed, options=None):
        return super().reset(seed=1, options=options)


class Remembers(ToySimulator):
    """An episode depends on the number of episodes before it."""

    episodes = 0

    def reset(self, *, seed, options=None):
        self.episodes += 1
        return super().reset(seed=seed + self.episodes, options=options)


class OwnInstance(ToySimulator):
    """An episode depends on the instance."""

    numbers = itertools.count()

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.mine = next(self.numbers)

    def reset(self, *, seed, options=None):
        return super().reset(seed=seed + self.mine, options=options)


class Errs(ToySimulator):
    """A vehicle that is disturbed at the end of an episode is disturbed in the next."""

    def reset(self, *, seed, options=None):
        disturbed = getattr(self, "_disturbed", {})
        found = super().reset(seed=seed, options=options)
        self._disturbed = disturbed
        return found

    def disturb(self, vehicle, disturbance):
        return SimpleNamespace(how_strong=1.0, keep=lambda: self._disturbed.update({vehicle: 0.0}), end=lambda: None)


class Lasts(ToySimulator):
    """A disturbance that ends early leaves something behind for the next episode."""

    late_s = 0.0

    def disturb(self, vehicle, disturbance):
        def end():
            self.late_s += 1.0

        return SimpleNamespace(how_strong=1.0, keep=lambda: None, end=end)

    def scene(self):
        found = copy.copy(super().scene())
        found.time_s += self.late_s
        return found


class Declines(ToySimulator):
    """Disturbs no vehicle, which is allowed."""

    def disturb(self, vehicle, disturbance):
        return None


class Slow(ToySimulator):
    """Its scenes are later than its step length states."""

    def scene(self):
        found = copy.copy(super().scene())
        found.time_s *= 1.01
        return found


class Partial(ToySimulator):
    """Offers half of a faculty."""

    resolve_target = None


class Half(ToySimulator):
    """Has a lane twice."""

    def lanes(self):
        return [*super().lanes(), *super().lanes()]


class Accelerates(ToySimulator):
    """Its braking is no braking."""

    def full_braking(self, agent):
        found = super().full_braking(agent)
        return (
            found if agent != "ego" else type(found)(action=(40.0, 0), how=found.how, deceleration=found.deceleration)
        )


class Untold(ToySimulator):
    """Has events that it does not announce."""

    def scene(self):
        found = super().scene()
        found.events = (Event("red_light", "ego", "ego ran the red light"),)
        return found


class Leaves(ToySimulator):
    """Reports an agent that takes no part any more."""

    def step(self, actions):
        observations, rewards, *more = super().step(actions)
        return (observations, {**rewards, "gone": 0.0}, *more)


class Live(ToySimulator):
    """Writes into what it has handed out."""

    def step(self, actions):
        found = super().step(actions)
        self.shown["ego"][:] = 0.0
        return found

    def reset(self, *, seed, options=None):
        observations, infos = super().reset(seed=seed, options=options)
        self.shown = {agent: observation.copy() for agent, observation in observations.items()}
        return self.shown, infos


class TwoNames(ToySimulator):
    """Names two columns alike."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        first, _, *others = self.observation_names
        self.observation_names = (first, first, *others)


class TooFewNames(ToySimulator):
    """Names all columns but one."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.observation_names = self.observation_names[1:]


class Talks(ToySimulator):
    """Has a notice of two lines."""

    notices = ("one line", "two\nlines")


class Warms(ToySimulator):
    """Simulates more before each episode than before the last."""

    setup_steps = 0

    def step(self, actions):
        self.setup_steps += 1
        return super().step(actions)


class Tidies(ToySimulator):
    """Its episodes are others after tidying."""

    tidied = 0

    def tidy(self):
        self.tidied += 1

    def reset(self, *, seed, options=None):
        return super().reset(seed=seed + self.tidied, options=options)


class ClosesOnce(ToySimulator):
    """Can be closed once only."""

    closed = 0

    def close(self):
        self.closed += 1
        assert self.closed < 2
        super().close()


class Thin(ToySimulator):
    """Has a lane without a width."""

    def lanes(self):
        first, *others = super().lanes()
        return [replace(first, width=0.0), *others]


class Point(ToySimulator):
    """Has a lane of one point."""

    def lanes(self):
        first, *others = super().lanes()
        return [replace(first, shape=first.shape[:1]), *others]


class Moves(ToySimulator):
    """Its map is another each time."""

    asked = 0

    def lanes(self):
        self.asked += 1
        first, *others = super().lanes()
        return [replace(first, width=float(self.asked)), *others]


class Open(ToySimulator):
    """Has an obstacle whose outline is open."""

    def obstacles(self):
        return [Lane("house", 0.0, ((0.0, 9.0), (4.0, 9.0), (4.0, 12.0), (0.0, 12.0)))]


class AnyAction(SpeedAndLaneChange):
    """Takes a text for an action."""

    def encode(self, action):
        return super().encode((5.0, 0) if isinstance(action, str) else action)


class Lenient(ToySimulator):
    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.actions = {**self.actions, "ego": AnyAction()}


ONLY_SEED, INSTANCE, TIME, RESEEDED = (
    "test_an_episode_depends_on_its_seed_alone",
    "test_a_second_instance_does_the_same",
    "test_time_grows_by_the_step_length",
    "test_another_seed_within_an_episode_changes_only_what_follows",
)
ERRS = "test_others_err_and_the_next_episode_knows_nothing_of_it"
NAMES, MAP = "test_columns_have_a_name_each", "test_the_map_has_every_lane_once"


@pytest.mark.parametrize(
    ("simulator", "fails"),
    [
        (ToySimulator, set()),
        (SameTraffic, {ONLY_SEED}),
        (Remembers, {ONLY_SEED, RESEEDED, ERRS}),
        (Errs, {ERRS}),
        (Lasts, {ERRS}),
        (Declines, set()),
        (OwnInstance, {INSTANCE}),
        (Slow, {TIME}),
        (Partial, {"test_it_offers_faculties_as_a_whole"}),
        (Half, {MAP}),
        (Accelerates, {"test_braking_as_hard_as_it_can_is_an_action_that_does_not_speed_up"}),
        (Untold, {"test_only_events_that_it_looks_for_happen"}),
        (Leaves, {ONLY_SEED, INSTANCE, TIME, RESEEDED, ERRS}),
        (Live, {"test_what_is_handed_out_stays_as_it_is"}),
        (TwoNames, {NAMES}),
        (TooFewNames, {NAMES}),
        (Talks, {"test_notices_are_lines"}),
        (Warms, {"test_what_is_simulated_before_the_first_step_is_the_same_again"}),
        (Tidies, {"test_tidying_changes_no_episode"}),
        (ClosesOnce, {"test_closing_twice_is_fine"}),
        (Thin, {MAP}),
        (Point, {MAP}),
        (Moves, {MAP}),
        (Open, {"test_obstacles_are_closed_lines"}),
        (Lenient, {"test_actions_are_checked_and_encoded_once_and_for_all"}),
    ],
)
def test_simulator_contract_finds_what_is_broken(simulator, fails, tmp_path):
    scenario = Scenario(simulator="toy", agents={"ego": AgentSetup(), "second": AgentSetup(action="meta")})
    if simulator in (Errs, Lasts, Declines):
        scenario = replace(scenario, agents={"ego": AgentSetup()})  # which follows the leader, the only one to disturb
    assert failing(SimulatorContract, lambda: {"make": lambda: simulator(scenario, tmp_path)}) == fails


@pytest.mark.parametrize(
    ("found", "verdict"),
    [
        ({}, "silent"),
        ({"step": 3, "avoided": True}, "right"),
        ({"step": 3, "avoided": False}, "wrong"),
        ({"too_late": 4, "avoided_later": False}, "right"),
        ({"too_late": 4, "avoided_later": True}, "wrong"),
        ({"step": 3, "too_late": 4, "avoided": True, "avoided_later": False}, "right"),
        ({"step": 3, "too_late": 4, "avoided": True, "avoided_later": True}, "wrong"),
    ],
)
def test_verdict_on_an_escape_needs_both_runs(found, verdict):
    assert EscapeCheck("c", **found).verdict == verdict


def test_driver_repeats_the_log_and_brakes_after_its_step(monkeypatch):
    log = SimpleNamespace(actions=lambda agent: [f"{agent} {n}" for n in range(4)])
    monkeypatch.setattr("crashhunt.testing._last_avoidable_step_check.read_log", lambda path: log)
    found = []
    for after in (2, 9):
        agent = RecordedThenBrakes("log.mcap", "ego", after, None)
        for _ in range(2):  # a reset begins again
            agent.reset(1)
            found.append([agent.act(None) for _ in range(6)])
    first = ["ego 0", "ego 1", (0.0, 0), (0.0, 0), (0.0, 0), (0.0, 0)]
    second = ["ego 0", "ego 1", "ego 2", "ego 3", "ego 3", "ego 3"]
    assert found == [first, first, second, second]
    meta = RecordedThenBrakes("log.mcap", "ego", 0, SimpleNamespace(meanings=("FASTER", "IDLE", "SLOWER")))
    meta.reset(1)
    assert meta.act(None) == 2


@dataclass(frozen=True)
class Worker:
    scenario: object
    scratch: Path = Path()


@dataclass(frozen=True)
class Spec:
    arguments: dict
    max_steps: int = 30
    seed: int = 5


def crash(agent, other):
    """A result with a collision of an agent and another actor; without one for None."""
    found = agent and SimpleNamespace(agent=agent, other=other)
    return SimpleNamespace(collision=found, escape=None)


@pytest.fixture
def escapes(monkeypatch):
    """Replace replays: a trial ends as `ends` says."""
    made, asked = [], []
    scenario = SimpleNamespace(agents={"ego": 1, "second": 2}, with_agents=lambda agents: ("with", agents))
    rerun = SimpleNamespace(
        worker=Worker(scenario), spec=Spec({"ego": {"log": "a"}, "second": {"log": "b"}}),
        recorded=SimpleNamespace(steps=30, prologue=SimpleNamespace(step_length_s=0.25)),
        bundle=SimpleNamespace(id="c", driver="ego", result=crash("ego", "truck")),
    )  # fmt: skip

    def prepare(bundle, options):
        asked.append((bundle, options.code))
        return rerun

    def run_alone(worker, spec):
        made.append(SimpleNamespace(worker=worker, spec=spec))
        yield SimpleNamespace(result=found.ends(spec))

    monkeypatch.setattr(_last_avoidable_step, "prepare", prepare)
    monkeypatch.setattr(_last_avoidable_step, "run_alone", run_alone)
    monkeypatch.setattr(_last_avoidable_step, "partner", lambda result: result.collision and result.collision.other)
    found = SimpleNamespace(made=made, ends=None, bundle=rerun.bundle, asked=asked)
    return found


@pytest.mark.parametrize(
    ("before", "after", "found"),
    [
        (crash(None, None), crash("ego", "truck"), (True, False)),
        (crash("ego", "truck"), crash("ego", "truck"), (False, False)),
        (crash("ego", "wall"), crash("second", "truck"), (True, True)),
        (crash("second", "truck"), crash(None, None), (True, True)),
    ],
)
def test_last_avoidable_step_is_checked_by_braking_after_it_and_later(escapes, before, after, found):
    escapes.ends = lambda spec: before if spec.arguments["ego"]["after"] == 7 else after
    escapes.bundle.result.escape = SimpleNamespace(step=7, too_late=8)
    check = check_escape(escapes.bundle)
    assert check == EscapeCheck("c", 7, 8, *found)
    assert escapes.asked == [(escapes.bundle, "log")]
    assert [run.spec.arguments["ego"] for run in escapes.made] == [{"log": "a", "after": 7}, {"log": "a", "after": 8}]
    for run in escapes.made:
        assert run.spec.arguments["second"] == {"log": "b", "after": _last_avoidable_step._NEVER}
        assert run.spec.max_steps == 30 + round(_last_avoidable_step._AFTERWARDS_S / 0.25)
        assert run.spec.seed == 5
        name = "crashhunt.testing._last_avoidable_step_check:RecordedThenBrakes"
        assert run.worker.scenario == ("with", {"ego": name, "second": name})


@pytest.mark.parametrize(("step", "too_late", "runs"), [(None, 8, [8]), (7, None, [7]), (None, None, [])])
def test_step_that_is_not_known_is_not_checked(escapes, step, too_late, runs):
    escapes.ends = lambda spec: crash("ego", "truck")
    escapes.bundle.result.escape = SimpleNamespace(step=step, too_late=too_late)
    check = check_escape(escapes.bundle)
    assert [run.spec.arguments["ego"]["after"] for run in escapes.made] == runs
    assert (check.step, check.too_late) == (step, too_late)
    assert (check.avoided, check.avoided_later) == (
        None if step is None else False,
        None if too_late is None else False,
    )


def test_crash_without_a_calculated_step_is_not_run(escapes):
    assert check_escape(escapes.bundle) == EscapeCheck("c")
    assert escapes.made == escapes.asked == []
