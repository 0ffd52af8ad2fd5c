from ._car_following import CarFollowing as CarFollowing
from ._idm import IntelligentDriver as IntelligentDriver
from ._keep_lane import KeepLaneWithSpeed as KeepLaneWithSpeed
from ._lane_changer import LaneChanger as LaneChanger
from ._numpy_policy import NumpyPolicy as NumpyPolicy
from ._policies import OnnxPolicy as OnnxPolicy, StableBaselines3 as StableBaselines3, TorchPolicy as TorchPolicy
from ._protocol import (
    Agent as Agent,
    Closes as Closes,
    DrawsPanels as DrawsPanels,
    NeedsLibraries as NeedsLibraries,
)
from ._random import RandomAgent as RandomAgent
from ._recorded import Recorded as Recorded
