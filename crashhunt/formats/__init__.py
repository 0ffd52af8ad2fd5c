"""Export of a recorded crash as a scenario for other tools, and scenarios from the parameters of OpenSCENARIO files.

The files are written as plain XML with Python's standard library. ``scripts/tools/readers`` tests that the formats' own
libraries read back the recorded values. These libraries are not needed for writing.
"""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._alks_parameters import scenario_from_openscenario as scenario_from_openscenario
    from ._commonroad import write_commonroad as write_commonroad
    from ._openscenario import write_openscenario as write_openscenario

offer_lazily(__name__)
