"""Messages of protocol 1, which crashhunt and the program of an agent exchange."""

from __future__ import annotations

from typing import Any, Literal, NotRequired, TypedDict


class SpaceDescription(TypedDict):
    """The form of one part of an observation, or of an action.

    ``bounds`` has the least and the greatest value of each number; null if there is no bound. ``meanings`` has the name
    of each number of a discrete action.
    """

    shape: list[int]
    columns: list[str]
    units: list[str]
    bounds: NotRequired[list[list[float | None] | None]]
    meanings: NotRequired[list[str]]


class Hello(TypedDict):
    """The first message to a program."""

    type: Literal["hello"]
    protocol: Literal[1]
    agent: str
    arguments: dict[str, bool | int | float | str]
    observation: dict[str, SpaceDescription]
    action: SpaceDescription
    step_length_s: float


class Reset(TypedDict):
    """The beginning of an episode."""

    type: Literal["reset"]
    seed: int


class Observe(TypedDict):
    """An observation as nested lists, or as an object of these; ``step`` counts from 0 in each episode."""

    type: Literal["observe"]
    step: int
    time_s: float
    observation: Any


class Close(TypedDict):
    """The last message to a program, which then ends."""

    type: Literal["close"]


class DeclaredArgument(TypedDict, total=False):
    """An argument that a program declares; ``range`` is written as in ``--arg NAME=SPEC``."""

    range: str
    unit: str
    default: bool | int | float | str


class Ready(TypedDict):
    """The answer to ``hello``.

    ``observation`` lists the parts that the program observes, and ``action`` is the form of its actions, if neither the
    command line nor the scenario names others.
    """

    type: Literal["ready"]
    protocol: NotRequired[Literal[1]]
    format: NotRequired[Literal["json", "msgpack"]]
    arguments: NotRequired[dict[str, DeclaredArgument]]
    observation: NotRequired[list[str]]
    action: NotRequired[str]
    revision: NotRequired[str]


class Ok(TypedDict):
    """The answer to ``reset``."""

    type: Literal["ok"]


class Act(TypedDict):
    """The answer to ``observe``."""

    type: Literal["act"]
    action: Any
    panels: NotRequired[Any]


ProgramRequest = Hello | Reset | Observe | Close
"""A message to a program."""

ProgramAnswer = Ready | Ok | Act
"""A message from a program."""
