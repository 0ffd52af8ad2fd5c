from ._archive import Archive as Archive, export_crash as export_crash, open_archive as open_archive
from ._beside import files_of as files_of
from ._bundle import (
    Bundle as Bundle,
    read_bundle as read_bundle,
    read_params as read_params,
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
from ._side_effects import refuse_side_effects as refuse_side_effects
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
