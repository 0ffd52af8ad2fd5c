"""The option ``--executor NAME[:ARG]``: where the trials of a hunt run, and how many at a time."""

from __future__ import annotations

import inspect
import os
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

from crashhunt.base.errors import UsageError
from crashhunt.base.plugins import locate, registered

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.plans._settings import RunSettings


@runtime_checkable
class ChoosesParallelism(Protocol):
    """An executor that decides how many trials run at a time if PARALLEL is 0, such as an executor on many machines.

    For other executors, PARALLEL 0 means one trial per core of this machine.
    """

    sizes_itself: ClassVar[bool]


def executor_of(word: str) -> Callable[..., Any]:
    """Return the factory of the named executor, with the executor's argument if there is one.

    The word may end with ``:ARG``, which may contain colons.

    Raises:
        PluginError: the executor does not exist.
        UsageError: the executor takes no argument.
    """
    name, argument = _name_and_argument(word)
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


def executor_name(word: str) -> str:
    """Return the executor's name or ``module:attribute`` without its argument ``:ARG``; no module is imported."""
    return _name_and_argument(word)[0]


def sizes_itself(word: str) -> bool:
    """Return whether the named executor decides how many trials run at a time if PARALLEL is 0."""
    factory = locate("executors", executor_name(word))
    return isinstance(factory, ChoosesParallelism) and factory.sizes_itself


def parallel_here(word: str, parallel: int) -> int:
    """Return how many trials this machine runs at a time in addition to the executor, for example for confirmations.

    Args:
        word: choice of an executor, as for `executor_of`.
        parallel: the value of PARALLEL; for an executor on many machines, this machine may have fewer cores.
    """
    cores = len(os.sched_getaffinity(0))
    return min(parallel or cores, cores) if sizes_itself(word) else parallel or cores


def _name_and_argument(word: str) -> tuple[str, str | None]:
    first, colon, rest = word.partition(":")
    if first in registered("executors") or not colon:
        return first, rest if colon else None
    attribute, colon, argument = rest.partition(":")
    return f"{first}:{attribute}", argument if colon else None


def sized(run: RunSettings) -> RunSettings:
    """Return the settings with a number of parallel trials in place of 0: one per core, unless the executor decides.

    Raises:
        PluginError: the executor does not exist.
        UsageError: the executor takes no argument.
    """
    executor_of(run.executor)  # before anything runs
    if run.parallel or sizes_itself(run.executor):
        return run
    return replace(run, parallel=len(os.sched_getaffinity(0)))
