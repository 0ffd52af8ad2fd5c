"""Agents: who drives. The protocol, and the agents that come with crashhunt."""

from crashhunt.agents._car_following import CarFollowing
from crashhunt.agents._idm import IntelligentDriver
from crashhunt.agents._keep_lane import KeepLaneWithSpeed
from crashhunt.agents._lane_changer import LaneChanger
from crashhunt.agents._numpy_policy import NumpyPolicy
from crashhunt.agents._policies import OnnxPolicy, StableBaselines3, TorchPolicy
from crashhunt.agents._protocol import Agent
from crashhunt.agents._random import RandomAgent
from crashhunt.agents._recorded import Recorded

__all__ = [
    "Agent",
    "CarFollowing",
    "IntelligentDriver",
    "KeepLaneWithSpeed",
    "LaneChanger",
    "NumpyPolicy",
    "OnnxPolicy",
    "RandomAgent",
    "Recorded",
    "StableBaselines3",
    "TorchPolicy",
]
