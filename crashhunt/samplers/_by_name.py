"""Samplers by name: creates and calls them, and reports each failure of a user's sampler as one clear line."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from crashhunt.base.errors import CrashhuntError, PluginError, UsageError
from crashhunt.base.exceptions import blamed
from crashhunt.base.extras import install_command
from crashhunt.base.plugins import locate
from crashhunt.base.processes import exits_refused
from crashhunt.samplers._protocol import (
    HuntFacts,
    Independent,
    OnlyAsked,
    PlainStream,
    Proposal,
    ReceivesHuntFacts,
    Sampler,
    Space,
    Versioned,
)

if TYPE_CHECKING:
    import numpy as np

    from crashhunt.trial import TrialResult


_SEEDS = 2**31


class NamedSampler:
    """A sampler that was created by name, and whose proposals are all checked.

    Args:
        name: a registered name, ``optuna:NAME``, or ``module:attribute``.
        space: the space of the arguments to sample.
        points: number of values to try for a range without a step.
        hunt: facts about the hunt, for samplers that request them.

    Raises:
        PluginError: the sampler does not exist, cannot be created, or is not a sampler.
        CrashhuntError: the sampler refuses the space.
    """

    def __init__(self, name: str, space: Space, *, points: int, hunt: HuntFacts = HuntFacts()) -> None:  # noqa: B008
        self._name = name
        self._keys = space.keys()
        make = _maker(name)
        more = {"hunt": hunt} if isinstance(make, ReceivesHuntFacts) and make.wants_hunt else {}
        with self._blamed("cannot be made"):
            self._sampler: Sampler = make(space, points=points, **more)
        missing = [member for member in ("learns", "ask", "tell") if not hasattr(self._sampler, member)]
        if missing:
            raise PluginError(
                f"the sampler {name!r} has no {missing[0]!r}",
                fix=f"define {missing[0]}, as crashhunt.samplers.Sampler describes",
            )
        if self.learns and self.independent:
            raise PluginError(
                f"the sampler {name!r} declares both learns and independent",
                fix="set independent = False, or learns = False",
            )

    @property
    def learns(self) -> bool:
        """Whether the sampler receives results."""
        return self._sampler.learns

    @property
    def independent(self) -> bool:
        """Whether the sampler declares that it draws every trial independently of the others."""
        return isinstance(self._sampler, Independent) and self._sampler.independent

    @property
    def plain_origin(self) -> str:
        """The origin of the trials that the sampler draws independently of all results; empty if there are none."""
        return self._sampler.plain_origin if isinstance(self._sampler, PlainStream) else ""

    @property
    def version(self) -> int:
        """The version of the sampler's proposals, by default 1; another version may propose other trials."""
        return self._sampler.version if isinstance(self._sampler, Versioned) else 1

    def ask(self, number: int, rng: np.random.Generator) -> Proposal | None:
        """Return the sampler's proposal for a trial; None if a sampler that learns has no proposal for now.

        Raises:
            PluginError: the sampler failed, or did not return a valid proposal.
        """
        with self._blamed(f"fails when it is asked for trial {number}"):
            answer = self._sampler.ask(number, rng)
        if answer is None and self.learns:
            return None
        proposal = answer if isinstance(answer, Proposal) else Proposal(answer or {})
        wrong = "NoneType, not arguments" if answer is None else self._wrong_with(proposal)
        if wrong:
            raise PluginError(
                f"the sampler {self._name!r} proposes for trial {number} {wrong}", fix="correct the sampler"
            )
        return proposal

    def tell(self, result: TrialResult) -> None:
        """Report to the sampler how a trial ended.

        Raises:
            PluginError: the sampler failed.
        """
        with self._blamed(f"fails on the result of trial {result.spec.number}"):
            self._sampler.tell(result)

    def _wrong_with(self, proposal: Proposal) -> str:
        arguments = proposal.arguments
        if not isinstance(arguments, Mapping):
            return f"{type(arguments).__name__}, not arguments"
        if arguments.keys() != self._keys:
            odd = min(arguments.keys() ^ self._keys, key=str)
            return f"{'no value for' if odd in self._keys else 'a value for'} {'.'.join(filter(None, map(str, odd)))}"
        for (agent, name), value in arguments.items():
            if not isinstance(value, bool | int | float | str):
                return f"{'.'.join(filter(None, (agent, name)))} = {value!r}, not a plain bool, int, float or str"
            if isinstance(value, float) and not math.isfinite(value):
                return f"{'.'.join(filter(None, (agent, name)))} = {value!r}, not a finite number"
        seed, parent = proposal.seed, proposal.parent
        if seed is not None and not (type(seed) is int and 0 <= seed < _SEEDS):
            return f"the seed {seed!r}, not one from 0 to {_SEEDS - 1}"
        if parent is not None and not (type(parent) is int and parent >= 0):
            return f"the parent {parent!r}, not the number of a trial"
        if type(proposal.origin) is not str:
            return f"the origin {proposal.origin!r}, not a word"
        return ""

    @contextmanager
    def _blamed(self, what: str) -> Iterator[None]:
        """Turn a failure of a user's sampler into one clear line."""
        try:
            with exits_refused():
                yield
        except (CrashhuntError, KeyboardInterrupt):
            raise
        except BaseException as error:  # SystemExit too, or the command ends as if it were done
            raise blamed(f"the sampler {self._name!r} {what}", error) from error


def varies_only_asked(name: str) -> bool:
    """Return whether a sampler varies only the arguments that the user requests by name.

    Raises:
        PluginError: the sampler does not exist.
    """
    kind = _maker(name)
    return isinstance(kind, OnlyAsked) and kind.only_asked


def _maker(name: str) -> Any:
    if not name.lower().startswith("optuna:"):
        with exits_refused():
            return locate("samplers", name)
    try:
        from crashhunt.samplers._optuna import optuna_maker  # no other sampler imports Optuna
    except ModuleNotFoundError:
        raise UsageError(f"the sampler {name!r} needs the package optuna", fix=install_command("search")) from None
    return optuna_maker(name)
