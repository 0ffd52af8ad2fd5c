"""The types of records, a file each: tag, codec, topic of the evidence in the log, reading and comparison.

To add one, write its file and name it here; whoever has something to record calls `BlackBox.append` with its tag.
"""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

from crashhunt.recording.records import (
    action,
    actors,
    disturbances,
    events,
    heights,
    lanes,
    notes,
    observation,
    prologue,
    roster,
    spines,
    step,
)

if TYPE_CHECKING:
    from crashhunt.recording.records._type import RecordType

__all__ = ["RECORD_TYPES", "Tag"]

# In the order in which those of one step are compared: what an agent saw and did, what came of it.
RECORD_TYPES: dict[int, RecordType] = {
    module.TYPE.tag: module.TYPE
    for module in (
        prologue,
        actors,
        roster,
        disturbances,
        observation,
        action,
        step,
        events,
        lanes,
        heights,
        spines,
        notes,
    )
}
"""Every type by its tag."""


class Tag(IntEnum):
    """What a record holds, by the names of those that crashhunt itself writes."""

    PROLOGUE = prologue.TYPE.tag
    ACTORS = actors.TYPE.tag
    ROSTER = roster.TYPE.tag
    OBSERVATION = observation.TYPE.tag
    ACTION = action.TYPE.tag
    STEP = step.TYPE.tag
    LANES = lanes.TYPE.tag
    EVENTS = events.TYPE.tag
    HEIGHTS = heights.TYPE.tag
    SPINES = spines.TYPE.tag
    NOTES = notes.TYPE.tag
    DISTURBANCE = disturbances.TYPE.tag
