"""Simulators: the world that agents drive in. Nothing here imports libsumo; `crashhunt.simulators.sumo` does."""

from crashhunt.simulators._actions import META_ACTIONS, MetaAction, SpaceAction, SpeedAndLaneChange
from crashhunt.simulators._protocol import ActionForm, FullBraking, Observations, Simulator, StepResult

__all__ = [
    "META_ACTIONS",
    "ActionForm",
    "FullBraking",
    "MetaAction",
    "Observations",
    "Simulator",
    "SpaceAction",
    "SpeedAndLaneChange",
    "StepResult",
]
