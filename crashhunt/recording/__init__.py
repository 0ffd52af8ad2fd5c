"""Recordings: the black box while it happens, ``log.mcap`` of what is kept, and the comparison of two.

Writing and reading logs needs MCAP and protobuf, which a worker never does: they are imported at first use.
"""

from typing import TYPE_CHECKING, Any

from crashhunt.recording._blackbox import (
    DISK,
    BlackBox,
    BlackBoxHeader,
    Phase,
    Record,
    Tag,
    read_black_box,
    read_header,
)
from crashhunt.recording._compare import Divergence, first_divergence, values_around
from crashhunt.recording._recording import (
    AgentChannel,
    Prologue,
    Recording,
    StepRecord,
    digest_of,
    encode_actors,
    encode_events,
    encode_heights,
    encode_notes,
    encode_spines,
)

if TYPE_CHECKING:
    from crashhunt.recording._log import read_log, write_log
    from crashhunt.recording._views import foxglove_layout, lane_borders, read_lanes

__all__ = [
    "DISK",
    "AgentChannel",
    "BlackBox",
    "BlackBoxHeader",
    "Divergence",
    "Phase",
    "Prologue",
    "Record",
    "Recording",
    "StepRecord",
    "Tag",
    "digest_of",
    "encode_actors",
    "encode_events",
    "encode_heights",
    "encode_notes",
    "encode_spines",
    "first_divergence",
    "foxglove_layout",
    "lane_borders",
    "read_black_box",
    "read_header",
    "read_lanes",
    "read_log",
    "values_around",
    "write_log",
]


def __getattr__(name: str) -> Any:
    if name in ("read_log", "write_log"):
        from crashhunt.recording import _log

        return getattr(_log, name)
    if name in ("foxglove_layout", "lane_borders", "read_lanes"):
        from crashhunt.recording import _views

        return getattr(_views, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
