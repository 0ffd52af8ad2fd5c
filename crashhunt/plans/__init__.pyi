from ._declaration import (
    RATE_PERS as RATE_PERS,
    Given as Given,
    HuntOption as HuntOption,
    RatePer as RatePer,
    check_duration as check_duration,
    check_rate as check_rate,
    rate_of as rate_of,
    seconds_of as seconds_of,
    share_of as share_of,
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
    FIXED as FIXED,
    Owners as Owners,
    Takes as Takes,
    agent_of as agent_of,
    core_of as core_of,
    disturber as disturber,
    load_order_change as load_order_change,
    load_order_of as load_order_of,
    parse_crash_on as parse_crash_on,
    plan as plan,
    sampler_of as sampler_of,
    takes_of as takes_of,
    with_recorded_load_order as with_recorded_load_order,
    with_settings as with_settings,
)
from ._request import (
    Request as Request,
    SizesItself as SizesItself,
    executor_of as executor_of,
    fields_of as fields_of,
    parallel_here as parallel_here,
    request_of as request_of,
    spec_words as spec_words,
)
from ._settings import (
    AgentSettings as AgentSettings,
    ArgumentSpec as ArgumentSpec,
    HuntSettings as HuntSettings,
    RunSettings as RunSettings,
    read_settings as read_settings,
    write_settings as write_settings,
)
