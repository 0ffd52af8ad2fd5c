"""Trials run again with a change: what-if runs, avoidability, causes, and minimization."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._avoidability import check_numbers as check_numbers, judge as judge, judge_bundle as judge_bundle
    from ._delta_debugging import Tried as Tried, fewest as fewest
    from ._driver_runs import judge_preventability as judge_preventability
    from ._interventions import (
        Disturb as Disturb,
        HandOver as HandOver,
        Intervention as Intervention,
        LeaveOut as LeaveOut,
        Overrule as Overrule,
        Reseed as Reseed,
        SetArguments as SetArguments,
        interventions_of as interventions_of,
    )
    from ._minimization import Shrunk as Shrunk, shrink as shrink
    from ._minimization_candidates import Form as Form
    from ._types_by_cause import (
        REPRESENTATIVES as REPRESENTATIVES,
        divide_by_cause as divide_by_cause,
        find_cause as find_cause,
    )
    from ._whatif_runs import (
        Counts as Counts,
        Run as Run,
        WhatIfOptions as WhatIfOptions,
        what_if as what_if,
    )

offer_lazily(__name__)
