from ._backend import (
    Accelerator as Accelerator,
    Backend as Backend,
    CompiledCore as CompiledCore,
    Configuration as Configuration,
    LoadOrder as LoadOrder,
    RunToSurvey as RunToSurvey,
    SurveyJob as SurveyJob,
    TrafficSurvey as TrafficSurvey,
    backend_names as backend_names,
    backend_of as backend_of,
    configurations as configurations,
    installed_backends as installed_backends,
    titles as titles,
)
from ._load import (
    endings as endings,
    load_scenario as load_scenario,
    scenario_from_dict as scenario_from_dict,
    shipped_folder as shipped_folder,
    shipped_scenarios as shipped_scenarios,
)
from ._scenario import (
    AgentSetup as AgentSetup,
    ArgumentSetup as ArgumentSetup,
    ObservationSetup as ObservationSetup,
    Scenario as Scenario,
    argument_values as argument_values,
    as_in_file as as_in_file,
    as_plain_data as as_plain_data,
    digest_of_described as digest_of_described,
    scenario_digest as scenario_digest,
    with_action as with_action,
)
