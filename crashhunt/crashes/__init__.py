"""Crashes: bundles, archives, trust, encounters, criticality, signatures, crash types, fault and preventability."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._archive import Archive as Archive, export_crash as export_crash, open_archive as open_archive
    from ._bundle import (
        Bundle as Bundle,
        CrashSummary as CrashSummary,
        snapshot_of as snapshot_of,
    )
    from ._bundle_trust import (
        TrustedOrigin as TrustedOrigin,
        add_trusted as add_trusted,
        authenticate_bundle as authenticate_bundle,
        describe_code as describe_code,
        is_bundle_made_here as is_bundle_made_here,
        is_bundle_trusted as is_bundle_trusted,
        is_fingerprint_trusted as is_fingerprint_trusted,
        is_hunt_trusted as is_hunt_trusted,
        is_snapshot_trusted as is_snapshot_trusted,
        list_trusted as list_trusted,
        refuse_side_effects as refuse_side_effects,
        refuse_untrusted as refuse_untrusted,
        remove_trusted as remove_trusted,
        trust_repositories as trust_repositories,
        trust_repository as trust_repository,
        trust_snapshot as trust_snapshot,
    )
    from ._bundle_writer import with_lights as with_lights, write_bundle as write_bundle, write_trial as write_trial
    from ._cause_groups import (
        Cause as Cause,
        CauseGroup as CauseGroup,
        Division as Division,
        cause_of as cause_of,
        count_causes as count_causes,
        features_of as features_of,
        join_causes as join_causes,
        without_chance_lengths as without_chance_lengths,
    )
    from ._contact_record import ContactRecord as ContactRecord, contact_record as contact_record
    from ._crash_types import (
        SIGNATURE_VERSION as SIGNATURE_VERSION,
        Group as Group,
        Groups as Groups,
        Signature as Signature,
        group_crashes as group_crashes,
        groups_of as groups_of,
        own_frames as own_frames,
        signature_of as signature_of,
        signature_of_fault as signature_of_fault,
    )
    from ._encounter import (
        DangerCourse as DangerCourse,
        Encounter as Encounter,
        Moment as Moment,
        closest_actors as closest_actors,
        danger_course as danger_course,
        last_escape as last_escape,
        most_dangerous as most_dangerous,
    )
    from ._fault import (
        Fault as Fault,
        fault_of as fault_of,
        stop_lines_of as stop_lines_of,
        yielding_actor as yielding_actor,
    )
    from ._first_observed import visible_from as visible_from
    from ._judgement import (
        COMPETENT_DRIVERS as COMPETENT_DRIVERS,
        INTERRUPTED as INTERRUPTED,
        Attempt as Attempt,
        DriverRun as DriverRun,
        Factor as Factor,
        Judgement as Judgement,
        LeftOut as LeftOut,
        Omission as Omission,
        Preventability as Preventability,
        Reference as Reference,
        ReferenceRun as ReferenceRun,
        Why as Why,
        Without as Without,
        judgement_of as judgement_of,
        preventable_by as preventable_by,
        wilson as wilson,
        with_judgement as with_judgement,
    )
    from ._lanes import Borders as Borders, LaneMap as LaneMap
    from ._last_avoidable_step import (
        Ending as Ending,
        StepBisection as StepBisection,
        changes_of as changes_of,
        ending_of as ending_of,
        find_escape as find_escape,
        last_avoiding as last_avoiding,
        overruled_trial as overruled_trial,
        partner as partner,
        slowing as slowing,
    )
    from ._notes import (
        Note as Note,
        add_note as add_note,
        read_notes as read_notes,
        remove_note as remove_note,
        subject_of as subject_of,
        unreadable_notes as unreadable_notes,
    )
    from ._saved_crashes import (
        changing as changing,
        crash_folders as crash_folders,
        files_of as files_of,
        find_bundle as find_bundle,
        list_bundles as list_bundles,
        list_near_misses as list_near_misses,
        names_of_actions as names_of_actions,
        read_bundle as read_bundle,
        read_lights as read_lights,
        read_params as read_params,
    )

offer_lazily(__name__)
