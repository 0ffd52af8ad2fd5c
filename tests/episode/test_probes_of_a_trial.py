"""What copies of a trial are asked, and what is made of their answers; these copies are made up."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest

from crashhunt.base.foreign_code import members
from crashhunt.base.forks import NoAnswer
from crashhunt.episode import BUDGET_BESIDE, Prober, _forks
from crashhunt.simulators import SupportsDisturbances
from crashhunt.trial import CRASHES, Disturbance, Outcome, Stress, TrialResult, TrialSpec

DT = 0.1
BRAKE, STOP = 6.0, 6.0  # m/s²: the strongest that is plausible


@dataclass
class Road:
    """A trial at some step, of which a copy crashes if it is disturbed hard enough.

    Args:
        crashes: what to the share of its kind's greatest strength from which on it makes a copy crash.
        steps: of the trial, so far.
        outcome: of copies that crash.
        after: in how many steps they do.
        doomed: it crashes without any disturbance.
        absent: kinds for which nobody is there when they begin.
        away: kinds for which nobody is there already before.
        answers: whether copies answer at all; otherwise they raise an exception.
    """

    crashes: dict[str, float]
    steps: int = 1000
    outcome: Outcome = Outcome.COLLISION
    after: int = 7
    doomed: bool = False
    absent: tuple[str, ...] = ()
    away: tuple[str, ...] = ()
    answers: bool = True
    forks: int = 0
    names: tuple[str, ...] = ("ego",)
    acting: tuple[int, ...] = (0,)
    kinds: tuple[str, ...] = ("brake", "stop")
    asked: list[Disturbance | None] = field(default_factory=list)
    taken: list[int] = field(default_factory=list)

    @property
    def simulator(self):
        able = (
            {**dict.fromkeys(members(SupportsDisturbances), True), "disturbing_kinds": self.kinds} if self.kinds else {}
        )
        if self.kinds:
            able["resolve_target"] = lambda one: "" if one.what in self.away else "somebody"
        return SimpleNamespace(step_length_s=DT, **able)

    def fork(self, work, *, observed=True):
        assert not observed
        copy = _Copy(self)
        answer = work(copy)
        if "there" in answer:  # who is, which takes no step
            assert copy.steps == self.steps
        else:
            self.asked.append(copy.disturbance)
            self.taken.append(copy.steps - self.steps)
        self.forks += 1
        return SimpleNamespace(
            answer=lambda seconds: answer if self.answers else None, no_answer=NoAnswer("raised KeyError: 3")
        )


@dataclass
class Kills(Road):
    """The same, of which some copies are killed.

    Args:
        kills: a character for each copy: k where it is killed.
    """

    kills: str = ""

    def fork(self, work, *, observed=True):
        kill, self.kills = self.kills[:1] == "k", self.kills[1:]
        if not kill:
            return super().fork(work, observed=observed)
        self.forks += 1
        reason = NoAnswer("was killed by SIGKILL", is_from_outside=True)
        return SimpleNamespace(answer=lambda seconds: None, no_answer=reason)


class _Copy:
    def __init__(self, road):
        self.road, self.steps, self.result, self.disturbance = road, road.steps, None, None
        self.simulator = road.simulator

    def disturb(self, disturbance):
        self.disturbance = disturbance

    def takes_place(self, disturbance):
        return disturbance.what not in self.road.absent

    def step(self):
        self.steps += 1
        road, it = self.road, self.disturbance
        most = {"brake": BRAKE, "stop": STOP, "noisy_observation": 0.2}
        harmed = it is not None and it.what in road.crashes and it.how_strong >= (
            road.crashes[it.what] * most.get(it.what, 1.0) - 1e-9
        )  # fmt: skip
        if (harmed or road.doomed) and self.steps == road.steps + road.after:
            self.result = SimpleNamespace(outcome=road.outcome)


def prober(crash_on=CRASHES, every_s=2.0):
    waited = []
    return Prober(every_s, crash_on, waited.append), waited


def stress_of(asker, outcome=Outcome.SURVIVED):
    return asker.result(TrialResult(TrialSpec(3, 5, {}, {}, 100), outcome)).stress


@pytest.mark.parametrize("share", [1, 2, 5, 8, 11, 15])
def test_the_mildest_is_found_in_few_copies(share):
    asker, waited = prober()
    road = Road({"brake": share / 16})
    asker.ask(road)
    stress = stress_of(asker)
    # The strongest that is asked for is a sixteenth less than the strongest that is plausible.
    assert stress.margin == share / 16
    assert stress.disturbance == Disturbance(1002, "ahead", "brake", BRAKE * share / 16, 3.0, "ego")
    assert (stress.outcome, stress.step) == ("collision", 1007)
    braked = [one.how_strong for one in road.asked if one is not None and one.what == "brake"]
    assert braked[0] == BRAKE * 15 / 16
    assert 1 <= len(braked) <= 5
    assert stress.probes == len(road.asked) == len(waited) - 1  # which was asked who is there
    assert stress.steps == sum(road.taken)
    assert min(waited) >= 0
    # One copy has gone on without any disturbance: the trial would not have crashed anyway.
    assert road.asked.count(None) == 1
    assert road.asked.index(None) == 1


def test_other_kinds_are_asked_for_what_is_milder_only():
    asker, _ = prober()
    road = Road({"brake": 0.5, "stop": 0.25, "noisy_observation": 0.9})
    asker.ask(road)
    assert road.asked.count(None) == 1  # at one moment, that says the same of all kinds
    first = {one.what: one.how_strong for one in reversed(road.asked) if one is not None}
    assert list(dict.fromkeys(one.what for one in road.asked if one)) == [
        "brake", "stop", "late_action", "late_observation", "noisy_observation",
    ]  # fmt: skip
    assert first["stop"] == pytest.approx(STOP * 7 / 16)
    assert first["noisy_observation"] == pytest.approx(0.2 * 3 / 16)
    stress = stress_of(asker)
    assert (stress.margin, stress.disturbance.what, stress.disturbance.how_long) == (0.25, "stop", 8.0)
    assert stress.left_out == 0


def test_how_late_is_reported_as_it_was():
    asker, _ = prober()
    road = Road({"late_action": 0.01}, kinds=())
    asker.ask(road)
    stress = stress_of(asker)
    # One step late, and not a sixteenth of a second.
    assert (stress.margin, stress.disturbance.how_strong) == (pytest.approx(DT), DT)
    late = [one.how_strong for one in road.asked if one is not None and one.what == "late_observation"]
    assert late == []  # which would be as late at least


def test_where_nothing_milder_is_left_nothing_else_is_asked():
    asker, _ = prober()
    road = Road({"brake": 1 / 16})
    asker.ask(road)
    assert {one.what for one in road.asked if one} == {"brake"}
    again = len(road.asked)
    asker.ask(road)  # at the next moment: each kind has nothing to ask for
    assert len(road.asked) == again


def test_as_long_as_something_milder_is_left_it_is_asked_for():
    asker, _ = prober()
    road = Road({"brake": 2 / 16})
    asker.ask(road)
    road.crashes["stop"] = 1 / 16
    asker.ask(road)  # at the next moment
    assert stress_of(asker).margin == 1 / 16


def test_of_a_trial_that_crashes_anyway_a_disturbance_states_nothing():
    asker, _ = prober()
    road = Road({"brake": 0.5}, doomed=True)
    asker.ask(road)
    assert road.asked[1] is None
    assert len(road.asked) == 2
    stress = stress_of(asker)
    assert (stress.margin, stress.disturbance) == (1.0, None)


def test_a_copy_is_followed_for_five_seconds_and_only_if_an_actor_is_there():
    asker, _ = prober()
    road = Road({}, absent=("brake",))
    asker.ask(road)
    # Nobody was ahead in the step in which it was to begin; the others go on until 5 s after that.
    assert dict(zip([one.what for one in road.asked], road.taken, strict=True)) == {
        "brake": 2, "stop": 52, "late_action": 52, "late_observation": 52, "noisy_observation": 52,
    }  # fmt: skip
    assert stress_of(asker).steps == 2 + 4 * 52


def test_who_is_not_there_is_asked_for_nothing():
    asker, _ = prober()
    road = Road({}, away=("brake",))
    asker.ask(road)
    assert "brake" not in [one.what for one in road.asked]
    assert len(road.asked) == 4


def test_copies_take_four_times_the_steps_of_their_trial_and_others_are_excluded_each_time():
    asker, _ = prober()
    road = Road({}, steps=20)  # of which copies may take 80
    asker.ask(road)
    assert [one.what for one in road.asked] == ["brake", "stop"]
    road.asked.clear()
    road.steps = 40
    asker.ask(road)
    assert [one.what for one in road.asked] == ["stop", "late_action"]
    assert stress_of(asker).left_out == 3 + 3
    beside = Prober(2.0, CRASHES, lambda _: None, BUDGET_BESIDE)  # of a trial that branches as well
    road.asked.clear()
    beside.ask(road)
    assert [one.what for one in road.asked] == ["brake"]
    # The next trial has a budget of its own, and begins with the first kind.
    road.asked.clear()
    road.steps = 13  # 52 steps
    asker.ask(road)
    assert [one.what for one in road.asked] == ["brake"]


def test_kinds_that_do_not_fit_the_actions_of_an_agent_are_excluded():
    asker = Prober(2.0, CRASHES, lambda _: None, refused={"ego": {"late_action", "late_observation"}})
    road = Road({})
    asker.ask(road)
    found = {one.what for one in road.asked if one is not None}
    assert {"brake", "noisy_observation"} <= found
    assert not found & {"late_action", "late_observation"}


def test_every_agent_that_drives_is_asked_about():
    asker, _ = prober()
    road = Road({}, names=("a", "b", "c"), acting=(0, 2), kinds=())
    asker.ask(road)
    assert {one.agent for one in road.asked} == {"a", "c"}
    assert {one.what for one in road.asked} == {"late_action", "late_observation", "noisy_observation"}


@pytest.mark.parametrize(
    ("outcome", "crash_on"),
    [(Outcome.SIMULATOR_ERROR, CRASHES), (Outcome.SURVIVED, CRASHES), (Outcome.COLLISION, (Outcome.HANG,))],
)
def test_what_is_no_crash_of_the_hunt_is_none_of_a_copy(outcome, crash_on):
    asker, _ = prober(crash_on)
    asker.ask(Road({"brake": 0.5, "stop": 0.5}, outcome=outcome))
    stress = stress_of(asker)
    assert (stress.margin, stress.disturbance, stress.outcome) == (1.0, None, "")


def test_a_trial_that_crashed_has_no_margin_and_one_that_no_one_asked_states_nothing():
    asker, _ = prober()
    assert stress_of(asker) is None
    assert stress_of(asker, Outcome.COLLISION).margin == 0.0
    asker.ask(Road({"brake": 0.5}))
    stress = stress_of(asker, Outcome.COLLISION)
    assert (stress.margin, stress.disturbance, stress.outcome, stress.step) == (0.0, None, "", 0)
    assert stress.probes > 0
    assert stress_of(asker) is None  # of the one before


def test_it_is_due_every_so_often():
    asker, _ = prober(every_s=0.5)
    assert [step for step in range(1, 21) if asker.is_due(Road({}, steps=step))] == [5, 10, 15, 20]


@pytest.fixture
def no_pauses(monkeypatch):
    monkeypatch.setattr(_forks, "_PAUSES_S", (0.0, 0.0))


@pytest.mark.parametrize("killed", ["k", "kk", ".k", "..kk", "....kk"])
def test_killed_copy_is_asked_again_and_the_answers_are_as_without_the_kill(killed, no_pauses):
    undisturbed, _ = prober()
    undisturbed.ask(Road({"brake": 0.5}))
    told = []
    asker = Prober(2.0, CRASHES, lambda _: None, tell=told.append)
    road = Kills({"brake": 0.5}, kills=killed)
    asker.ask(road)
    assert stress_of(asker) == stress_of(undisturbed)
    assert set(told) == {"probes: a copy of a trial was killed by SIGKILL, and another is asked"}
    assert asker.fork_runner.why_not == ""


def test_question_whose_copies_are_all_killed_leaves_the_margin_open(no_pauses):
    asker, _ = prober()
    asker.ask(Kills({"late_action": 0.3}, kinds=("brake",), kills=".kkk"))  # "brake" has no answer, the others have
    asker.ask(Road({"brake": 0.75}, kinds=("brake",)))
    asker.ask(Road({}, kinds=("brake",)))
    stress = stress_of(asker)
    assert (stress.margin, stress.margin_upper_bound, stress.disturbance.what) == (
        None, pytest.approx(0.3), "late_action",
    )  # fmt: skip
    assert (stress.moments, stress.moments_asked, stress.extent) == (3, 2, "asked 2 of 3")
    assert (stress.why_unasked, stress.may_be_asked_again) == ("a copy was killed by SIGKILL", True)
    data = json.loads(json.dumps(stress.to_json()))
    assert data["margin"] is None
    assert Stress.from_json(data) == stress
    asker.ask(Road({"brake": 0.75}, kinds=("brake",)))  # of the next trial
    assert stress_of(asker).margin == 0.75


@pytest.mark.parametrize("killed", ["kkk", ".kkk", "..kkk"])  # who is there, the disturbance, no disturbance
def test_nothing_is_concluded_from_a_question_without_an_answer(killed, no_pauses):
    asker, _ = prober()
    asker.ask(Kills({"brake": 1 / 16}, kinds=("brake",), kills=killed))
    stress = stress_of(asker)
    assert (stress.margin, stress.extent) == (None, "asked 0 of 1")
    assert stress.disturbance is None


def test_trial_that_crashed_has_its_margin_whatever_was_not_asked(no_pauses):
    asker, _ = prober()
    asker.ask(Kills({}, kills="kkk"))
    stress = stress_of(asker, Outcome.COLLISION)
    assert (stress.margin, stress.why_unasked, stress.may_be_asked_again) == (0.0, "", False)


def test_copies_that_fail_by_themselves_are_asked_once_and_three_in_turn_end_the_asking():
    told = []
    asker = Prober(2.0, CRASHES, lambda _: None, tell=told.append)
    for moment in range(3):
        assert asker.fork_runner.why_not == ""
        road = Road({"brake": 0.5}, answers=False)
        asker.ask(road)
        assert road.forks == 1, "it was asked again, or more was asked though it is not known who is there"
        assert stress_of(asker).extent == "asked 0 of 1", moment
    assert asker.fork_runner.why_not == "3 copies in turn failed; the last raised KeyError: 3"
    assert told == ["probes: a copy raised KeyError: 3; what it was asked has no answer"] * 3
    road = Road({"brake": 0.5})
    asker.ask(road)
    stress = stress_of(asker)
    assert (road.forks, stress.margin, stress.why_unasked) == (0, None, asker.fork_runner.why_not)
    assert not stress.may_be_asked_again
