from ._grid import GridSampler as GridSampler, SweepSampler as SweepSampler
from ._protocol import Key as Key, Sampler as Sampler, Space as Space
from ._random import RandomSampler as RandomSampler
