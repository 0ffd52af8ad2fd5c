from ._check import Checked as Checked, check as check
from ._copies import BranchSums as BranchSums, ProbeSums as ProbeSums
from ._directory import HuntDirectory as HuntDirectory
from ._hunt import Hunt as Hunt
from ._ledger import Ledger as Ledger, Turn as Turn, has_begun as has_begun
from ._logs import LogKind as LogKind, LogReader as LogReader
from ._next_trials import Trials as Trials, spec_of as spec_of
from ._preflight import Preflight as Preflight
from ._progress import HuntStatus as HuntStatus
from ._report import HuntReport as HuntReport
from ._results import (
    HuntResults as HuntResults,
    SuiteResults as SuiteResults,
    UnfinishedWarning as UnfinishedWarning,
    columns_of as columns_of,
    load as load,
)
from ._row import FACTS as FACTS, Cell as Cell, TrialRow as TrialRow
from ._salvage import salvage as salvage
from ._searching import SearchStatus as SearchStatus, StrategyStatus as StrategyStatus
from ._state import HuntState as HuntState, find_hunts as find_hunts, hunt_state as hunt_state, is_hunt as is_hunt
from ._surplus import dropped_crashes as dropped_crashes
from ._tables import write_parquet as write_parquet, write_text as write_text
from ._traffic_survey import TrafficSurveyor as TrafficSurveyor
