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
    "HuntFacts", "Independent", "Key", "OnlyAsked", "PlainStream", "Proposal", "Sampler", "Space",
    "WantsHunt",
]  # fmt: skip

Key = tuple[str, str]
"""(agent id, argument name); the agent id is empty for an argument of the scenario."""

Space = Mapping[Key, Distribution]


@dataclass(frozen=True, slots=True)
class Proposal:
    """What a sampler asks for.

    Args:
        arguments: a value for every key of the space.
        seed: of the trial, 0 to 2**31 - 1; None for the one that its number has in the hunt.
        parent: the number of the trial that it was made from; None where there is none.
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
        seed: of the hunt.
        crash_on: the outcomes that count as a crash.
    """

    seed: int = 0
    crash_on: tuple[Outcome, ...] = CRASHES


class Sampler(Protocol):
    """Proposes trials, and may learn from their results.

    It is made with the space and, as a keyword, ``points``: how many values to try of a range that has no step of its
    own; and with ``hunt``, where it says that it wants that (`WantsHunt`).

    Contract: a proposal depends on what it was made with, the trial's number, its generator and the results told so
    far, in their order, never on time, on what was asked before or on anything else. So one that is made anew and told
    the same results proposes the same, which is how a hunt goes on after it was interrupted.

    One whose ``learns`` is false is told nothing, and its proposals for a number are the same however many trials run
    at once.

    One that learns is told results by this rule. Before the proposal for trial n is asked for, all results up to
    n - lag are told that are there and were not told before, in the order of their numbers. A trial that has not ended
    by then is not waited for: it is told late, before the first proposal after its end, so that one that hangs keeps
    nobody from learning. The lag is how many trials a hunt has under way at once. A hunt with
    ``--deterministic`` waits: there, exactly the results up to n - lag are told, and the lag is 32, or what the hunt
    that began had under way where that is more; so its trials are the same whatever runs how fast. Proposals, and what
    was told before each, are in the ledger before their trials start. So a hunt that goes on, however it ended, runs
    those very trials, and tells the results in the order in which they were told.
    """

    learns: bool

    def ask(self, number: int, rng: np.random.Generator) -> Proposal | Mapping[Key, Value]:
        """Return a proposal, or only its arguments.

        Args:
            number: of the trial, from 0.
            rng: the trial's own generator, the same for the same hunt seed and number.
        """

    def tell(self, result: TrialResult) -> None:
        """Learn how a trial ended; its ``spec`` says what was proposed."""


@runtime_checkable
class OnlyAsked(Protocol):
    """A sampler that may vary only what somebody asks for by name.

    Where ``only_asked`` is true, everything else is a constant in its space. The class says so, for it is asked before
    a sampler is made.
    """

    only_asked: bool


@runtime_checkable
class WantsHunt(Protocol):
    """A sampler that may be made with one keyword more: ``hunt``, the `HuntFacts`.

    Where ``wants_hunt`` is true, it is. The class says so, for it is asked before a sampler is made.
    """

    wants_hunt: bool


@runtime_checkable
class Independent(Protocol):
    """A sampler that may draw every trial from the distributions of its space, independently of all others.

    Where ``independent`` is true, how often a hunt crashes says how often its agent does, and so the rate gets an
    interval. Such a one draws the scenario's arguments first, in order of their names, so that two hunts with one seed
    have the same traffic whoever drives.
    """

    independent: bool


@runtime_checkable
class PlainStream(Protocol):
    """A sampler that learns, and keeps some trials apart that it draws as `RandomSampler` does, whatever it was told.

    Their numbers are fixed beforehand, and ``plain_origin`` is the origin of all of them and of no other. How often
    they crash says how often the agent does, as the other trials never could.
    """

    plain_origin: str
