from ._backend import (
    Accelerator as Accelerator,
    Backend as Backend,
    CompiledCore as CompiledCore,
    Configuration as Configuration,
    LoadOrder as LoadOrder,
)
from ._digest import (
    as_in_file as as_in_file,
    as_plain_data as as_plain_data,
    digest_of_described as digest_of_described,
    scenario_digest as scenario_digest,
)
from ._load import endings as endings, load_scenario as load_scenario, scenario_from_dict as scenario_from_dict
from ._registry import (
    backend_names as backend_names,
    backend_of as backend_of,
    configurations as configurations,
    installed_backends as installed_backends,
    titles as titles,
)
from ._scenario import Scenario as Scenario, argument_values as argument_values, with_action as with_action
from ._shipped import shipped_folder as shipped_folder, shipped_scenarios as shipped_scenarios
from ._tables import AgentSetup as AgentSetup, ArgumentSetup as ArgumentSetup, ObservationSetup as ObservationSetup
from ._traffic_survey import (
    RunToSurvey as RunToSurvey,
    SurveyJob as SurveyJob,
    TrafficSurvey as TrafficSurvey,
)
