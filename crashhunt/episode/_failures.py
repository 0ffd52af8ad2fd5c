"""What is told of an exception, however it is made: an agent's may be of any class and any size."""

from __future__ import annotations

import sys
import traceback
from contextlib import suppress
from typing import TYPE_CHECKING

from crashhunt.agents import Closes
from crashhunt.base.errors import ActionError, EpisodeError, InvalidEpisodeError, SimulatorError
from crashhunt.base.faculties import offers
from crashhunt.base.limits import limit_behind
from crashhunt.trial import Failure

if TYPE_CHECKING:
    from typing import Final

    from crashhunt.agents import Agent

__all__ = ["close_agent", "failure_of", "is_emptied", "words_of"]

# Whatever is longer nobody reads, and everybody would have to carry: from the worker to the hunt, into the ledger, into
# every bundle and page. Fifty megabytes of it take longer than a trial may.
_NAME: Final = 200
_MESSAGE: Final = 10_000
_TRACEBACK: Final = 100_000

_KINDS: dict[type[BaseException], str] = {
    ActionError: "bad action",
    InvalidEpisodeError: "invalid",
    SimulatorError: "simulator error",
}


def failure_of(error: BaseException, agent: str) -> Failure:
    """Return what a result says about an exception.

    Args:
        error: the exception. Message and traceback are cut where they are longer than anybody reads, and say so.
        agent: whose it is; empty for nobody's.
    """
    # A message of our own says everything; where in our code it was raised is nobody's business.
    text = "" if isinstance(error, InvalidEpisodeError) else "".join(traceback.format_exception(error))
    words = words_of(error)
    if len(words) > _MESSAGE:
        words = f"{words[:_MESSAGE]}… ({len(words) - _MESSAGE} more characters are left out)"
    message = words if isinstance(error, EpisodeError) else " ".join(words.split())
    if limit := limit_behind(error):
        message = f"{message} ({limit})" if message else limit
    if is_emptied():
        message = f"somebody has emptied sys.modules, upon which this fails: {message}"
    return Failure(_KINDS.get(type(error), type(error).__name__[:_NAME]), message, _shortened(text), agent)


def is_emptied() -> bool:
    """Whether somebody has removed from ``sys.modules`` what Python had imported.

    No simulator does that. What fails next is whatever imports something next, such as NumPy itself.
    """
    return __name__ not in sys.modules


def words_of(error: BaseException) -> str:
    """Return the message of an exception, which may be of a class that cannot even say it."""
    try:
        return str(error)
    except BaseException as other:  # in a ``__str__`` of somebody else's
        return f"(its message cannot be had: {type(other).__name__})"


def _shortened(text: str) -> str:
    """A traceback of bounded length: its beginning says where, and its end what."""
    if len(text) <= _TRACEBACK:
        return text
    half = _TRACEBACK // 2
    return f"{text[:half]}\n… ({len(text) - 2 * half} characters are left out) …\n{text[-half:]}"


def close_agent(agent: Agent) -> None:
    """Close an agent; whatever comes of that, the episode is over."""
    try:
        if offers(agent, Closes):
            agent.close()
    except BaseException:
        with suppress(BaseException):
            traceback.print_exc()
