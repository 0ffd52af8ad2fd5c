"""Scenarios: network, traffic, controlled vehicles and arguments, from ``scenario.toml`` or a SUMO configuration."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._action_forms import (
        ACTIONS as ACTIONS,
        OVERRIDES_ONLY as OVERRIDES_ONLY,
        ActionComponent as ActionComponent,
        action_settings as action_settings,
        canonical_action as canonical_action,
        check_action as check_action,
        refuse_repeated_settings as refuse_repeated_settings,
        with_stated_choice as with_stated_choice,
        with_whole_vehicle_visible as with_whole_vehicle_visible,
    )
    from ._load import (
        copy_shipped_scenario as copy_shipped_scenario,
        endings as endings,
        load_scenario as load_scenario,
        refuse as refuse,
        scenario_from_dict as scenario_from_dict,
        shipped_folder as shipped_folder,
        shipped_scenarios as shipped_scenarios,
    )
    from ._scenario import (
        FIXED_LOAD_ORDER as FIXED_LOAD_ORDER,
        SIMULATOR_PACKAGES as SIMULATOR_PACKAGES,
        STEP_LENGTH_S as STEP_LENGTH_S,
        Accelerator as Accelerator,
        AgentSetup as AgentSetup,
        ArgumentSetup as ArgumentSetup,
        Backend as Backend,
        CompiledCore as CompiledCore,
        Configuration as Configuration,
        LoadOrder as LoadOrder,
        ObservationSetup as ObservationSetup,
        RunToSurvey as RunToSurvey,
        Scenario as Scenario,
        SurveyJob as SurveyJob,
        TrafficSurvey as TrafficSurvey,
        argument_values as argument_values,
        as_in_file as as_in_file,
        as_plain_data as as_plain_data,
        backend_of as backend_of,
        configurations as configurations,
        digest_of_described as digest_of_described,
        installed_backends as installed_backends,
        load_order_change as load_order_change,
        load_order_of as load_order_of,
        scenario_digest as scenario_digest,
        titles as titles,
        with_action as with_action,
        with_observations as with_observations,
        with_recorded_load_order as with_recorded_load_order,
        with_whole_vehicles_visible as with_whole_vehicles_visible,
    )

offer_lazily(__name__)
