"""The messages between a hunt, its bridge to Ray, and the nodes."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypedDict

if TYPE_CHECKING:
    from crashhunt.base.codec import JsonObject
    from crashhunt.base.json_types import ErrorData, ErrorWords

__all__ = ["BridgeJob", "EndedTrial", "Figures", "FromBridge", "Header", "News", "NodeJob", "Submitted", "ToBridge"]

Submitted = tuple[int, "JsonObject"]
"""A trial, and its ticket: a number that identifies this submission of the trial."""
Header = tuple[int, int, float, int, int, int, int]
"""The values of a `BlackBoxHeader`."""


class BridgeJob(TypedDict):
    """The job of a bridge.

    ``address`` is empty for a cluster of the hunt's own, which has ``cpus`` CPUs and ``temporary`` files. ``versions``
    and ``code`` are the requirements for nodes. ``resumed`` is true if an earlier bridge of the same hunt had nodes.
    """

    settings: JsonObject
    parallel: int
    recycle_after: int
    address: str
    cpus: int
    temporary: str | None
    versions: dict[str, str]
    code: str
    resumed: bool


class NodeJob(TypedDict):
    """The job of a node: ``folders`` to their places in the parcel, and the number of trials at a time.

    ``home`` is the place in the parcel where trials run, as they do in the current folder there; empty for none.
    """

    settings: JsonObject
    recycle_after: int
    digest: str
    folders: dict[str, str]
    home: str
    slots: int


class ToBridge(TypedDict, total=False):
    """A request of a hunt: run trials, or cancel those above a number."""

    submit: list[Submitted]
    cancel: int


class Figures(TypedDict):
    """A node on the status screen: trials at a time, ended trials, and trials per second."""

    name: str
    parallel: int
    trials: int
    rate_per_s: float


class FromBridge(TypedDict, total=False):
    """A message of a bridge: a trial has ended, or the state of a node has changed.

    ``passing`` belongs to an error that may be over at the next attempt, ``token`` to one for want of a token;
    ``where`` belongs to a ``node``.
    """

    ticket: int
    result: JsonObject
    error: ErrorWords
    passing: bool
    token: bool
    capacity: int
    note: str
    nodes: list[Figures]
    node: str
    where: dict[int, Header]


class EndedTrial(NamedTuple):
    """A trial that has ended on a node.

    Attributes:
        ticket: ticket under which it was submitted.
        number: number of the trial.
        line: the message for the hunt, which no process in between reads.
        files: files of its scratch folder where it is kept, by name, compressed.
    """

    ticket: int
    number: int
    line: bytes
    files: dict[str, bytes]


class News(NamedTuple):
    """The events on a node since the last call.

    Attributes:
        ended: trials.
        where: number of each running trial to where it is; None if it was not requested.
        notes: notes for people.
        error: why no trial can be run here; None if they can.
        map: map of all trials, when the first one is kept; compressed.
    """

    ended: list[EndedTrial]
    where: dict[int, Header] | None
    notes: list[str]
    error: ErrorData | None
    map: bytes
