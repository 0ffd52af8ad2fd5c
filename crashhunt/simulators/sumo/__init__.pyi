from ._bends import height_at as height_at
from ._events import SumoEvents as SumoEvents
from ._simulator import SumoSimulator as SumoSimulator
