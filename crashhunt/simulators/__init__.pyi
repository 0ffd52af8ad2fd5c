from ._actions import (
    META_ACTIONS as META_ACTIONS,
    MetaAction as MetaAction,
    SpaceAction as SpaceAction,
    SpeedAndLaneChange as SpeedAndLaneChange,
)
from ._foreign_spaces import action_form as action_form, native as native
from ._kinematics import Kinematics as Kinematics
from ._protocol import (
    FACULTIES as FACULTIES,
    ActionForm as ActionForm,
    BrakesFully as BrakesFully,
    Disturbing as Disturbing,
    Disturbs as Disturbs,
    FlattensObservations as FlattensObservations,
    FullBraking as FullBraking,
    HasMap as HasMap,
    HasMeanings as HasMeanings,
    HasWindow as HasWindow,
    HoldsBack as HoldsBack,
    Info as Info,
    LeavesOut as LeavesOut,
    NamesDanger as NamesDanger,
    NamesObservations as NamesObservations,
    Observations as Observations,
    Options as Options,
    PlaysPaths as PlaysPaths,
    Simulator as Simulator,
    StepResult as StepResult,
    TellsEvents as TellsEvents,
    TellsNotices as TellsNotices,
    Tidies as Tidies,
)
