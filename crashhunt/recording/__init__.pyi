from ._blackbox import (
    DISK as DISK,
    BlackBox as BlackBox,
    BlackBoxHeader as BlackBoxHeader,
    Phase as Phase,
    Record as Record,
    Tag as Tag,
    read_black_box as read_black_box,
    read_header as read_header,
)
from ._compare import Divergence as Divergence, first_divergence as first_divergence, values_around as values_around
from ._log import read_log as read_log, write_log as write_log
from ._recording import (
    AgentChannel as AgentChannel,
    Prologue as Prologue,
    Recording as Recording,
    StepRecord as StepRecord,
    digest_of as digest_of,
    encode_actors as encode_actors,
    encode_events as encode_events,
    encode_heights as encode_heights,
    encode_notes as encode_notes,
    encode_spines as encode_spines,
)
from ._views import foxglove_layout as foxglove_layout, lane_borders as lane_borders, read_lanes as read_lanes
