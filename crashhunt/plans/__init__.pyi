from ._declaration import Given as Given, HuntOption as HuntOption
from ._duration import seconds_of as seconds_of
from ._executor import SizesItself as SizesItself, executor_of as executor_of, parallel_here as parallel_here
from ._load_order import (
    FIXED as FIXED,
    load_order_change as load_order_change,
    load_order_of as load_order_of,
    with_recorded_load_order as with_recorded_load_order,
)
from ._options import (
    Driver as Driver,
    HuntOptions as HuntOptions,
    SnapshotChoices as SnapshotChoices,
    Spec as Spec,
    TrialOptions as TrialOptions,
    hunt_options as hunt_options,
)
from ._plan import (
    core_of as core_of,
    disturber as disturber,
    parse_crash_on as parse_crash_on,
    plan as plan,
    sampler_of as sampler_of,
    with_settings as with_settings,
)
from ._request import (
    Request as Request,
    fields_of as fields_of,
    request_of as request_of,
    spec_words as spec_words,
)
from ._scope import Owners as Owners, Takes as Takes, takes_of as takes_of
from ._settings import (
    AgentSettings as AgentSettings,
    ArgumentSpec as ArgumentSpec,
    HuntSettings as HuntSettings,
    RunSettings as RunSettings,
    read_settings as read_settings,
    write_settings as write_settings,
)
