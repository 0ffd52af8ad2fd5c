from ._commonroad import write_commonroad as write_commonroad
from ._openscenario import write_openscenario as write_openscenario
from ._recorded import RecordedCrash as RecordedCrash, RecordedPath as RecordedPath, recorded_of as recorded_of
