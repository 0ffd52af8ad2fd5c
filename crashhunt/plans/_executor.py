"""``--executor NAME[:ARG]``: where the trials of a hunt run."""

from __future__ import annotations

import inspect
import os
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

from crashhunt.base.errors import UsageError
from crashhunt.base.plugins import locate, registered

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["SizesItself", "executor_of", "parallel_here", "sizes_itself"]


@runtime_checkable
class SizesItself(Protocol):
    """An executor that finds out itself how many trials PARALLEL 0 stands for, as one of many machines has to.

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
    """Whether the executor that is meant finds out itself what PARALLEL 0 stands for."""
    factory = locate("executors", _parts(word)[0])
    return isinstance(factory, SizesItself) and factory.sizes_itself


def parallel_here(word: str, parallel: int) -> int:
    """Return how many trials at a time this machine runs beside the executor that is meant, such as confirmations.

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
