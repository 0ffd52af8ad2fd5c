from ._scene_reader import Sight as Sight, height_at as height_at
from ._simulator import SumoSimulator as SumoSimulator
from ._traffic_events import SumoEvents as SumoEvents
