from ._bends import height_at as height_at
from ._sight import Sight as Sight
from ._simulator import SumoSimulator as SumoSimulator
from ._traffic_events import SumoEvents as SumoEvents
