from ._blackbox import (
    BlackBox as BlackBox,
    BlackBoxHeader as BlackBoxHeader,
    Phase as Phase,
    Record as Record,
    read_black_box as read_black_box,
    read_header as read_header,
)
from ._blackbox_file import BlackBoxFile as BlackBoxFile
from ._compare import first_divergence as first_divergence, values_around as values_around
from ._digest import digest_of as digest_of
from ._divergence import Divergence as Divergence, DivergenceData as DivergenceData
from ._foxglove import foxglove_layout as foxglove_layout, lane_borders as lane_borders, read_lanes as read_lanes
from ._log import read_log as read_log, write_log as write_log
from ._reading import StepRecord as StepRecord
from ._recording import Recording as Recording
from .records import RECORD_TYPES as RECORD_TYPES, Tag as Tag
from .records.actors import encode_actors as encode_actors
from .records.disturbances import encode_disturbance as encode_disturbance
from .records.events import encode_events as encode_events
from .records.heights import encode_heights as encode_heights
from .records.lanes import encode_lanes as encode_lanes
from .records.notes import encode_notes as encode_notes
from .records.prologue import AgentChannel as AgentChannel, Prologue as Prologue
from .records.roster import encode_roster as encode_roster
from .records.spines import encode_spines as encode_spines
