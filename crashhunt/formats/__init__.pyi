from ._commonroad import write_commonroad as write_commonroad
from ._openscenario import write_openscenario as write_openscenario
from ._recorded import Recorded as Recorded, Way as Way, recorded_of as recorded_of
