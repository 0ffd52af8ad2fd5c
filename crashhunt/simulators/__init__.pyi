from ._actions import (
    META_ACTIONS as META_ACTIONS,
    MetaAction as MetaAction,
    SpaceAction as SpaceAction,
    SpeedAndLaneChange as SpeedAndLaneChange,
)
from ._kinematics import Kinematics as Kinematics
from ._protocol import (
    ActionForm as ActionForm,
    FullBraking as FullBraking,
    Observations as Observations,
    Simulator as Simulator,
    StepResult as StepResult,
)
from ._spaces import action_form as action_form, native as native
