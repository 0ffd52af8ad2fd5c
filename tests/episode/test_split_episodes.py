"""Copies of root trials by splitting: an episode that forks itself in this process, so that each number is known."""

from __future__ import annotations

import copy
from types import SimpleNamespace

import pytest

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.forks import NoAnswer
from crashhunt.episode import COPIES_PER_LEVEL, Splitter, _splitting
from crashhunt.trial import CRASHES, Forcing, Outcome, Reseeding, TrialResult, TrialSpec

SPEC = TrialSpec(5, 77, {}, {}, 6, forcing=Forcing(1.0, levels=(0.2, 0.5)))
RATES = ((0.0, 0.0), (0.1, 0.3), (0.0, 0.1), (0.9, 0.4), (0.0, 0.1), (0.0, 0.2), (0.0, 0.1))
"""Closing rate of both agents after each step: the first level is reached after step 1, the second after step 3."""


class Forks:
    """An episode whose root survives and whose copies crash in their last step."""

    def __init__(self, spec=SPEC, *, outcome=Outcome.COLLISION, why_no_reseeding="", fails=None):
        self.spec, self.outcome, self.fails = spec, outcome, fails or (lambda number: None)
        self.simulator = SimpleNamespace(reseed=print, why_no_reseeding=why_no_reseeding)
        self.names, self.seeds, self.steps, self.result = ("ego", "second"), [], 0, None
        self.patience, self.forked = [], 0

    @property
    def scene(self):
        return SimpleNamespace(frame=dict(zip(self.names, RATES[self.steps], strict=True)))

    def reseed(self, seed):
        self.seeds.append((self.steps, seed))

    def step(self):
        self.steps += 1
        if self.steps == self.spec.max_steps:
            outcome = self.outcome if self.seeds else Outcome.SURVIVED
            self.result = TrialResult(self.spec, outcome, self.steps)

    def fork(self, run, *, observed):
        assert not observed
        self.forked += 1
        no_answer, made = self.fails(self.forked), copy.copy(self)
        made.seeds = [*self.seeds]
        answer = run(made) if no_answer is None else None
        return SimpleNamespace(answer=lambda seconds: self.patience.append(seconds) or answer, no_answer=no_answer)


@pytest.fixture
def run(monkeypatch):
    """Runs a root with its copies, and returns its result."""
    monkeypatch.setattr(_splitting, "closing_rate", lambda frame, name: frame[name])

    def run_it(episode, splitter=None, delays=None):
        splitter = splitter or Splitter(CRASHES, 2.0, ([] if delays is None else delays).append)
        assert splitter.is_due(episode)
        splitter.ask(episode)
        while episode.result is None:
            episode.step()
            if episode.result is None:
                splitter.ask(episode)
        return splitter.result(episode.result)

    return run_it


def test_root_is_copied_at_each_level_once_with_equal_shares(run):
    delays = []
    forced = run(Forks(), delays=delays).forced
    assert COPIES_PER_LEVEL == 3
    # Each of the two copies of the first level reaches the second level, and has two copies of its own there.
    assert [one.cell for one in forced.copies] == ["level 2"] * 8
    assert forced.survival == pytest.approx(1 / 9)
    assert [one.weight for one in forced.copies] == pytest.approx([1 / 9] * 8)
    assert [one.branched for one in forced.copies] == [1, 3, 3, 1, 3, 3, 3, 3]
    assert [one.onset for one in forced.copies] == [1, 3, 3, 1, 3, 3, 3, 3]
    assert {(one.crash, one.step) for one in forced.copies} == {("collision", 6)}
    assert forced.steps == 2 * 5 + 6 * 3
    assert (forced.peak, forced.unanswered, forced.masses) == (0.9, 0, {})
    assert len(delays) == 2  # only the steps with copies


def test_seeds_of_copies_are_all_different_and_repeat_from_the_start(run):
    forced, again = run(Forks()).forced, run(Forks()).forced
    seeds = [one.reseeding.seed for one in forced.copies]
    assert len({*seeds}) == 8
    assert again == forced
    assert all(0 <= seed < 2**31 for seed in seeds)
    outer, inner, *_ = (one.reseeding for one in forced.copies)
    assert outer == Reseeding(1, seeds[0])
    assert inner == Reseeding(3, seeds[1], ((1, seeds[0]),))
    assert forced.copies[-1].reseeding == Reseeding(3, seeds[-1])
    other = run(Forks(TrialSpec(5, 78, {}, {}, 6, forcing=SPEC.forcing))).forced
    assert not {*seeds} & {one.reseeding.seed for one in other.copies}


def test_two_levels_in_one_step_keep_only_the_last_seed_of_the_step(run):
    spec = TrialSpec(5, 77, {}, {}, 6, forcing=Forcing(1.0, levels=(0.2, 0.3)))
    forced = run(Forks(spec)).forced
    assert {(one.onset, one.reseeding.earlier) for one in forced.copies} == {(1, ())}
    assert len({one.reseeding.seed for one in forced.copies}) == 8


def test_copies_that_survive_have_no_specification_and_their_patience_grows_with_open_levels(run):
    episode = Forks(outcome=Outcome.SURVIVED)
    copies = run(episode).forced.copies
    assert {(one.crash, one.reseeding) for one in copies} == {("", None)}
    assert episode.patience == [2.0, 2.0, 6.0, 2.0, 2.0, 6.0, 2.0, 2.0]  # a copy of the first level waits for its own


def test_a_copy_without_a_result_makes_the_tree_incomplete(run):
    splitter = Splitter(CRASHES, 2.0, lambda _: None)
    forced = run(Forks(fails=lambda number: NoAnswer("hung") if number >= 4 else None), splitter).forced
    assert (forced.unanswered, forced.why_unanswered, forced.may_be_asked_again) == (1, "a copy hung", False)
    assert len(forced.copies) == 3  # the first copy with its own copies; no more are made at the second level
    for outcome in (Outcome.SIMULATOR_ERROR, Outcome.INVALID):
        forced = run(Forks(outcome=outcome), splitter).forced
        assert forced.why_unanswered == f"a copy ended by {outcome}"
        assert (forced.copies, forced.unanswered) == ((), 2)
    assert run(Forks(), splitter).forced.unanswered == 0  # another trial


def test_a_copy_whose_own_copy_has_no_result_has_none_and_names_the_reason(run):
    killed = NoAnswer("was killed by SIGKILL", is_from_outside=True)
    made = Forks()
    made.fork = lambda run, *, observed: Forks.fork(made, lambda path: run(within(path)), observed=observed)

    def within(path):
        path.fork = lambda run, *, observed: SimpleNamespace(answer=lambda seconds: None, no_answer=killed)
        return path

    forced = run(made).forced
    assert (forced.why_unanswered, forced.may_be_asked_again) == ("a copy was killed by SIGKILL", True)
    assert (forced.copies, forced.unanswered) == ((), 2)


@pytest.mark.parametrize("why", ["its traffic has no random numbers", None])
def test_a_simulator_without_random_numbers_is_refused(run, why):
    refused, episode = [], Forks(why_no_reseeding=why)
    if why is None:
        episode.simulator = SimpleNamespace()
        why = "the simulator cannot re-seed its random generators"
    forced = run(episode, Splitter(CRASHES, 2.0, lambda _: None, refuse=refused.append)).forced
    assert refused == [why]
    assert (forced.copies, forced.unanswered, forced.why_unanswered) == ((), 1, why)
    assert forced.survival == 1.0


def test_an_error_of_the_forks_ends_splitting_for_the_process(run):
    def fails(number):
        raise CrashhuntError("two threads run")

    splitter = Splitter(CRASHES, 2.0, lambda _: None)
    forced = run(Forks(fails=fails), splitter).forced
    assert (forced.copies, forced.unanswered, forced.why_unanswered) == ((), 1, "two threads run")
    assert run(Forks(), splitter).forced.why_unanswered == "two threads run"


def test_trials_without_levels_are_left_alone():
    splitter = Splitter(CRASHES, 2.0, lambda _: None)
    plain, forced = TrialSpec(0, 1, {}, {}, 6), TrialSpec(0, 1, {}, {}, 6, forcing=Forcing(1.0))
    assert not splitter.is_due(Forks(plain))
    assert not splitter.is_due(Forks(forced))
    assert splitter.is_due(Forks(TrialSpec(0, 1, {}, {}, 6, forcing=Forcing(1.0, levels=()))))
    result = TrialResult(plain, Outcome.SURVIVED, 6)
    assert splitter.result(result) is result
