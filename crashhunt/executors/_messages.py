"""The shapes of what a hunt and its processes tell each other, as JSON.

A replay talks to the crashhunt of a snapshot, so what earlier versions did not say need not be there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NotRequired, TypeAlias, TypedDict, final

from crashhunt.base.plain import ErrorData, ErrorWords

if TYPE_CHECKING:
    from crashhunt.episode import SettingsData
    from crashhunt.trial import ResultData, SpecData

__all__ = ["Answer", "Damaged", "Done", "FreshJob", "FromTemplate", "TemplateJob", "ToTemplate"]


@final
class Done(TypedDict):
    """What came of a trial; ``change`` is what it has left behind in its process, empty where that is nothing."""

    result: ResultData
    change: NotRequired[str]


@final
class Damaged(TypedDict):
    """A worker that its trial has broken, and how that showed."""

    damaged: str


Answer: TypeAlias = Done | Damaged | ErrorData
"""What a process says at the end of a trial."""


class FreshJob(TypedDict):
    """What a fresh process is to do, and into which file its answer goes."""

    settings: SettingsData
    spec: SpecData
    answer: str


class TemplateJob(TypedDict):
    """What a template needs to know; ``late`` where its workers import agents themselves."""

    settings: SettingsData
    sys_path: list[str]
    late: bool


class ToTemplate(TypedDict, total=False):
    """What the pool asks of its template: the worker of a slot to be forked, or to be killed."""

    slot: int
    kill: int


class FromTemplate(TypedDict, total=False):
    """What a template says: that it is ready, cannot fork, or fails; and which worker has ended, and how."""

    ready: int
    unfit: bool
    error: ErrorWords
    slot: int
    pid: int
    exit_code: int
