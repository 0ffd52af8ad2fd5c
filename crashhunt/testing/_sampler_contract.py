"""The contract suite for samplers."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import pytest

from crashhunt.samplers import Independent, OnlyAsked, PlainStream, Proposal, RandomSampler, Sampler, Space
from crashhunt.trial import Outcome, Range, TrialResult, TrialSpec
from crashhunt.world import ClosestApproach

if TYPE_CHECKING:
    from crashhunt.trial import Value

Make = Callable[[Space], Sampler]

_TRIALS, _LAG = 40, 4
_SLOW = {5: 10, 11: 9}  # trials that hang for a while, and for how many trials
_OUTCOMES = (Outcome.SURVIVED, Outcome.COLLISION, Outcome.INVALID, Outcome.FINISHED)


class SamplerContract:
    """Checks a sampler against `crashhunt.samplers.Sampler`.

    The fixture ``make`` returns a function that creates a sampler for a space, and ``space`` a space that it can
    sample.
    """

    @pytest.fixture
    def make(self) -> Make:
        """Return a function that creates a sampler."""
        raise NotImplementedError("the test class must define the fixture 'make'")

    @pytest.fixture
    def space(self) -> Space:
        """Return a space that the sampler can sample."""
        raise NotImplementedError("the test class must define the fixture 'space'")

    def test_every_proposal_is_complete_and_inside_the_space(self, make: Make, space: Space) -> None:
        """A proposal has a value for every key and no other value, before and after results were reported."""
        asked: set[int] = set()
        for number, (_, proposal) in enumerate(_talk(make(space))):
            assert set(proposal.arguments) == set(space)
            assert all(space[key].contains(value) for key, value in proposal.arguments.items())
            json.dumps(list(proposal.arguments.values()))
            assert proposal.seed is None or 0 <= proposal.seed < 2**31
            assert proposal.parent is None or proposal.parent in asked
            assert isinstance(proposal.origin, str)
            asked.add(number)

    def test_a_proposal_depends_on_number_and_generator_alone(self, make: Make, space: Space) -> None:
        """As long as no results have been reported, the order of the requests does not matter."""
        forward, backward = make(space), make(space)
        asked = {number: _ask(forward, number) for number in range(20)}
        assert {number: _ask(backward, number) for number in reversed(range(20))} == asked

    def test_one_that_is_made_again_and_reported_the_same_proposes_the_same(self, make: Make, space: Space) -> None:
        """A resumed hunt continues as if it had not been interrupted; some results arrive out of order, as allowed."""
        turns = _talk(make(space))
        for number in (0, 1, _LAG + 1, 9, 16, 23, _TRIALS - 1):
            if number >= len(turns):
                break
            again = make(space)
            for told, _ in turns[: number + 1]:
                for result in told:
                    again.tell(result)
            assert _ask(again, number) == turns[number][1], f"it was asked for trial {number}"

    def test_one_that_does_not_learn_proposes_the_same_whatever_it_is_reported(self, make: Make, space: Space) -> None:
        """The hunt passes no results to a sampler that does not learn, and reported results have no effect."""
        sampler = make(space)
        if not sampler.learns:
            fresh = make(space)
            assert [proposal for _, proposal in _talk(sampler)] == [_ask(fresh, number) for number in range(_TRIALS)]

    def test_it_states_whether_it_learns(self, make: Make, space: Space) -> None:
        """The hunt checks this attribute before it passes results to the sampler."""
        sampler = make(space)
        assert isinstance(sampler.learns, bool)
        assert not isinstance(sampler, OnlyAsked) or isinstance(sampler.only_asked, bool)

    def test_trials_that_it_keeps_apart_are_plain_random_ones(self, make: Make, space: Space) -> None:
        """These trials have fixed numbers and ignore results, so their share of crashes is the agent's crash rate."""
        sampler = make(space)
        if not isinstance(sampler, PlainStream):
            return
        assert sampler.learns
        plain, never_told, origin = RandomSampler(space), make(space), sampler.plain_origin
        apart = set()
        for number, (_, proposal) in enumerate(_talk(sampler)):
            if proposal.origin == origin:
                apart.add(number)
                drawn = _ask(plain, number)
                assert drawn is not None
                assert proposal.arguments == drawn.arguments
                assert (proposal.seed, proposal.parent) == (None, None)
        assert apart == {number for number in range(_TRIALS) if _origin(_ask(never_told, number)) == origin} != set()

    def test_independent_draws_of_the_scenario_do_not_depend_on_who_drives(self, make: Make, space: Space) -> None:
        """Two hunts with the same seed therefore have the same traffic; samplers that learn are not independent."""
        sampler = make(space)
        if not (isinstance(sampler, Independent) and sampler.independent):
            return
        assert not sampler.learns
        other = make({**space, ("", "a scenario's"): Range(0.0, 1.0), ("somebody", "else"): Range(0.0, 1.0)})
        alone = make({**{key: space[key] for key in space if not key[0]}, ("", "a scenario's"): Range(0.0, 1.0)})
        for number in range(20):
            mine, theirs = _ask(alone, number), _ask(other, number)
            assert mine is not None
            assert theirs is not None
            assert {key: theirs.arguments[key] for key in mine.arguments} == mine.arguments


def _ask(sampler: Sampler, number: int) -> Proposal | None:
    answer = sampler.ask(number, np.random.default_rng(np.random.SeedSequence(1, spawn_key=(number,))))
    return answer if isinstance(answer, Proposal) or answer is None else Proposal(answer)


def _origin(proposal: Proposal | None) -> str:
    return "" if proposal is None else proposal.origin


def _talk(sampler: Sampler) -> list[tuple[list[TrialResult], Proposal]]:
    """Return the results and requests of a hunt, trial by trial; some trials end late.

    If the sampler proposes no trial, all trials end, and the sampler is asked again. If it then proposes none, the hunt
    ends.
    """
    turns: list[tuple[list[TrialResult], Proposal]] = []
    told: set[int] = set()
    for number in range(_TRIALS):
        ended = [n for n in range(number - _LAG + 1) if n not in told and number - n > _SLOW.get(n, 0)]
        told.update(ended)
        results = [_result(n, turns[n][1]) for n in ended]
        for result in results:
            sampler.tell(result)
        proposal = _ask(sampler, number)
        if proposal is None:
            left = [_result(n, turns[n][1]) for n in range(number) if n not in told]
            told.update(range(number))
            for result in left:
                sampler.tell(result)
            results, proposal = results + left, _ask(sampler, number)
        if proposal is None:
            return turns
        turns.append((results, proposal))
    assert told >= set(range(_TRIALS - _LAG))
    return turns


def _result(number: int, proposal: Proposal) -> TrialResult:
    """Return a possible result of a trial; some results have no measured criticality."""
    arguments: dict[str, dict[str, Value]] = {}
    for (agent, name), value in proposal.arguments.items():
        arguments.setdefault(agent, {})[name] = value
    scenario = arguments.pop("", {})
    seed = number if proposal.seed is None else proposal.seed
    spec = TrialSpec(
        number=number,
        seed=seed,
        arguments=arguments,
        scenario_arguments=scenario,
        max_steps=50,
        parent=proposal.parent,
        origin=proposal.origin,
    )
    near = ClosestApproach(((7 * number) % 10) / 2, 1.0 + number, 3.0) if number % 4 else ClosestApproach()
    outcome = _OUTCOMES[number % len(_OUTCOMES)]
    danger = {Outcome.INVALID: None, Outcome.COLLISION: 1.0}.get(outcome, ((7 * number) % 10) / 10)
    return TrialResult(spec, outcome, steps=number + 1, wall_s=0.1, closest=near, danger=danger)
