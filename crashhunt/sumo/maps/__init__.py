"""Conversion of a map to a scenario: a network for SUMO, traffic on this network, and the folder for a hunt.

netconvert, netgenerate and randomTrips of the distribution eclipse-sumo do the work (extra ``maps``), each in its own
process. If a program refuses its input, crashhunt reports an error of one line.
"""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._cache import cached_scenario as cached_scenario
    from ._make import (
        MapOptions as MapOptions,
        PlainTrial as PlainTrial,
        describe_place as describe_place,
        make_scenario as make_scenario,
    )
    from ._road_network import (
        NetworkLane as NetworkLane,
        RoadNetwork as RoadNetwork,
        is_left_hand as is_left_hand,
        read_network as read_network,
    )
    from ._source import (
        MapSource as MapSource,
        check_source as check_source,
        parse_bbox as parse_bbox,
        parse_shape as parse_shape,
    )
    from ._traffic import PlainRun as PlainRun

offer_lazily(__name__)
