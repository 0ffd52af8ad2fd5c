"""The types of records, each with its tag, codec, topic in the log, reading and comparison.

To add a type, define a `RecordType` in one of the modules here, list it in `RECORD_TYPES`, and call `BlackBox.append`
with its tag and the data to record.
"""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

from crashhunt.recording.records._agent_records import ACTION, OBSERVATION, PROLOGUE
from crashhunt.recording.records._scene_record import (
    ACTORS,
    DISTURBANCES,
    EVENTS,
    HEIGHTS,
    LANES,
    NOTES,
    ROSTER,
    SPINES,
    STEP,
)

if TYPE_CHECKING:
    from crashhunt.recording.records._type import RecordType

# In the order in which those of one step are compared: what an agent saw and did, the result.
RECORD_TYPES: dict[int, RecordType] = {
    kind.tag: kind
    for kind in (
        PROLOGUE,
        ACTORS,
        ROSTER,
        DISTURBANCES,
        OBSERVATION,
        ACTION,
        STEP,
        EVENTS,
        LANES,
        HEIGHTS,
        SPINES,
        NOTES,
    )
}
"""Every type by its tag."""


class Tag(IntEnum):
    """The tags of the record types that crashhunt writes."""

    PROLOGUE = PROLOGUE.tag
    ACTORS = ACTORS.tag
    ROSTER = ROSTER.tag
    OBSERVATION = OBSERVATION.tag
    ACTION = ACTION.tag
    STEP = STEP.tag
    LANES = LANES.tag
    EVENTS = EVENTS.tag
    HEIGHTS = HEIGHTS.tag
    SPINES = SPINES.tag
    NOTES = NOTES.tag
    DISTURBANCE = DISTURBANCES.tag
