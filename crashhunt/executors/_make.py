"""The executor that a hunt asks for."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base.blame import blamed
from crashhunt.base.errors import CrashhuntError
from crashhunt.plans import executor_of

if TYPE_CHECKING:
    from crashhunt.episode import WorkerSettings
    from crashhunt.executors._protocol import Executor

__all__ = ["make_executor"]


def make_executor(word: str, settings: WorkerSettings, *, parallel: int, recycle_after: int) -> Executor:
    """Make the executor that ``--executor`` names.

    Raises:
        PluginError: there is no such executor, or it fails in a way of its own.
        CrashhuntError: it says why no trial could run.
    """
    factory = executor_of(word)
    try:
        made: Executor = factory(settings, parallel=parallel, recycle_after=recycle_after)
    except CrashhuntError:
        raise
    except Exception as error:  # somebody's own
        raise blamed(f"the executor {word!r} cannot be made", error) from error
    return made
