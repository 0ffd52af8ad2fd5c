"""The request of a user for a hunt, from Python, the command line or a file, before it is resolved."""

from __future__ import annotations

import inspect
import os
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self, runtime_checkable

from crashhunt.base.calls import clear_constructor
from crashhunt.base.errors import UsageError
from crashhunt.base.plugins import locate, registered
from crashhunt.plans._declaration import at_least
from crashhunt.plans._options import Driver, HuntOptions, RunOptions, Spec, Subject, TrialOptions
from crashhunt.plans._settings import RunSettings

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from crashhunt.plans._declaration import Given


__all__ = [
    "Request",
    "SizesItself",
    "executor_of",
    "fields_of",
    "parallel_here",
    "request_of",
    "sized",
    "sizes_itself",
    "spec_words",
]


# ``--executor NAME[:ARG]``: where the trials of a hunt run.


@runtime_checkable
class SizesItself(Protocol):
    """An executor that decides how many trials PARALLEL 0 means, such as one on many machines.

    Elsewhere 0 is one per core of this machine.
    """

    sizes_itself: ClassVar[bool]


def executor_of(word: str) -> Callable[..., Any]:
    """Return what makes the executor that is meant, with its argument where it has one.

    Args:
        word: a registered name or ``module:attribute``, and perhaps ``:ARG``, in which there may be colons.

    Raises:
        PluginError: there is no such executor.
        UsageError: it takes no argument.
    """
    name, argument = _parts(word)
    factory: Callable[..., Any] = locate("executors", name)
    if argument is None:
        return factory
    try:
        parameters = inspect.signature(factory).parameters.values()
    except (TypeError, ValueError):
        parameters = {}.values()
    if not any(known.name == "argument" or known.kind is known.VAR_KEYWORD for known in parameters):
        raise UsageError(f"--executor {word}: {name!r} takes no argument", fix=f"write --executor {name}")

    def make(*args: object, **kwargs: object) -> object:
        return factory(*args, **kwargs, argument=argument)

    return make


def sizes_itself(word: str) -> bool:
    """Whether the named executor decides what PARALLEL 0 means."""
    factory = locate("executors", _parts(word)[0])
    return isinstance(factory, SizesItself) and factory.sizes_itself


def parallel_here(word: str, parallel: int) -> int:
    """Return how many trials, such as confirmations, this machine runs at a time in addition to the executor.

    Args:
        word: as for `executor_of`.
        parallel: PARALLEL; of many machines, this one has not got as many cores.
    """
    cores = len(os.sched_getaffinity(0))
    return min(parallel or cores, cores) if sizes_itself(word) else parallel or cores


def _parts(word: str) -> tuple[str, str | None]:
    first, colon, rest = word.partition(":")
    if first in registered("executors") or not colon:
        return first, rest if colon else None
    attribute, colon, argument = rest.partition(":")
    return f"{first}:{attribute}", argument if colon else None


_BOUNDS = {  # the numbers of a hunt that are no options: everybody has to give them
    "TRIALS": at_least(0),
    "MAX_STEPS": at_least(1),
    "PARALLEL": at_least(0, zero="one per core"),
}


@clear_constructor
@dataclass(frozen=True, kw_only=True)
class Request(TrialOptions, Subject):
    """The request of a user for a hunt. `plan` decides everything else. Options are those of the list.

    Args:
        trials: how many.
        max_steps: the bound on each, in steps.
        agents: agent id to locator; the id may be empty where the scenario has one controlled vehicle.
        arguments: ``NAME`` or ``AGENT.NAME`` to specification.
        scenario_arguments: name to specification.
        run: how it is run.
    """

    trials: int
    max_steps: int
    agents: Mapping[str, str] = field(default_factory=dict)
    arguments: Mapping[str, str] = field(default_factory=dict)
    scenario_arguments: Mapping[str, str] = field(default_factory=dict)
    run: RunSettings = field(default_factory=RunSettings)

    def checked(self) -> Self:
        """Return the same with plain values.

        Raises:
            UsageError: a value cannot be meant.
        """
        for (name, check), value in zip(_BOUNDS.items(), (self.trials, self.max_steps, self.run.parallel), strict=True):
            if not isinstance(value, int) or isinstance(value, bool):
                raise UsageError(f"{name} is {value!r}", fix="give a whole number")
            if fix := check(value):
                raise UsageError(f"{name} is {value}", fix=fix)
        if not self.trials and not self.run.duration and not self.run.until_rate:
            raise UsageError("TRIALS is 0", fix="give at least 1, or 0 (no limit) and a time with --for")
        checked = super().checked()
        run = self.run.checked()
        if run.until_rate and (checked.sampler != "random" or checked.seeds):
            option = "--seeds" if checked.seeds else f"--sampler {checked.sampler}"
            raise UsageError(
                f"--until-rate needs trials that are drawn independently, and {option} does not draw them so",
                fix=f"leave {option} out",
            )
        limits = [limit for limit in (self.trials, run.most) if limit]
        return replace(checked, run=run, trials=min(limits, default=0))


def request_of(asked: HuntOptions, *, trials: int, max_steps: int, parallel: int = 1) -> Request:
    """Return the request for options as they are given in Python or in a ``suite.toml``.

    Raises:
        UsageError: who drives is in no module that a worker could import.
    """
    drivers = {} if asked.agent in (None, "") else {"": asked.agent}
    given: Given = {
        **{name: getattr(asked, name) for name in (*fields_of(Subject), *fields_of(TrialOptions))},
        "agents": {name: _locator(who) for name, who in {**(asked.agents or {}), **drivers}.items() if who is not None},
        "arguments": spec_words(asked.arguments),
        "scenario_arguments": spec_words(asked.scenario_arguments),
    }
    run = RunSettings(parallel=parallel, **{name: getattr(asked, name) for name in fields_of(RunOptions)})
    return Request(trials=trials, max_steps=max_steps, run=run, **given)


def sized(run: RunSettings) -> RunSettings:
    """Return what 0 trials at a time means: one per core of this machine, unless the executor knows better.

    Raises:
        PluginError: there is no such executor.
        UsageError: it takes no argument.
    """
    executor_of(run.executor)  # before anything runs
    if run.parallel or sizes_itself(run.executor):
        return run
    return replace(run, parallel=len(os.sched_getaffinity(0)))


def fields_of(kind: type) -> tuple[str, ...]:
    """Return the names of the fields of a dataclass."""
    return tuple(item.name for item in fields(kind))


def _locator(who: Driver) -> str:
    if isinstance(who, str):
        return who
    module, name = getattr(who, "__module__", ""), getattr(who, "__qualname__", "")
    if module in ("", "__main__") or not name or "<" in name:
        raise UsageError(
            f"{name or who!r} is in no module that a worker could import",
            fix="put it into a file of its own, and give it from there or as 'module:attribute'",
        )
    return f"{module}:{name}"


def spec_words(given: Mapping[str, Spec] | None) -> dict[str, str]:
    """Return specifications as they are written on the command line."""
    return {name: str(spec).lower() if isinstance(spec, bool) else str(spec) for name, spec in (given or {}).items()}
