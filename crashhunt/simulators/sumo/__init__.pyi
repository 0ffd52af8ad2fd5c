from ._bent_vehicles import height_at as height_at
from ._range_of_sight import Sight as Sight
from ._simulator import SumoSimulator as SumoSimulator
from ._traffic_events import SumoEvents as SumoEvents
