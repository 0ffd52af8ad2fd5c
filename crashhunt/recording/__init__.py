"""Recordings: the black box during a trial, ``log.mcap`` of kept trials, and the comparison of two recordings.

Writing and reading logs needs MCAP and protobuf, which a worker never does, so these libraries are imported at first
use.
"""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._blackbox import BlackBox as BlackBox, Phase as Phase, is_evidence as is_evidence
    from ._blackbox_file import (
        BlackBoxFile as BlackBoxFile,
        BlackBoxHeader as BlackBoxHeader,
        read_black_box as read_black_box,
        read_header as read_header,
    )
    from ._first_difference import (
        first_divergence as first_divergence,
        has_same_scenes as has_same_scenes,
        values_around as values_around,
    )
    from ._foxglove import (
        foxglove_layout as foxglove_layout,
        lane_borders as lane_borders,
        read_lanes as read_lanes,
        read_obstacles as read_obstacles,
    )
    from ._log import read_log as read_log, write_log as write_log
    from ._reading import (
        AgentChannel as AgentChannel,
        Divergence as Divergence,
        ObservedPart as ObservedPart,
        Prologue as Prologue,
        StepRecord as StepRecord,
    )
    from ._recording import Recording as Recording
    from ._trace_digest import digest_of as digest_of
    from ._values import (
        OPAQUE_SHAPE as OPAQUE_SHAPE,
        decode_value as decode_value,
        describe_value as describe_value,
        encode_value as encode_value,
        is_opaque as is_opaque,
    )
    from .records import Tag as Tag
    from .records._scene_record import (
        encode_actors as encode_actors,
        encode_disturbance as encode_disturbance,
        encode_events as encode_events,
        encode_heights as encode_heights,
        encode_notes as encode_notes,
        encode_roster as encode_roster,
        encode_spines as encode_spines,
    )

offer_lazily(__name__)
