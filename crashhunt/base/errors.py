"""Every error that crashhunt raises on purpose.

::

    CrashhuntError                 exit code 2 unless stated otherwise
    ├── UsageError                 a command line, call or setting that is not valid
    │   ├── ArgumentError          an argument specification or value
    │   ├── FormulaError           a requirement that is not a formula; shows the place
    │   ├── CallError              a call from Python with unknown or missing arguments; a TypeError as well
    │   └── UntrustedError         code that this user has neither made on this machine nor trusted
    ├── ScenarioError              a scenario file: which file, which key, which value
    │   └── NoValidTrialError      no trial in it can be set up; exit code 3
    ├── PluginError                a name or ``module:attribute`` that leads nowhere
    │   └── HuntWhileImportingError  a module that runs trials when it is imported
    ├── HuntDirectoryError         the directory of a hunt: busy, foreign, unwritable, full
    │   └── BusyError              another hunt is running in it
    ├── BundleError                a crash bundle or log that is damaged or incomplete
    ├── SnapshotError              the code of a hunt cannot be captured: too large, unreadable
    ├── RecorderError              a trial could not be recorded: a full disk
    ├── HostError                  a folder that trials need is gone, or a disk is full; no result of a trial
    ├── WorkerError                the process of a trial refused it, or ended before it began
    ├── InternalError              crashhunt itself failed, not the code of a user
    └── EpisodeError               raised inside an episode; becomes the trial's outcome
        ├── InvalidEpisodeError    the episode could not be set up
        ├── ActionError            the agent returned something outside its action space
        ├── ProgramError           the program of an agent has failed, or breaks the protocol
        ├── UnusableValueError     a value of the user's code is neither a bool nor a number; ends the hunt
        └── SimulatorError         the simulator failed
"""

from __future__ import annotations

import errno
from typing import TYPE_CHECKING

from crashhunt.base.text import command_line, one_line

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.base.json_types import ErrorData

FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Error numbers of an `OSError` where a disk, or the user's quota on it, is full."""

DISK = FULL | {errno.EIO, errno.EROFS}
"""Error numbers of an `OSError` that a disk causes, in contrast to code that closes or leaks file descriptors."""


class CrashhuntError(Exception):
    """An error: a message, the fix, and the place of the problem.

    Args:
        message: description of the problem, with the offending value; or an error to copy.
        fix: the fix, as an instruction to the user.
        where: the file, key or option with the problem.
    """

    exit_code = 2
    excerpt = ""
    """Lines that show the place of the problem; empty if the place is not inside a text."""

    def __init__(self, message: str | CrashhuntError, *, fix: str = "", where: str = "") -> None:
        if isinstance(message, CrashhuntError):  # Gymnasium's AsyncVectorEnv raises `type(error)(error)`
            copied: tuple[str, str, str] = message.args
            message, fix, where = copied[0], fix or copied[1], where or copied[2]
        super().__init__(message, fix, where)
        self.message: str = message
        self.fix = fix
        self.where = where

    def __str__(self) -> str:
        """Return the whole error as one line, and below it the lines that show the place, if there are any."""
        return f"{self.line}\n{self.excerpt}" if self.excerpt else self.line

    @property
    def line(self) -> str:
        """The whole error as one line: ``where: message; fix``."""
        # A path with a line break is quoted, because it would be another path if the line break became a space.
        where = self.where if one_line(self.where) == self.where else command_line(self.where)
        text = f"{where}: {self.message}" if where else self.message
        return f"{text}; {self.fix}" if self.fix else text

    def explain(self, fix: str, shown: Callable[[str], str]) -> None:
        """Replace the fix, unless the new one is empty, and convert message and place for the user."""
        self.message, self.fix, self.where = shown(self.message), fix or self.fix, shown(self.where)
        self.args = (self.message, self.fix, self.where)

    def __reduce__(self) -> tuple[object, ...]:
        """Keep the three parts when the error crosses a process boundary."""
        return _rebuild, (type(self), self.message, self.fix, self.where)

    def to_json(self) -> ErrorData:
        """Return the error in the form that every command prints with ``--json``."""
        return {"error": {"message": self.message, "fix": self.fix, "where": self.where}}

    @classmethod
    def from_json(cls, data: ErrorData) -> CrashhuntError:
        """Rebuild an error from the data of `to_json` of any version."""
        said = data["error"]
        parts = {"fix": str(said.get("fix", "")), "where": str(said.get("where", ""))}
        if said.get("traceback"):
            fault = InternalError(str(said.get("message", "")), **parts)
            fault.traceback = str(said["traceback"])
            return fault
        return cls(str(said.get("message", "")), **parts)


def _rebuild(kind: type[CrashhuntError], message: str, fix: str, where: str) -> CrashhuntError:
    return kind(message, fix=fix, where=where)


class UsageError(CrashhuntError):
    """A command line, call or setting that is not valid."""


class ArgumentError(UsageError):
    """An argument specification or value that cannot be used."""


_MAX_EXCERPT = 60  # characters on each side of the place, so that the lines fit a terminal


class FormulaError(UsageError):
    """A requirement that is not a formula.

    Args:
        message: description of the problem.
        fix: the fix, as an instruction to the user.
        where: the option or key of the requirement.
        text: the text of the requirement; empty if the problem has no place in it.
        begin: first character of the place.
        end: character after the last of the place.
    """

    def __init__(
        self, message: str | CrashhuntError, *, fix: str = "", where: str = "", text: str = "", begin: int = 0,
        end: int = 0,
    ) -> None:  # fmt: skip
        super().__init__(message, fix=fix, where=where)
        if text:
            first, end = max(0, begin - _MAX_EXCERPT), min(end, begin + _MAX_EXCERPT)
            # One visible character for each of the text, so that the caret is below its place.
            shown = "".join(char if char.isprintable() else " " for char in text[first : end + _MAX_EXCERPT])
            self.excerpt = f"  {shown}\n  {' ' * (begin - first)}{'^' * max(1, end - begin)}"


class CallError(UsageError, TypeError):
    """A call from Python with an unknown argument, or without a required one."""


class UntrustedError(UsageError):
    """Code would run that this user has neither made on this machine nor trusted."""


class ScenarioError(CrashhuntError):
    """A scenario that cannot be used."""


class NoValidTrialError(ScenarioError):
    """No trial in a scenario can be set up."""

    exit_code = 3


class PluginError(CrashhuntError):
    """A plugin name or ``module:attribute`` that cannot be found or imported."""


class HuntWhileImportingError(PluginError):
    """A module runs trials at its top level, so every process that imports it would run them again."""


class HuntDirectoryError(CrashhuntError):
    """The directory of a hunt is in use, belongs to something else, or cannot be written, or the disk is full."""


class BusyError(HuntDirectoryError):
    """Another hunt is running in the directory."""


class BundleError(CrashhuntError):
    """A crash bundle or log that is damaged or incomplete."""


class SnapshotError(CrashhuntError):
    """The code of a hunt cannot be captured."""


class RecorderError(CrashhuntError):
    """A trial could not be recorded."""


class HostError(CrashhuntError):
    """A condition on this machine under which trials can run no longer holds, such as the existence of a folder."""


class WorkerError(CrashhuntError):
    """The process of a trial refused the trial, or ended before it began."""


class InternalError(CrashhuntError):
    """A failure of crashhunt itself: a defect to report, which ends a hunt.

    Attributes:
        traceback: The traceback, for the bug report.
    """

    traceback = ""

    def to_json(self) -> ErrorData:
        """Return the JSON form of every error, with the traceback added."""
        data = super().to_json()
        data["error"]["traceback"] = self.traceback
        return data

    def __reduce__(self) -> tuple[object, ...]:
        """Keep the traceback when the error crosses a process boundary."""
        return _rebuild, (type(self), self.message, self.fix, self.where), {"traceback": self.traceback}


class EpisodeError(CrashhuntError):
    """An error inside an episode, which becomes the outcome of the trial."""


class InvalidEpisodeError(EpisodeError):
    """The episode could not be set up."""


class ActionError(EpisodeError):
    """The agent returned something outside its action space."""


class ProgramError(EpisodeError):
    """The program of an agent has failed, or has sent something that the protocol does not contain."""


class UnusableValueError(EpisodeError):
    """A value of the user's code that crashhunt compares is neither a bool nor a number."""


class SimulatorError(EpisodeError):
    """The simulator failed."""


def remedy(error: OSError) -> str:
    """Return the fix for an error of the operating system, as an instruction to the user.

    The result is empty if the user can do nothing, for example for a broken pipe between two processes of crashhunt.
    """
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return "raise the limit on open files (ulimit -n), and run the same command again"
    if error.errno == errno.EFBIG:
        return "raise the limit on the size of a file (ulimit -f), and run the same command again"
    if error.errno in (errno.EAGAIN, errno.ENOMEM):
        return "leave it more processes (ulimit -u) or memory (ulimit -v), and run the same command again"
    if error.errno in DISK | {errno.EACCES, errno.EPERM}:
        return "free some space or make the folder writable, and run the same command again"
    return "see to that file or folder, and run the same command again" if error.filename is not None else ""
