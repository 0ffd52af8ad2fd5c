"""The compiled parts: the optional core with bit-identical results, and the library for the order of SUMO's links."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._build_id import HOW_TO_REBUILD as HOW_TO_REBUILD, outdated_modules as outdated_modules
    from ._core import (
        ANSWERED as ANSWERED,
        ASK as ASK,
        DONE as DONE,
        REFUSED as REFUSED,
        SIMULATED as SIMULATED,
        Columns as Columns,
        Core as Core,
        Draft as Draft,
        LaneBlock as LaneBlock,
        Part as Part,
        Streams as Streams,
        UsualSteps as UsualSteps,
        Vehicles as Vehicles,
        core_for as core_for,
        why_not as why_not,
    )
    from ._generators import reseed_generators as reseed_generators, why_no_reseeding as why_no_reseeding
    from ._link_order import LinkOrder as LinkOrder, link_order as link_order, why_no_link_order as why_no_link_order

offer_lazily(__name__)
