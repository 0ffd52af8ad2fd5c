from ._archive import Archive as Archive, export_crash as export_crash, open_archive as open_archive
from ._beside import files_of as files_of, read_params as read_params
from ._bundle import (
    Bundle as Bundle,
    read_bundle as read_bundle,
    write_bundle as write_bundle,
    write_trial as write_trial,
)
from ._danger import DangerCourse as DangerCourse, danger_course as danger_course, most_dangerous as most_dangerous
from ._data import CrashData as CrashData, CrashSummary as CrashSummary
from ._encounter import Encounter as Encounter, Moment as Moment, Position as Position, last_escape as last_escape
from ._escape import (
    Ending as Ending,
    ending_of as ending_of,
    find_escape as find_escape,
    overruled_trial as overruled_trial,
    partner as partner,
    slowing as slowing,
)
from ._find import (
    crash_folders as crash_folders,
    find_bundle as find_bundle,
    list_bundles as list_bundles,
    list_near_misses as list_near_misses,
)
from ._judgement import (
    INTERRUPTED as INTERRUPTED,
    Attempt as Attempt,
    AttemptData as AttemptData,
    Judgement as Judgement,
    JudgementData as JudgementData,
    JudgementVerdict as JudgementVerdict,
    judgement_of as judgement_of,
    with_judgement as with_judgement,
)
from ._origins import (
    authenticate_bundle as authenticate_bundle,
    describe_code as describe_code,
    is_bundle_made_here as is_bundle_made_here,
    is_bundle_trusted as is_bundle_trusted,
    is_hunt_trusted as is_hunt_trusted,
    is_snapshot_trusted as is_snapshot_trusted,
    refuse_untrusted as refuse_untrusted,
    snapshot_of as snapshot_of,
    trust_snapshot as trust_snapshot,
)
from ._side_effects import refuse_side_effects as refuse_side_effects
from ._trust_store import (
    TrustedOrigin as TrustedOrigin,
    add_trusted as add_trusted,
    is_fingerprint_trusted as is_fingerprint_trusted,
    list_trusted as list_trusted,
    remove_trusted as remove_trusted,
)
from ._visible import visible_from as visible_from
from ._why import (
    Factor as Factor,
    FactorData as FactorData,
    LeftOut as LeftOut,
    Why as Why,
    WhyData as WhyData,
    Without as Without,
    wilson as wilson,
)
