"""Plans: the user's request for a hunt, the settings in ``hunt.toml`` that result from it, and all options of hunts."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._arguments import Owners as Owners, Takes as Takes, agent_of as agent_of, takes_of as takes_of
    from ._choices import disturber as disturber, disturber_apart as disturber_apart
    from ._code import imported_by as imported_by, reused_agents as reused_agents
    from ._declaration import Given as Given, HuntOption as HuntOption
    from ._durations_and_rates import (
        RATE_PERS as RATE_PERS,
        RatePer as RatePer,
        check_duration as check_duration,
        check_rate as check_rate,
        rate_of as rate_of,
        seconds_of as seconds_of,
        share_of as share_of,
    )
    from ._executor_choice import (
        ChoosesParallelism as ChoosesParallelism,
        executor_of as executor_of,
        parallel_here as parallel_here,
    )
    from ._plan import (
        core_of as core_of,
        plan as plan,
        plan_with_code as plan_with_code,
        sampler_of as sampler_of,
        with_settings as with_settings,
    )
    from ._request import Request as Request, spec_words as spec_words
    from ._run_options import (
        Driver as Driver,
        HuntOptions as HuntOptions,
        SnapshotChoices as SnapshotChoices,
        Spec as Spec,
        Subject as Subject,
        TrialOptions as TrialOptions,
        hunt_options as hunt_options,
    )
    from ._settings import (
        AgentSettings as AgentSettings,
        ArgumentSpec as ArgumentSpec,
        HuntSettings as HuntSettings,
        RunSettings as RunSettings,
        fields_of as fields_of,
        read_settings as read_settings,
        write_settings as write_settings,
    )

offer_lazily(__name__)
