from ._plan import (
    Request as Request,
    parse_crash_on as parse_crash_on,
    plan as plan,
    spec_of as spec_of,
    with_settings as with_settings,
)
from ._settings import (
    AgentSettings as AgentSettings,
    ArgumentSpec as ArgumentSpec,
    HuntSettings as HuntSettings,
    RunSettings as RunSettings,
    read_settings as read_settings,
    write_settings as write_settings,
)
