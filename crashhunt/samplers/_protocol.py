"""The sampler protocol: what the next trial is to be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from crashhunt.trial import CRASHES, Distribution, Outcome, Value

if TYPE_CHECKING:
    import numpy as np

    from crashhunt.trial import TrialResult

__all__ = [
    "HuntFacts",
    "Independent",
    "Key",
    "OnlyAsked",
    "PlainStream",
    "Proposal",
    "ReceivesHuntFacts",
    "Sampler",
    "Space",
    "Versioned",
]  # fmt: skip

Key = tuple[str, str]
"""(agent id, argument name); the agent id is empty for an argument of the scenario."""

Space = Mapping[Key, Distribution]


@dataclass(frozen=True, slots=True)
class Proposal:
    """What a sampler asks for.

    Args:
        arguments: a value for every key of the space.
        seed: seed of the trial, 0 to 2**31 - 1; None for the one that its number has in the hunt.
        parent: the number of the trial that it was made from; None if there is none.
        origin: a word on where it came from, such as the name of a strategy; empty for nothing.
    """

    arguments: Mapping[Key, Value]
    seed: int | None = None
    parent: int | None = None
    origin: str = ""


@dataclass(frozen=True, slots=True)
class HuntFacts:
    """What a sampler may know of the hunt that it is made for.

    Args:
        seed: seed of the hunt.
        crash_on: the outcomes that count as a crash.
    """

    seed: int = 0
    crash_on: tuple[Outcome, ...] = CRASHES


class Sampler(Protocol):
    """Proposes trials, and may learn from their results.

    It is created with the space and, as a keyword, ``points``: the number of values to try of a range without a step.
    It also receives ``hunt`` if it asks for that (`ReceivesHuntFacts`).

    Contract: a proposal depends on the constructor's arguments, the trial's number, its generator, and the reported
    results in their order. It never depends on time, on earlier requests or on anything else. A new sampler that
    receives the same results therefore makes the same proposals, so an interrupted hunt can resume.

    A sampler whose ``learns`` is false receives no results. Its proposal for a number is the same for any number of
    parallel trials.

    A sampler that learns receives results by this rule. The lag is the number of parallel trials of the hunt.

    - Before the proposal for trial n, it receives all new results up to trial n - lag, in the order of their numbers.
    - A trial that has not ended by then is reported late, before the first proposal after its end. One trial that
      hangs therefore does not stop the sampler from learning.
    - A hunt with ``--deterministic`` waits: the sampler receives exactly the results up to n - lag. The lag is
      4 + n / 8, rounded down. It is at most 32, or the parallel trials of the first run if those are more. The trials
      are then the same at any speed.
    - The ledger stores proposals, and the results reported before each, before their trials start. A resumed hunt runs
      the same trials, and reports results in the same order.
    """

    learns: bool

    def ask(self, number: int, rng: np.random.Generator) -> Proposal | Mapping[Key, Value]:
        """Return a proposal, or only its arguments.

        Args:
            number: number of the trial, from 0.
            rng: the trial's own generator, the same for the same hunt seed and number.
        """

    def tell(self, result: TrialResult) -> None:
        """Learn how a trial ended; its ``spec`` says what was proposed."""


@runtime_checkable
class OnlyAsked(Protocol):
    """A sampler that may vary only the arguments that the user asks for by name.

    Where ``only_asked`` is true, every other argument is a constant in its space. ``only_asked`` is a class attribute,
    because it is read before a sampler is created.
    """

    only_asked: bool


@runtime_checkable
class ReceivesHuntFacts(Protocol):
    """A sampler that may be made with one keyword more: ``hunt``, the `HuntFacts`.

    Where ``wants_hunt`` is true, it is. The class says so, for it is asked before a sampler is made.
    """

    wants_hunt: bool


@runtime_checkable
class Versioned(Protocol):
    """A sampler whose proposals have a version, from 1: another version proposes other trials for the same results.

    A hunt cannot resume with another version than it began with. A sampler without a version has version 1.
    """

    version: int


@runtime_checkable
class Independent(Protocol):
    """A sampler that may draw every trial from the distributions of its space, independently of all others.

    Where ``independent`` is true, the share of trials that crash estimates the crash rate of the agent, so the rate
    gets a confidence interval. Such a sampler draws the scenario's arguments first, in order of their names. Two
    hunts with one seed therefore have the same traffic for any agent.
    """

    independent: bool


@runtime_checkable
class PlainStream(Protocol):
    """A sampler that learns, and draws some trials as `RandomSampler` does, independently of all results.

    Their numbers are fixed beforehand, and ``plain_origin`` is the origin of all of them and of no other trial. The
    share of them that crash estimates the crash rate of the agent. The other trials are biased towards crashes.
    """

    plain_origin: str
