"""Samplers: they choose the arguments of the next trial."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._boundary import SAMPLE as SAMPLE, BoundarySampler as BoundarySampler, nearest_labels as nearest_labels
    from ._by_name import NamedSampler as NamedSampler, varies_only_asked as varies_only_asked
    from ._cma_es import CmaEsSampler as CmaEsSampler
    from ._cross_entropy import CrossEntropySampler as CrossEntropySampler
    from ._guided import GuidedSampler as GuidedSampler
    from ._mutation import MutationSampler as MutationSampler
    from ._protocol import (
        HuntFacts as HuntFacts,
        Independent as Independent,
        Key as Key,
        OnlyAsked as OnlyAsked,
        PlainStream as PlainStream,
        Proposal as Proposal,
        ReceivesHuntFacts as ReceivesHuntFacts,
        Sampler as Sampler,
        Space as Space,
    )
    from ._space_filling import (
        Cube as Cube,
        GridSampler as GridSampler,
        HaltonSampler as HaltonSampler,
        RandomSampler as RandomSampler,
        SobolSampler as SobolSampler,
        SweepSampler as SweepSampler,
    )

offer_lazily(__name__)
