"""The road at one step and the distances on it: scenes, outlines, contacts, closest approach and criticality."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._closest_approach import (
        ApproachMeter as ApproachMeter,
        ClosestApproach as ClosestApproach,
        approaches as approaches,
        closest_approach as closest_approach,
    )
    from ._contact import (
        MAX_CONTACT_GAP_M as MAX_CONTACT_GAP_M,
        STANDS_MPS as STANDS_MPS,
        Touch as Touch,
        contact_at as contact_at,
        first_contact as first_contact,
        lane_jump as lane_jump,
        poses_between as poses_between,
        reachable_m as reachable_m,
    )
    from ._danger import (
        DangerMeter as DangerMeter,
        DangerousMoment as DangerousMoment,
        dangers as dangers,
        followers_danger as followers_danger,
    )
    from ._distance_driven import DrivenMeter as DrivenMeter
    from ._events import (
        EVENT_WORDS as EVENT_WORDS,
        LIMITS as LIMITS,
        Event as Event,
        Link as Link,
        RightOfWay as RightOfWay,
        event_counts as event_counts,
    )
    from ._geometry import (
        LEVEL_M as LEVEL_M,
        Rectangle as Rectangle,
        corners as corners,
        levels as levels,
        on_one_level as on_one_level,
        outline_gap as outline_gap,
        outlines as outlines,
        outlines_overlap as outlines_overlap,
        place_words as place_words,
        rectangle_gap as rectangle_gap,
        time_to_contact as time_to_contact,
    )
    from ._manoeuvre_motions import (
        START_M as START_M,
        actor_of_manoeuvre as actor_of_manoeuvre,
        manoeuvre_motions as manoeuvre_motions,
    )
    from ._road_map import (
        LaneLines as LaneLines,
        MapLane as MapLane,
        RoadMap as RoadMap,
        StopLine as StopLine,
        VehicleData as VehicleData,
        describe_road_map as describe_road_map,
        lane_lines as lane_lines,
        spaced_line as spaced_line,
    )
    from ._safe_distances import (
        Crossing as Crossing,
        Motion as Motion,
        Neighbor as Neighbor,
        Side as Side,
        Surroundings as Surroundings,
        safe_distance as safe_distance,
        safe_speed as safe_speed,
        time_to_drive as time_to_drive,
    )
    from ._scene import (
        OBSTACLE_KINDS as OBSTACLE_KINDS,
        PERSON as PERSON,
        Actor as Actor,
        Contact as Contact,
        Frame as Frame,
        Lane as Lane,
        Roster as Roster,
        Scene as Scene,
        Spine as Spine,
        is_person as is_person,
        join_frames as join_frames,
        joined_frame as joined_frame,
    )
    from ._tracks import ActorState as ActorState, Path as Path, Paths as Paths, paths_of as paths_of

offer_lazily(__name__)
