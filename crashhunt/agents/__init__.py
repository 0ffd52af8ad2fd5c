"""Agents: the protocol of a driver, and the agents that crashhunt includes."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._car_following import CarFollowing as CarFollowing
    from ._fmu_agents import FmuFactory as FmuFactory
    from ._lane_changing import IntelligentDriver as IntelligentDriver, LaneChanger as LaneChanger
    from ._library_agents import LibraryFactory as LibraryFactory
    from ._policies import (
        NumpyPolicy as NumpyPolicy,
        OnnxPolicy as OnnxPolicy,
        StableBaselines3 as StableBaselines3,
        TorchPolicy as TorchPolicy,
    )
    from ._program_processes import ReusedProgram as ReusedProgram, offer_reused as offer_reused
    from ._programs import ProgramAgent as ProgramAgent, ProgramFactory as ProgramFactory
    from ._protocol import (
        Agent as Agent,
        Closes as Closes,
        DrawsPanels as DrawsPanels,
        NeedsLibraries as NeedsLibraries,
    )
    from ._reference_driver import ReferenceDriver as ReferenceDriver
    from ._reference_models import (
        GRAVITY_MPS2 as GRAVITY_MPS2,
        REFERENCE_MODELS as REFERENCE_MODELS,
        ReferenceModel as ReferenceModel,
        Situation as Situation,
    )
    from ._simple import KeepLaneWithSpeed as KeepLaneWithSpeed, RandomAgent as RandomAgent, Recorded as Recorded

offer_lazily(__name__)
