"""Simulators: the world that agents drive in. Nothing here imports libsumo; `crashhunt.sumo` does."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._actions import (
        MAX_ACCELERATION as MAX_ACCELERATION,
        META_ACTIONS as META_ACTIONS,
        TRAJECTORY_SHAPE as TRAJECTORY_SHAPE,
        AccelerationAndLaneChange as AccelerationAndLaneChange,
        MetaAction as MetaAction,
        NumbersAction as NumbersAction,
        SimulatorDrives as SimulatorDrives,
        SpaceAction as SpaceAction,
        SpeedAndLaneChange as SpeedAndLaneChange,
        TrajectoryAction as TrajectoryAction,
    )
    from ._any_space import (
        ObservationForm as ObservationForm,
        action_form as action_form,
        action_mask_of as action_mask_of,
        as_tables as as_tables,
        has_action_masks as has_action_masks,
        has_nan as has_nan,
        merge as merge,
        native as native,
        reseed_in_place as reseed_in_place,
        time_limit_of as time_limit_of,
    )
    from ._bicycle_model import (
        MAX_JERK_MPS3 as MAX_JERK_MPS3,
        MAX_STEERING_RAD as MAX_STEERING_RAD,
        MAX_STEERING_RATE_RADPS as MAX_STEERING_RATE_RADPS,
        WHEELBASE_SHARE as WHEELBASE_SHARE,
        BicycleModel as BicycleModel,
        MotionState as MotionState,
    )
    from ._grids_and_pictures import Raster as Raster, picture as picture
    from ._kinematics_observation import Kinematics as Kinematics, Unseen as Unseen, kind_number as kind_number
    from ._line_of_sight import (
        ObstacleOutlines as ObstacleOutlines,
        RayCaster as RayCaster,
        occluded as occluded,
    )
    from ._observation_layout import (
        History as History,
        ObservationLayout as ObservationLayout,
        RequestedPart as RequestedPart,
        layouts_of as layouts_of,
        parse_parts as parse_parts,
    )
    from ._observation_parts import (
        MODIFIERS as MODIFIERS,
        ON as ON,
        PARTS as PARTS,
        REACH_M as REACH_M,
        REFERENCE_SHARES as REFERENCE_SHARES,
        SCENE_PARTS as SCENE_PARTS,
        Column as Column,
        Setting as Setting,
    )
    from ._protocol import (
        FACULTIES as FACULTIES,
        ActionForm as ActionForm,
        ActiveDisturbance as ActiveDisturbance,
        CountsSetUp as CountsSetUp,
        FastStepper as FastStepper,
        FlattensObservations as FlattensObservations,
        FullBraking as FullBraking,
        HasMap as HasMap,
        HasObstacles as HasObstacles,
        HasWindow as HasWindow,
        Info as Info,
        KnowsEncodedType as KnowsEncodedType,
        Lights as Lights,
        MasksActions as MasksActions,
        NamesMetaActions as NamesMetaActions,
        NamesObservations as NamesObservations,
        Observations as Observations,
        ObservesParts as ObservesParts,
        OfAnyLength as OfAnyLength,
        Options as Options,
        PreparesProcess as PreparesProcess,
        ProvidesRoadMaps as ProvidesRoadMaps,
        ReportsCrashCell as ReportsCrashCell,
        ReportsDanger as ReportsDanger,
        ReportsEvents as ReportsEvents,
        ReportsLights as ReportsLights,
        ReportsNearestAhead as ReportsNearestAhead,
        ReportsNotices as ReportsNotices,
        ReportsSpeedLimit as ReportsSpeedLimit,
        ReportsSurroundings as ReportsSurroundings,
        ReportsTruncation as ReportsTruncation,
        RestoresObservations as RestoresObservations,
        RestoresState as RestoresState,
        RunsForeignCode as RunsForeignCode,
        Simulator as Simulator,
        StepResult as StepResult,
        SupportsDisturbances as SupportsDisturbances,
        SupportsExclusion as SupportsExclusion,
        SupportsFastSteps as SupportsFastSteps,
        SupportsFullBraking as SupportsFullBraking,
        SupportsHolds as SupportsHolds,
        SupportsReseeding as SupportsReseeding,
        SupportsScripts as SupportsScripts,
        TranslatesMotion as TranslatesMotion,
    )
    from ._scene_observation import (
        LanePlace as LanePlace,
        SceneObserver as SceneObserver,
        bicycle_steering as bicycle_steering,
    )
    from ._scene_parts import (
        ActorNumbers as ActorNumbers,
        NearActor as NearActor,
        center_of as center_of,
        covariances_of as covariances_of,
        nearest_actors as nearest_actors,
        predictions_of as predictions_of,
        with_range_noise as with_range_noise,
        with_reference_point as with_reference_point,
        wrapped as wrapped,
    )
    from ._standstill import Standstill as Standstill

offer_lazily(__name__)
