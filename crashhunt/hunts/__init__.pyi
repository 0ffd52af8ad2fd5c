from ._check import Checked as Checked, CheckFinding as CheckFinding, check as check, salvage as salvage
from ._code_versions import (
    CodeVersions as CodeVersions,
    VersionCounts as VersionCounts,
    count_versions as count_versions,
)
from ._crashes import (
    CrashTally as CrashTally,
    FoundCrashes as FoundCrashes,
    crashes_by_version as crashes_by_version,
    dropped_crashes as dropped_crashes,
    find_crashes as find_crashes,
)
from ._hunt import Hunt as Hunt
from ._next_trials import (
    GREATEST_LAG as GREATEST_LAG,
    Trials as Trials,
    growing_lag as growing_lag,
    spec_of as spec_of,
)
from ._preflight import Preflight as Preflight, TrafficSurveyor as TrafficSurveyor
from ._progress import (
    HuntStatus as HuntStatus,
    PhaseStatus as PhaseStatus,
    SearchStatus as SearchStatus,
    StrategyStatus as StrategyStatus,
)
from ._rates import counting_rule as counting_rule, why_no_interval as why_no_interval
from ._reports import AuditReport as AuditReport, HuntReport as HuntReport, StoppedBecause as StoppedBecause
from ._results import (
    FACTS as FACTS,
    Cell as Cell,
    HuntResults as HuntResults,
    IncompleteHuntWarning as IncompleteHuntWarning,
    SuiteResults as SuiteResults,
    TrialRow as TrialRow,
    columns_of as columns_of,
    load as load,
    write_parquet as write_parquet,
    write_text as write_text,
)
from ._state import (
    BranchSums as BranchSums,
    HuntDirectory as HuntDirectory,
    HuntState as HuntState,
    LogKind as LogKind,
    LogReader as LogReader,
    ProbeSums as ProbeSums,
    find_hunts as find_hunts,
    find_searches as find_searches,
    hunt_state as hunt_state,
    is_case as is_case,
    is_hunt as is_hunt,
    state_of_facts as state_of_facts,
    sums_of_branches as sums_of_branches,
    sums_of_probes as sums_of_probes,
)
