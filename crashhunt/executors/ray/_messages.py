"""The shapes of what a hunt, its bridge to Ray and the nodes tell each other."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypedDict

if TYPE_CHECKING:
    from crashhunt.base.codec import JsonObject
    from crashhunt.base.json_types import ErrorData, ErrorWords

__all__ = ["BridgeJob", "Ended", "Figures", "FromBridge", "Header", "News", "NodeJob", "Submitted", "ToBridge"]

Submitted = tuple[int, "JsonObject"]
"""A trial, and its ticket: a number that identifies this submission of the trial."""
Header = tuple[int, int, float, int, int, int, int]
"""The values of a `BlackBoxHeader`."""


class BridgeJob(TypedDict):
    """What a bridge needs to know.

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
    """What a node needs to know: ``folders`` there to their places in the parcel, and how many trials at a time.

    ``home`` is the place in the parcel where trials run, as they do in the current folder there; empty for none.
    """

    settings: JsonObject
    recycle_after: int
    digest: str
    folders: dict[str, str]
    home: str
    slots: int


class ToBridge(TypedDict, total=False):
    """What a hunt wants: trials to be run, or those above a number to be given up."""

    submit: list[Submitted]
    cancel: int


class Figures(TypedDict):
    """A node for people who watch: number of trials at a time, how many have ended, and how many a second."""

    name: str
    parallel: int
    trials: int
    rate_per_s: float


class FromBridge(TypedDict, total=False):
    """What a bridge says: a trial has ended, or what has become of nodes.

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


class Ended(NamedTuple):
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
    """What has happened on a node.

    Attributes:
        ended: trials.
        where: number of each running trial to where it is; None if it was not requested.
        notes: notes for people.
        error: why no trial can be run here; None if they can.
        map: map of all trials, when the first one is kept; compressed.
    """

    ended: list[Ended]
    where: dict[int, Header] | None
    notes: list[str]
    error: ErrorData | None
    map: bytes
