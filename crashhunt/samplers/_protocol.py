"""The sampler protocol: the interface of objects that propose the next trial."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from crashhunt.trial import CRASHES, Distribution, Outcome, Value

if TYPE_CHECKING:
    import numpy as np

    from crashhunt.trial import TrialResult

Key = tuple[str, str]
"""(agent id, argument name); the agent id is empty for an argument of the scenario."""

Space = Mapping[Key, Distribution]


@dataclass(frozen=True, slots=True)
class Proposal:
    """The proposal of a sampler for a trial.

    Args:
        arguments: a value for every key of the space.
        seed: seed of the trial, from 0 to 2**31 - 1; None for the seed that follows from the trial's number.
        parent: number of the trial from which the proposal was derived; None if there is none.
        origin: a word for the origin of the proposal, such as the name of a strategy; may be empty.
    """

    arguments: Mapping[Key, Value]
    seed: int | None = None
    parent: int | None = None
    origin: str = ""


@dataclass(frozen=True, slots=True)
class HuntFacts:
    """The facts about a hunt that its sampler may use.

    Args:
        seed: seed of the hunt.
        crash_on: the outcomes that count as a crash.
    """

    seed: int = 0
    crash_on: tuple[Outcome, ...] = CRASHES


class Sampler(Protocol):
    """Proposes trials, and may learn from their results.

    A sampler is created with the space and, as a keyword, ``points``: the number of values to try for a range without a
    step. A sampler also receives ``hunt`` if the sampler requests this (`ReceivesHuntFacts`).

    Contract: a proposal depends on the constructor's arguments, the trial's number, its generator, and the reported
    results in their order. A proposal never depends on time, on earlier requests or on anything else. A new sampler
    that receives the same results therefore makes the same proposals, so an interrupted hunt can resume.

    A sampler whose ``learns`` is false receives no results. The proposal of such a sampler for a trial is the same for
    any number of parallel trials.

    A sampler that learns receives results by this rule. The lag is the number of parallel trials of the hunt.

    - Before the proposal for trial n, it receives all new results up to trial n - lag, in the order of their numbers.
    - A trial that has not ended by then is reported late, before the first proposal after its end. One trial that
      hangs therefore does not stop the sampler from learning.
    - A hunt with ``--deterministic`` waits: the sampler receives exactly the results up to n - lag. The lag is 4 + n /
      8, rounded down. The lag is at most 32, or the number of parallel trials of the first run if that is greater. The
      trials are then the same at any speed.
    - A sampler may propose None. It is then asked again after all running trials have ended and been reported. If it
      proposes None again, the hunt ends.
    - The ledger stores proposals, and the results reported before each, before their trials start. A resumed hunt runs
      the same trials, and reports results in the same order.
    """

    learns: bool

    def ask(self, number: int, rng: np.random.Generator) -> Proposal | Mapping[Key, Value] | None:
        """Return a proposal, or only its arguments; None if the sampler learns and has no proposal for now.

        Args:
            number: number of the trial, counted from 0.
            rng: the trial's own random generator, the same for the same hunt seed and number.
        """

    def tell(self, result: TrialResult) -> None:
        """Learn from the result of a trial; its ``spec`` contains the proposal."""


@runtime_checkable
class OnlyAsked(Protocol):
    """A sampler that may be restricted to varying the arguments that the user requests by name.

    If ``only_asked`` is true, every other argument is a constant in the sampler's space. ``only_asked`` is a class
    attribute, because it is read before a sampler is created.
    """

    only_asked: bool


@runtime_checkable
class ReceivesHuntFacts(Protocol):
    """A sampler that may be created with a further keyword: ``hunt``, the `HuntFacts`.

    The keyword is passed if ``wants_hunt`` is true. ``wants_hunt`` is a class attribute, because it is read before a
    sampler is created.
    """

    wants_hunt: bool


@runtime_checkable
class Versioned(Protocol):
    """A sampler whose proposals have a version, counted from 1; another version may propose other trials.

    A hunt cannot resume with another version than it began with. A sampler without a version has version 1.
    """

    version: int


@runtime_checkable
class Independent(Protocol):
    """A sampler that may draw every trial from the distributions of its space, independently of all other trials.

    If ``independent`` is true, the share of trials that crash estimates the crash rate of the agent, so the rate gets a
    confidence interval. An independent sampler draws the scenario's arguments first, in order of their names. Two hunts
    with the same seed therefore have the same traffic for any agent.
    """

    independent: bool


@runtime_checkable
class PlainStream(Protocol):
    """A sampler that learns, but draws some trials as `RandomSampler` does, independently of all results.

    The numbers of these trials are fixed in advance. ``plain_origin`` is the origin of exactly these trials. The share
    of these trials that crash estimates the crash rate of the agent. The other trials are biased towards crashes.
    """

    plain_origin: str
