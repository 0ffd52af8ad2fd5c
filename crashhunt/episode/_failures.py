"""What is told of an exception, however it is made: an agent's may be of any class and any size."""

from __future__ import annotations

import sys
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from crashhunt.agents import Closes
from crashhunt.base.errors import ActionError, EpisodeError, InvalidEpisodeError, SimulatorError
from crashhunt.base.exception_text import class_name, format_error, message_of
from crashhunt.base.faculties import offers
from crashhunt.base.signals import blocked_signals
from crashhunt.trial import Failure

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Final

    from crashhunt.agents import Agent

__all__ = ["close_agent", "failure_of", "is_emptied", "words_of"]

_MIN_RECURSION_LIMIT: Final = 1000
_KINDS: tuple[tuple[type[BaseException], str], ...] = (
    (ActionError, "bad action"),
    (InvalidEpisodeError, "invalid"),
    (SimulatorError, "simulator error"),
)


def failure_of(error: BaseException, agent: str, *, cause: str = "") -> Failure:
    """Return what a result says about an exception.

    Args:
        error: the exception. Message and traceback are cut where they are longer than anybody reads, and say so.
        agent: whose it is; empty for nobody's.
        cause: why it was raised, where its message does not say so, as a clause; empty where it does.
    """
    with blocked_signals(), _deep_enough():
        # A message of our own says everything; where in our code it was raised is nobody's business.
        text = "" if issubclass(type(error), InvalidEpisodeError) else format_error(error)
        words = words_of(error)
        # A class of a user's may have a metaclass of any kind, so nothing is looked up by it.
        kind = next((kind for one, kind in _KINDS if type(error) is one), None) or class_name(error)
    message = words if issubclass(type(error), EpisodeError) else " ".join(words.split())
    if not cause and is_emptied():
        cause = "somebody has emptied sys.modules"
    return Failure(kind, f"{cause}, upon which this fails: {message}" if cause else message, text, agent)


@contextmanager
def _deep_enough() -> Iterator[None]:
    """Have Python recurse as deep as it does by default, whatever an agent has set."""
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(max(limit, _MIN_RECURSION_LIMIT))
    try:
        yield
    finally:
        with suppress(RecursionError):
            sys.setrecursionlimit(limit)


def is_emptied() -> bool:
    """Whether somebody has removed from ``sys.modules`` what Python had imported.

    No simulator does that. What fails next is whatever imports something next, such as NumPy itself.
    """
    return __name__ not in sys.modules


def words_of(error: BaseException) -> str:
    """Return the message of an exception, which may be of a class that cannot even say it; a long one is cut."""
    return message_of(error)


def close_agent(agent: Agent) -> None:
    """Close an agent; whatever comes of that, the episode is over."""
    try:
        if offers(agent, Closes):
            agent.close()
    except BaseException as error:
        with suppress(BaseException):
            sys.stderr.write(format_error(error))
