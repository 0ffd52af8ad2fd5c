from ._digest import (
    as_plain_data as as_plain_data,
    digest_of_described as digest_of_described,
    scenario_digest as scenario_digest,
)
from ._scenario import (
    Scenario as Scenario,
    argument_values as argument_values,
    load_scenario as load_scenario,
    scenario_from_dict as scenario_from_dict,
    shipped_folder as shipped_folder,
    shipped_scenarios as shipped_scenarios,
    with_action as with_action,
)
from ._tables import (
    AgentSetup as AgentSetup,
    ArgumentSetup as ArgumentSetup,
    CrashRule as CrashRule,
    GymSetup as GymSetup,
    HighwaySetup as HighwaySetup,
    ObservationSetup as ObservationSetup,
    SumoSetup as SumoSetup,
)
