"""Reports: summaries, descriptions, tables and pages for people."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._argument_importance import importance_of as importance_of
    from ._argument_words import argument_units as argument_units
    from ._ci_findings import (
        corpus_annotations as corpus_annotations,
        corpus_summary as corpus_summary,
        crash_annotations as crash_annotations,
        crashes_summary as crashes_summary,
        findings_of as findings_of,
        write_sarif as write_sarif,
    )
    from ._comparison_text import comparison_page as comparison_page, describe_comparison as describe_comparison
    from ._crash_text import Story as Story, describe_note as describe_note
    from ._crash_types_table import describe_causes as describe_causes, describe_groups as describe_groups
    from ._gate_report import (
        describe_gate as describe_gate,
        gate_annotations as gate_annotations,
        gate_summary as gate_summary,
        write_gate_junit as write_gate_junit,
    )
    from ._hunt_text import describe_hunt as describe_hunt
    from ._listing import (
        ListingEntry as ListingEntry,
        describe as describe,
        list_actions as list_actions,
        list_observations as list_observations,
        list_registered as list_registered,
        list_requirements as list_requirements,
        list_scenarios as list_scenarios,
    )
    from ._live_screen import (
        Watcher as Watcher,
        describe_phase as describe_phase,
        describe_types as describe_types,
        format_pace as format_pace,
        format_seconds as format_seconds,
    )
    from ._page import (
        GOLDEN_RATIO as GOLDEN_RATIO,
        UNCHOSEN as UNCHOSEN,
        is_drawn as is_drawn,
        lineage_of as lineage_of,
        player_data as player_data,
        player_parts as player_parts,
        trial_point as trial_point,
        write_report as write_report,
    )
    from ._rate_text import (
        describe_rates as describe_rates,
        describe_running as describe_running,
        rates_page as rates_page,
        write_rates_csv as write_rates_csv,
    )
    from ._replay_text import describe_replay as describe_replay
    from ._scorecard_page import (
        describe_scorecard as describe_scorecard,
        scorecard_page as scorecard_page,
        scorecard_table as scorecard_table,
    )
    from ._step_table import (
        check_fields as check_fields,
        format_table as format_table,
        steps_table as steps_table,
    )
    from ._version_words import (
        describe_types_by_version as describe_types_by_version,
        describe_versions as describe_versions,
    )

offer_lazily(__name__)
