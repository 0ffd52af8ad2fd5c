from ._cube import Cube as Cube
from ._grid import GridSampler as GridSampler, SweepSampler as SweepSampler
from ._learning import (
    CmaEsSampler as CmaEsSampler,
    CrossEntropySampler as CrossEntropySampler,
    GuidedSampler as GuidedSampler,
    MutationSampler as MutationSampler,
)
from ._low_discrepancy import HaltonSampler as HaltonSampler, SobolSampler as SobolSampler
from ._made import NamedSampler as NamedSampler, varies_only_asked as varies_only_asked
from ._protocol import (
    HuntFacts as HuntFacts,
    Independent as Independent,
    Key as Key,
    OnlyAsked as OnlyAsked,
    PlainStream as PlainStream,
    Proposal as Proposal,
    Sampler as Sampler,
    Space as Space,
    WantsHunt as WantsHunt,
)
from ._random import RandomSampler as RandomSampler
