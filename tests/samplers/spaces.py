"""Spaces of all kinds, and specifications of trials in them, for tests of samplers."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from crashhunt.samplers import Proposal
from crashhunt.space import Choice, Constant, Range
from crashhunt.trial import TrialSpec

_numbers = st.floats(-1e6, 1e6, allow_nan=False, width=32)
_words = st.text("abc", min_size=1, max_size=3)


@st.composite
def _ranges(draw):
    low, high = sorted((draw(_numbers), draw(_numbers)))
    return Range(low, high)


@st.composite
def _integers(draw):
    low, high = sorted((draw(st.integers(-50, 50)), draw(st.integers(-50, 50))))
    return Range(low, high, integer=True)


@st.composite
def _logs(draw):
    low, high = sorted((draw(st.floats(1e-6, 1e6)), draw(st.floats(1e-6, 1e6))))
    return Range(low, high, log=True)


@st.composite
def _whole_logs(draw):
    low, high = sorted((draw(st.integers(1, 1000)), draw(st.integers(1, 1000))))
    return Range(low, high, log=True, integer=True)


@st.composite
def _stepped(draw):
    low = draw(st.integers(-20, 20))
    whole = draw(st.booleans())
    return Range(low, low + draw(st.integers(0, 40)), step=draw(st.integers(1, 7)), integer=whole)


distributions = st.one_of(
    st.builds(Constant, st.one_of(st.booleans(), st.integers(), _numbers, _words)),
    st.builds(Choice, st.lists(_words, min_size=1, max_size=5, unique=True).map(tuple)),
    st.just(Choice((True, False))),
    st.builds(Choice, st.lists(_numbers, min_size=1, max_size=4, unique=True).map(tuple)),
    _ranges(),
    _integers(),
    _logs(),
    _whole_logs(),
    _stepped(),
)

keys = st.tuples(st.sampled_from(["", "ego", "other"]), _words)
spaces = st.dictionaries(keys, distributions, max_size=30)


def spec_of(number, proposal):
    """The specification of a trial that was proposed."""
    arguments: dict[str, dict[str, object]] = {}
    for (agent, name), value in proposal.arguments.items():
        arguments.setdefault(agent, {})[name] = value
    scenario = arguments.pop("", {})
    seed = number if proposal.seed is None else proposal.seed
    return TrialSpec(number, seed, arguments, scenario, max_steps=9, parent=proposal.parent, origin=proposal.origin)


def ask(sampler, number, seed=1):
    """Ask as a hunt does."""
    answer = sampler.ask(number, np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,))))
    assert isinstance(answer, Proposal)
    return answer


def are_inside(proposal, space):
    """Whether a value is there for everything, of the right kind."""
    return set(proposal.arguments) == set(space) and all(
        space[key].contains(value) and _is_kind(space[key], value) for key, value in proposal.arguments.items()
    )


def _is_kind(known, value):
    return not isinstance(known, Range) or isinstance(value, int if known.integer else float)
