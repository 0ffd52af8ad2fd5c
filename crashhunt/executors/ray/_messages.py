"""The messages between a hunt, its bridge to Ray, and the nodes."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypedDict

if TYPE_CHECKING:
    from crashhunt.base.codec import JsonObject
    from crashhunt.base.json_types import ErrorData, ErrorWords

Submitted = tuple[int, "JsonObject"]
"""A trial, and its ticket: a number that identifies this submission of the trial."""
Header = tuple[int, int, float, int, int, int, int]
"""The values of a `BlackBoxHeader`."""


class BridgeJob(TypedDict):
    """The settings of a bridge: the trials' settings, the cluster, and the number of parallel trials.

    ``address`` is empty for the hunt's own cluster, which has ``cpus`` CPUs and keeps its files in ``temporary``.
    ``versions`` and ``code`` must be equal on nodes. ``resumed`` is true if an earlier bridge of the same hunt had
    nodes.
    """

    settings: JsonObject
    parallel: int
    address: str
    cpus: int
    temporary: str | None
    versions: dict[str, str]
    code: str
    resumed: bool


class NodeJob(TypedDict):
    """The job of a node: the places of ``folders`` in the archive, and the number of trials at a time.

    ``home`` is the place in the archive in which trials run, instead of the current folder of the hunt; empty for none.
    """

    settings: JsonObject
    digest: str
    folders: dict[str, str]
    home: str
    slots: int


class ToBridge(TypedDict, total=False):
    """A request of a hunt to its bridge: run trials, or cancel the trials above a number."""

    submit: list[Submitted]
    cancel: int


class FromBridge(TypedDict, total=False):
    """A message of a bridge to the hunt: a trial has ended, or the state of a node has changed.

    ``passing`` marks an error that may be gone at the next attempt, ``token`` an error because of a missing token.
    ``nodes`` has the fields of `NodeFigures`. ``where`` is the progress of trials on a ``node``.
    """

    ticket: int
    result: JsonObject
    error: ErrorWords
    passing: bool
    token: bool
    capacity: int
    note: str
    nodes: list[JsonObject]
    node: str
    where: dict[int, Header]


class NodeTrial(NamedTuple):
    """A trial that has ended on a node."""

    ticket: int  # ticket with which the trial was submitted
    number: int  # number of the trial in the hunt
    line: bytes  # the message for the hunt, which the bridge forwards without reading it
    files: dict[str, bytes]  # compressed files of the trial's scratch folder by name, if the trial is kept


class News(NamedTuple):
    """The events on a node since the previous call."""

    ended: list[NodeTrial]  # trials that have ended
    where: dict[int, Header] | None  # progress of each running trial, by number; None if it was not requested
    notes: list[str]  # texts for the user
    error: ErrorData | None  # reason why no trial can run on the node; None if trials can run
    map: bytes  # compressed map of all trials, sent with the first kept trial
