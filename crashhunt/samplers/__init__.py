"""Samplers: which arguments the next trial gets."""

from crashhunt.samplers._grid import GridSampler, SweepSampler
from crashhunt.samplers._protocol import Key, Sampler, Space
from crashhunt.samplers._random import RandomSampler

__all__ = ["GridSampler", "Key", "RandomSampler", "Sampler", "Space", "SweepSampler"]
