"""SUMO: the simulator, the description of its table in a scenario, and scenarios from maps."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._bent_vehicles import height_at as height_at
    from ._descriptor import BACKEND as BACKEND
    from ._files import (
        WRITTEN as WRITTEN,
        StagedFiles as StagedFiles,
        filled_in as filled_in,
        movable as movable,
        nested_files as nested_files,
        read_xml as read_xml,
        references as references,
        rewritten as rewritten,
        written_by as written_by,
    )
    from ._fleet import Fleet as Fleet
    from ._names import check_names as check_names, explained as explained
    from ._options import (
        HARMLESS as HARMLESS,
        INPUTS as INPUTS,
        SumoSetup as SumoSetup,
        canonical as canonical,
        is_output as is_output,
        is_shown as is_shown,
        is_true as is_true,
        writes as writes,
    )
    from ._range_of_sight import Sight as Sight
    from ._simulator import SumoSimulator as SumoSimulator
    from ._sumocfg import load_sumocfg as load_sumocfg
    from ._traffic_events import SumoEvents as SumoEvents

offer_lazily(__name__)
