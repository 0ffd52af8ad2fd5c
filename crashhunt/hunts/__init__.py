"""Hunts: the main loop, the directory, and results that can be read afterwards."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._hunt import Hunt as Hunt
    from ._hunt_file_check import Checked as Checked, check as check
    from ._next_trials import (
        GREATEST_LAG as GREATEST_LAG,
        Trials as Trials,
        growing_lag as growing_lag,
        spec_of as spec_of,
    )
    from ._preflight import (
        Preflight as Preflight,
        SignalList as SignalList,
        TrafficSurveyor as TrafficSurveyor,
        list_signals as list_signals,
    )
    from ._progress import HuntStatus as HuntStatus, PhaseStatus as PhaseStatus, SearchStatus as SearchStatus
    from ._reports import AuditReport as AuditReport, HuntReport as HuntReport, StoppedBecause as StoppedBecause
    from ._salvage import salvage as salvage

offer_lazily(__name__)
