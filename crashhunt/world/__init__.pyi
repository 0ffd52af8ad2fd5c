from ._approach import ApproachMeter as ApproachMeter, approaches as approaches, closest_approach as closest_approach
from ._closest import ClosestApproach as ClosestApproach, ClosestData as ClosestData
from ._contact import Touch as Touch, first_contact as first_contact, reachable_m as reachable_m
from ._danger import DangerMeter as DangerMeter, DangerousMoment as DangerousMoment, dangers as dangers
from ._events import (
    EVENT_WORDS as EVENT_WORDS,
    LIMITS as LIMITS,
    Event as Event,
    EventData as EventData,
    event_counts as event_counts,
)
from ._followers import followers_danger as followers_danger
from ._geometry import (
    outlines_overlap as outlines_overlap,
    rectangle_gap as rectangle_gap,
    time_to_contact as time_to_contact,
)
from ._outlines import (
    Rectangle as Rectangle,
    corners as corners,
    levels as levels,
    on_one_level as on_one_level,
    outlines as outlines,
)
from ._paths import Path as Path, Paths as Paths, PathsData as PathsData, State as State, paths_of as paths_of
from ._right_of_way import Link as Link, RightOfWay as RightOfWay
from ._scene import (
    PERSON as PERSON,
    Actor as Actor,
    Contact as Contact,
    Frame as Frame,
    Lane as Lane,
    Roster as Roster,
    Scene as Scene,
    Spine as Spine,
    is_person as is_person,
    joined_frame as joined_frame,
)
