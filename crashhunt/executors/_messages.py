"""The shapes of what a hunt and its processes tell each other, as JSON.

A replay talks to the crashhunt of a snapshot, so what earlier versions did not say need not be there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NotRequired, TypeAlias, TypedDict, final

from crashhunt.base.plain import ErrorData, ErrorWords

if TYPE_CHECKING:
    from crashhunt.episode import SettingsData
    from crashhunt.trial import ResultData, SpecData

__all__ = [
    "Answer",
    "Done",
    "ForkServerJob",
    "FreshJob",
    "FromForkServer",
    "FromZygote",
    "KillTrial",
    "Lost",
    "ToForkServer",
]


@final
class Done(TypedDict):
    """What came of a trial; ``notices`` are for people, ``retires`` says that the supervisor runs no other trial."""

    result: ResultData
    notices: NotRequired[list[str]]
    retires: NotRequired[bool]


@final
class Lost(TypedDict):
    """A trial that was ended from outside: the exit code of its process."""

    lost: int


Answer: TypeAlias = Done | Lost | ErrorData
"""What a supervisor says at the end of a trial."""


class FreshJob(TypedDict):
    """What a fresh process is to do, and into which file its answer goes."""

    settings: SettingsData
    spec: SpecData
    answer: str


class ForkServerJob(TypedDict):
    """What a fork server needs to know; ``late`` where every trial imports its agents itself.

    ``sys_path`` is empty where crashhunt itself comes from the snapshot, as its environment says.
    """

    settings: SettingsData
    sys_path: list[str]
    late: bool


class ToForkServer(TypedDict, total=False):
    """What the pool asks of its fork server: the supervisor of a slot to be started, or to be killed."""

    slot: int
    kill: int


class FromForkServer(TypedDict, total=False):
    """What a fork server says: that it is ready, cannot fork, or fails; and which supervisor has ended, and how."""

    ready: int
    unfit: bool
    error: ErrorWords
    slot: int
    pid: int
    exit_code: int


class KillTrial(TypedDict):
    """A supervisor asks its zygote to kill the process of the trial that runs."""

    kill: bool


class FromZygote(TypedDict, total=False):
    """What a zygote says: that it is ready or why it cannot be; how the process of a trial ended.

    ``unfit`` says that files of the simulator have changed, so that no other trial may begin from this zygote.
    """

    ready: int
    error: ErrorWords
    pid: int
    ended: int
    unfit: bool
    notices: list[str]
