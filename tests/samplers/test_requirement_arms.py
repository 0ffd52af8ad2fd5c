"""With several requirements, each conjunct has a search of its own, whatever the scales of their signals are."""

from __future__ import annotations

import numpy as np
from spaces import ask, spec_of

from crashhunt.oracles import REQUIREMENT, RequirementOracle
from crashhunt.samplers import GuidedSampler, HuntFacts
from crashhunt.samplers._guided import _scales
from crashhunt.space import Range
from crashhunt.trial import MAX_ROBUSTNESS, Constant, Outcome, TrialResult
from crashhunt.world import Event

SPACE = {("ego", name): Range(0.0, 1.0) for name in "abcd"}
VIOLATED = Outcome.own(REQUIREMENT, RequirementOracle.outcomes[REQUIREMENT])
FACTS = HuntFacts(1, (VIOLATED,))


def violations(conjuncts_of, trials, seed=1, slack_of=lambda x: None):
    """Hunt until all requirements are violated, and return the number of the first trial that violates each."""
    sampler, found = GuidedSampler(SPACE, hunt=FACTS), {}
    for number in range(trials):
        proposal = ask(sampler, number, seed)
        x = np.array(list(proposal.arguments.values()))
        rows = conjuncts_of(x)
        robustness = {name: min(max(row) for row in of) for name, of in rows.items()}
        violated = min((name for name in rows if robustness[name] < 0), default="")
        event = Event(REQUIREMENT, "ego", "", name=violated) if violated else None
        least = min(robustness.values())
        result = TrialResult(
            spec_of(number, proposal), VIOLATED if violated else Outcome.SURVIVED, event=event, conjuncts=rows,
            danger=1.0 if least <= 0 else 1 / (1 + least), slack_s=slack_of(x),
        )  # fmt: skip
        if violated:
            found.setdefault(violated, number)
            if len(found) == len(rows):
                break
        sampler.tell(result)
    return found


def corners(scale):
    """Two requirements that rare opposite corners violate, and whose robustness differs by a factor."""

    def rows(x):
        return {"low": ((float(x.max()) - 0.12,),), "high": ((scale * (0.88 - float(x.min())),),)}

    return rows


def test_both_requirements_are_violated_whatever_their_scales_are():
    found = violations(corners(1e-4), 90)
    assert set(found) == {"low", "high"}
    assert violations(corners(1e4), 90) == found


def test_parts_of_a_disjunction_are_divided_by_the_range_that_was_seen():
    """``rpm`` in thousands would hide the progress of ``speed``, as the greater of both counts."""

    def rows(x):
        return {"shift": ((3000 * (float(x[0]) - 0.1), 0.9 - float(x[1:].min())),)}

    assert "shift" in violations(rows, 60)
    seen = [(10.0, -1.0), (30.0, 2.0), (20.0, MAX_ROBUSTNESS), (-5.0, 4.0)]
    assert _scales(seen).tolist() == [20.0, 3.0]
    assert _scales([(-1.0, MAX_ROBUSTNESS)]).tolist() == [1.0, 1.0]


def test_time_ranks_trials_whose_robustness_is_equal():
    """Robustness is 0 wherever it does not say "violated", as for gears; the distance in time shows the way."""

    def away(x):
        return float(np.abs(x - 0.3).max()) - 0.06

    def rows(x):
        return {"stay": ((-1.0 if away(x) < 0 else 0.0,),)}

    assert "stay" not in violations(rows, 80, seed=2)
    assert "stay" in violations(rows, 80, seed=2, slack_of=lambda x: {"stay": (away(x),)})


def test_where_robustness_is_equal_only_some_proposals_are_corners_of_signals():
    space = {("ego", f"u[{point}]"): Range(0.0, 1.0) for point in range(4)}
    space["ego", "u"] = Constant("signal:constant:4:10.0")

    def corners(robustness):
        sampler, found = GuidedSampler(space, hunt=FACTS), []
        for number in range(10):
            proposal = ask(sampler, number, 1)
            points = {proposal.arguments["ego", f"u[{point}]"] for point in range(4)}
            found.append(points in ({0.0}, {1.0}))
            value = robustness(number)
            sampler.tell(TrialResult(
                spec_of(number, proposal), Outcome.SURVIVED, conjuncts={"r": ((value,),)}, danger=1 / (1 + value),
            ))  # fmt: skip
        return found

    assert [number for number, is_corner in enumerate(corners(lambda number: 9.0 - number)) if is_corner] == [1, 2]
    assert [number for number, is_corner in enumerate(corners(lambda number: 0.0)) if is_corner] == [1, 4]
