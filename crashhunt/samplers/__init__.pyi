from ._grid import GridSampler as GridSampler, SweepSampler as SweepSampler
from ._made import NamedSampler as NamedSampler, varies_only_asked as varies_only_asked
from ._protocol import (
    Independent as Independent,
    Key as Key,
    OnlyAsked as OnlyAsked,
    Proposal as Proposal,
    Sampler as Sampler,
    Space as Space,
)
from ._random import RandomSampler as RandomSampler
