"""Gymnasium and PettingZoo environments as a simulator, and the description of their table in a scenario."""

from typing import TYPE_CHECKING

from crashhunt.base.doors import offer_lazily

if TYPE_CHECKING:
    from ._descriptor import CrashRule as CrashRule, GymSetup as GymSetup
    from ._simulator import GymSimulator as GymSimulator

offer_lazily(__name__)
