"""Recordings: the black box while it happens, ``log.mcap`` of what is kept, and the comparison of two."""

from crashhunt.recording._blackbox import BlackBox, BlackBoxHeader, Phase, Record, Tag, read_black_box, read_header
from crashhunt.recording._compare import Divergence, first_divergence
from crashhunt.recording._recording import (
    AgentChannel,
    Prologue,
    Recording,
    StepRecord,
    digest_of,
    encode_actors,
    encode_events,
)

__all__ = [
    "AgentChannel",
    "BlackBox",
    "BlackBoxHeader",
    "digest_of",
    "Divergence",
    "encode_actors",
    "encode_events",
    "first_divergence",
    "Phase",
    "Prologue",
    "read_black_box",
    "read_header",
    "Record",
    "Recording",
    "StepRecord",
    "Tag",
]
