"""What branches are asked and what becomes of the answers: suspended forks that answer from a list, in this process."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from crashhunt.base.forks import NoAnswer, NoProcessError
from crashhunt.episode import Brancher, _branches
from crashhunt.trial import CRASHES, Branches, Disturbance, Outcome, TrialResult, TrialSpec

RATES = ("brake=0.05", "late_observation=0.05")
EARLY, LATE = (Disturbance(step, "ahead", "brake", 1.0, 1.0, "ego") for step in (11, 12))
SPEC = TrialSpec(0, 7, {}, {}, 200, disturbances=(EARLY, LATE))


class Forks:
    """A fork that answers each job by a function of the job, and notes the jobs."""

    def __init__(self, step, answers, jobs):
        self.step, self.answers, self.jobs = step, answers, jobs
        self.is_usable, self.ended, self.no_answer = True, False, None

    def ask(self, job, seconds):
        assert seconds == _branches._PATIENCE_S
        self.jobs.append((self.step, job))
        answer = self.answers(len(self.jobs), job)
        if isinstance(answer, NoAnswer):
            self.is_usable, self.no_answer = False, answer
            return None
        return answer

    def end(self):
        self.ended = True


def answer(job, outcome="", step=30):
    there = [some[0] for some in job["choices"]]
    return {"steps": 5, "step": step, "outcome": outcome, "there": there, "log_likelihood": -2.0}


@pytest.fixture
def branch(monkeypatch):
    """Makes a brancher and an episode of a step of 0.1 s, in which another actor is near after each step."""
    monkeypatch.setattr(_branches, "approaches", lambda frames, name: (np.zeros(1), np.full(1, np.inf), np.zeros(1)))
    monkeypatch.setattr(_branches, "free_memory", lambda: 1.0)

    def made(answers, *, words=RATES, danger=(), spec=SPEC):
        monkeypatch.setattr(_branches, "dangers", lambda frames, names, dt: (np.array(danger[: len(frames)]), None))
        waited, jobs, forks = [], [], []
        brancher = Brancher(words, CRASHES, waited.append)
        episode = SimpleNamespace(
            spec=spec, names=("ego",), simulator=SimpleNamespace(step_length_s=0.1), steps=0,
            suspend_fork=lambda work: forks.append(Forks(episode.steps, answers, jobs)) or forks[-1],
        )  # fmt: skip
        brancher.begin(episode)

        def run(to):
            for episode.steps in range(episode.steps + 1, to + 1):  # noqa: B020  -- the step of the episode
                brancher.scene(episode.steps, SimpleNamespace(frame=episode.steps), (0.0,))
                if brancher.is_due(episode):
                    brancher.ask(episode)

        return SimpleNamespace(
            brancher=brancher, jobs=jobs, forks=forks, waited=waited, run=run, episode=episode,
            end=lambda outcome=Outcome.SURVIVED: brancher.result(TrialResult(spec, outcome, episode.steps)).branches,
        )  # fmt: skip

    return made


def test_all_disturbances_at_once_are_removed_one_by_one_while_the_branch_crashes(branch):
    made = branch(lambda number, job: answer(job, "collision" if number in (1, 3) else ""))
    made.run(10)
    (at, first), (_, anyway), (_, one), *rest = made.jobs
    assert (at, first["until"]) == (10, 10 + 60)
    assert [some[0]["what"] for some in first["choices"]] == ["brake", "late_observation"]
    assert all(len(some) >= 1 for some in first["choices"])
    assert all(12 <= each["step"] <= 21 for some in first["choices"] for each in some)
    assert anyway == {"choices": [], "until": 40}  # whether it crashes without, up to a second after the crash
    assert one == {"choices": [[first["choices"][1][0]]], "until": 70}
    assert rest == []  # one disturbance is left
    found = made.end()
    assert (found.moments, found.asked, found.steps, found.left_out) == (1, 3, 15, 0)
    # What had begun in the trial by the first step of the branch is part of it, and later disturbances are not.
    drawn = [Disturbance.from_json(some[0]) for some in first["choices"]]
    assert [[*crash.disturbances] for crash in found.crashes] == [
        [EARLY, *sorted(drawn, key=lambda one: one.step)],
        [EARLY, drawn[1]],
    ]
    assert {(crash.branched, crash.outcome, crash.step, crash.log_likelihood) for crash in found.crashes} == {
        (10, "collision", 30, -2.0)
    }


@pytest.mark.parametrize("outcome", ["simulator_error", "survived", "finished"])
def test_only_crashes_of_traffic_or_agents_are_kept(branch, outcome):
    made = branch(lambda number, job: answer(job, outcome))
    made.run(10)
    assert len(made.jobs) == 1
    assert (made.end().asked, made.end().crashes) == (1, ())


def test_a_branch_that_crashes_without_its_disturbances_shows_nothing(branch):
    made = branch(lambda number, job: answer(job, "collision"))
    made.run(10)
    assert (len(made.jobs), made.end().crashes) == (2, ())


def test_disturbances_at_given_steps_are_in_every_branch_that_they_lie_in(branch):
    words = (*RATES, "brake@11=ahead:3:1", "brake@12=ahead:3:1", "brake@70=ahead:3:1", "brake@71=ahead:3:1")
    made = branch(lambda number, job: answer(job, "collision" if number == 1 else "", step=65), words=words)
    made.run(10)
    assert [some[0]["step"] for some in made.jobs[0][1]["choices"][2:]] == [12, 70]
    assert [some[0]["step"] for some in made.jobs[1][1]["choices"]] == [12, 70]
    assert made.jobs[1][1]["until"] == 70  # not after the end of a branch
    assert len(made.jobs) == 4
    assert {len(job["choices"]) for _, job in made.jobs[2:]} == {1 + 2}


def test_branches_with_all_disturbances_begin_every_two_seconds_within_their_budget(branch):
    made = branch(lambda number, job: answer(job) | {"steps": 45})
    made.run(60)
    assert [step for step, _ in made.jobs] == [10, 30, 50]
    assert len({str(job) for _, job in made.jobs}) == 3  # each has other draws
    made.run(70)
    found = made.end()
    assert (found.moments, found.asked, found.steps, found.left_out) == (4, 4, 180, 0)
    for steps, asked in ((199, [10, 50]), (200, [10])):  # 200 steps are four for each of 50
        spent = branch(lambda number, job, steps=steps: answer(job) | {"steps": steps})
        spent.run(50)
        assert [step for step, _ in spent.jobs] == asked
        assert (spent.end().moments, spent.end().left_out) == (len(asked), 3 - len(asked))


def test_forks_are_kept_for_eight_seconds_and_ended_with_the_trial(branch):
    made = branch(lambda number, job: answer(job))
    made.run(90)
    assert [fork.step for fork in made.forks if not fork.ended] == [20, 30, 40, 50, 60, 70, 80, 90]
    assert len(made.waited) == 9
    made.brancher.close()
    assert all(fork.ended for fork in made.forks)


def test_a_critical_moment_is_asked_about_from_its_step_and_up_to_three_seconds_before(branch):
    """The criticality has its peak in the second that ends 3 s ago."""
    danger = [0.0] * 45 + [0.5] + [0.0] * 34
    made = branch(lambda number, job: answer(job), danger=danger)
    made.run(80)
    drawn = [(step, job["until"]) for step, job in made.jobs if step not in (10, 30, 50, 70)]
    assert drawn == [(40, 100)]
    everything = [step for step, _ in made.jobs]
    assert everything == [10, 30, 50, 70, 40, 30, 10]
    assert made.end().moments == 4 + 1
    assert made.jobs[-2][1]["until"] == 30 + 60
    weak = branch(lambda number, job: answer(job), danger=[0.4 * one for one in danger[:45]] + [0.19] + danger[46:])
    weak.run(80)
    assert weak.end().moments == 4


def test_a_fork_that_was_killed_is_made_again_only_at_its_own_step(branch):
    killed = NoAnswer("was killed by SIGKILL", is_from_outside=True)
    made = branch(lambda number, job: killed if number == 1 else answer(job))
    made.run(10)
    assert [fork.ended for fork in made.forks] == [True, False]
    assert (made.end().asked, made.end().unanswered) == (1, 0)


def test_what_cannot_be_asked_is_counted_with_its_reason(branch, monkeypatch):
    made = branch(lambda number, job: answer(job))

    def fails(work):
        raise NoProcessError("no process is left")

    made.episode.suspend_fork = fails
    made.run(10)
    found = made.end()
    assert (found.asked, found.unanswered, found.may_be_asked_again) == (0, 1, True)
    assert found.why_unanswered == "a copy could not be made: no process is left"
    monkeypatch.setattr(_branches, "free_memory", lambda: 0.24)
    made = branch(lambda number, job: answer(job))
    made.run(20)
    assert (made.end().unanswered, made.end().why_unanswered) == (2, "less than 25 % of the memory was free")
    assert (made.forks, made.jobs) == ([], [])


def test_a_trial_that_crashes_itself_keeps_no_crashes_of_branches(branch):
    made = branch(lambda number, job: answer(job, "collision" if number in (1, 3) else ""))
    assert made.end() is None  # nothing could be asked yet
    made.run(10)
    assert made.end(Outcome.COLLISION) == Branches(moments=1, asked=3, steps=15)
    assert len(made.end(Outcome.SURVIVED).crashes) == 2


class Runs:
    """A copy of an episode: disturbances at the places in `there` take place, and it crashes at a step."""

    def __init__(self, crash_at=0, there=("ahead",), traffic=True):
        self.steps, self.result, self.crash_at, self.there, self.planned = 10, None, crash_at, there, None
        self.names, self.simulator = ("ego",), SimpleNamespace(step_length_s=0.1)
        if traffic:
            self.simulator.disturbing_kinds, self.simulator.disturb = ("brake",), print
            self.simulator.resolve_target = lambda one: "leader" if one.who in there else ""

    def replan(self, planned):
        self.planned = planned

    def takes_place(self, one):
        return one.who in self.there and one.step <= self.steps

    def step(self):
        self.steps += 1
        if self.steps == self.crash_at:
            self.result = TrialResult(SPEC, Outcome.COLLISION, self.steps, disturbances=tuple(self.planned))


def brake(step, who="ahead", what="brake"):
    return Disturbance(step, who, what, 2.0, 1.0, "ego")


def test_branch_runs_the_first_choice_that_has_a_vehicle_and_reports_what_took_place(branch):
    def ran(copy, *choices, until=60, words=RATES):
        job = {"choices": [[one.to_json() for one in some] for some in choices], "until": until}
        made = branch(answer, words=words)
        found = made.brancher._run_branch(copy, job)
        return found | {"there": [Disturbance.from_json(one) for one in found["there"]]}

    ahead, behind, seen = brake(14), brake(14, "behind"), brake(12, "", "late_observation")
    copy = Runs(crash_at=30)
    found = ran(copy, (behind, ahead), (seen, brake(13, "", "late_observation")))
    assert [*copy.planned] == [seen, ahead]
    assert (found["steps"], found["step"], found["outcome"], found["there"]) == (20, 30, "collision", [ahead])
    assert found["log_likelihood"] < 0
    # Disturbances without a vehicle end the branch at once, or when the last of the first second has begun.
    found = ran(Runs(), (behind, brake(15, "left")))
    assert (found["steps"], found["step"], found["outcome"], found["there"]) == (0, 10, "", [])
    copy = Runs(there=())
    assert ran(copy, (behind,), (brake(24, "left"),), (brake(25, "right"),))["steps"] == 14
    assert copy.planned[0] == behind  # a single one is not looked for before
    assert ran(Runs(), (ahead,), until=60)["steps"] == 50
    # Disturbances at given steps take place in the trial as well, so they neither end nor justify a branch.
    copy, fixed = Runs(there=()), brake(12, "right ahead")
    assert ran(copy, (fixed,), words=(*RATES, "brake@12=right_ahead:2:1"))["steps"] == 50
    assert ran(Runs(traffic=False), (behind, ahead))["steps"] == 4
