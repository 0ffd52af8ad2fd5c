"""The first copy of a running episode: after one step it is known whether there can be any."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.forks import NoProcessError

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.episode._episode import Episode
    from crashhunt.trial import TrialResult

__all__ = ["FirstCopy"]


class FirstCopy:
    """Copies the first episode of a process after its first step, and does nothing with that.

    Args:
        refused: called with why it could not be copied, in words.
    """

    def __init__(self, refused: Callable[[str], None]) -> None:
        self._refused = refused
        self._tried = False

    def is_due(self, episode: Episode) -> bool:
        """Whether it has not been tried."""
        return not self._tried and episode.steps > 0

    def ask(self, episode: Episode) -> None:
        """Try it."""
        try:
            episode.fork(lambda _copy: {}, observed=False).end()
        except NoProcessError:
            return  # which says nothing about the trial: the next step tries again
        except CrashhuntError as error:
            self._refused(error.message)
        self._tried = True

    def result(self, result: TrialResult) -> TrialResult:
        """Return it as it is."""
        return result
