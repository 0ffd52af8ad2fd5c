from ._commonroad import write_commonroad as write_commonroad
from ._recorded import Recorded as Recorded, Way as Way, recorded_of as recorded_of
