"""What the directory of a hunt says: its state, its trials, its crashes, and which code ran them."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._code_versions import (
        CodeVersions as CodeVersions,
        VersionCounts as VersionCounts,
        count_versions as count_versions,
        resumed_versions as resumed_versions,
    )
    from ._found_crashes import (
        CrashTally as CrashTally,
        FoundCrashes as FoundCrashes,
        Judged as Judged,
        Kinds as Kinds,
        crashes_by_version as crashes_by_version,
        dropped_crashes as dropped_crashes,
        find_crashes as find_crashes,
        first_trials as first_trials,
        prune_bundles as prune_bundles,
        tally_crashes as tally_crashes,
    )
    from ._hunt_directory import HuntDirectory as HuntDirectory
    from ._hunt_results import (
        HuntResults as HuntResults,
        IncompleteHuntWarning as IncompleteHuntWarning,
        SuiteResults as SuiteResults,
        load as load,
        write_parquet as write_parquet,
        write_text as write_text,
    )
    from ._hunt_state import (
        BRANCHES as BRANCHES,
        HEARTBEAT_S as HEARTBEAT_S,
        PROBES as PROBES,
        BranchSums as BranchSums,
        HuntState as HuntState,
        ProbeSums as ProbeSums,
        copies_to_come as copies_to_come,
        draws_independently as draws_independently,
        find_hunts as find_hunts,
        find_searches as find_searches,
        hunt_state as hunt_state,
        is_case as is_case,
        is_hunt as is_hunt,
        ledger_owner as ledger_owner,
        state_of_facts as state_of_facts,
        sums_of_branches as sums_of_branches,
        sums_of_probes as sums_of_probes,
        trials_of_running as trials_of_running,
        with_crash_counts as with_crash_counts,
    )
    from ._log_reader import LogKind as LogKind, LogReader as LogReader
    from ._trial_table import (
        FACTS as FACTS,
        Cell as Cell,
        TrialRow as TrialRow,
        columns_of as columns_of,
    )

offer_lazily(__name__)
