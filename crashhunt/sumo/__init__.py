"""SUMO: the simulator, the description of its table in a scenario, and scenarios from maps."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._descriptor import BACKEND as BACKEND
    from ._fleet import Fleet as Fleet
    from ._options import SumoSetup as SumoSetup, writes as writes
    from ._scene_reader import Sight as Sight
    from ._simulator import SumoSimulator as SumoSimulator
    from ._traffic_events import SumoEvents as SumoEvents

offer_lazily(__name__)
